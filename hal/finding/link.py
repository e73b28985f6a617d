"""State of a CAN interface in Linux: presence, bit rate, controller state and restart.

Source: `ip -details -json link show`; /sys/class/net without `ip` (which has neither bit rate nor restart).
"""

import json
import subprocess
from dataclasses import dataclass
from pathlib import Path
from typing import Any

NET = Path("/sys/class/net")
_ARPHRD_CAN = 280
_UP = 1
FD_MTU = 72
"""An interface that takes frames of CAN FD has this largest frame [byte]."""


@dataclass(frozen=True, slots=True)
class Interface:
    """A network interface.

    Attributes:
        name: Name, such as `can0`.
        is_can: Whether it is a CAN interface.
        is_up: Whether it is up.
        kind: `can` for a controller, `vcan`, `vxcan`, ...; empty if unknown.
        bitrate: Bit rate [bit/s]; None if unknown, or for a virtual interface.
        restart: Time [s] after which a controller in bus-off starts again; 0 for never, None if unknown.
        state: State of the controller, such as `ERROR-ACTIVE`; empty if unknown.
        queue: Capacity of the send queue [frames]; None if unknown.
        data_bitrate: Bit rate of the data of CAN FD frames [bit/s]; None if it is off or unknown.
        mtu: Largest frame [byte]: 16 for classic ones, 72 for those of CAN FD; None if unknown.
    """

    name: str
    is_can: bool
    is_up: bool
    kind: str = ""
    bitrate: int | None = None
    restart: float | None = None
    state: str = ""
    queue: int | None = None
    data_bitrate: int | None = None
    mtu: int | None = None


def look_up(name: str) -> Interface | None:
    """Return an interface of this machine; None if it does not exist."""
    folder = NET / name
    if not folder.exists():
        return None
    try:
        result = subprocess.run(
            ["ip", "-details", "-json", "link", "show", "dev", name], capture_output=True, check=True, timeout=5.0
        )
        return parse(json.loads(result.stdout))
    except (OSError, subprocess.SubprocessError, ValueError, LookupError):
        return _from_sys(name, folder)


def parse(output: list[dict[str, Any]]) -> Interface:
    """Parse the output of `ip -details -json link show dev NAME`.

    Raises:
        LookupError: The output has no interface.
    """
    entry = next((entry for entry in output if entry), {})  # older versions add empty entries
    info = entry.get("linkinfo", {})
    data = info.get("info_data", {})
    restart = data.get("restart_ms", 0 if info.get("info_kind") == "can" else None)
    return Interface(
        name=entry["ifname"],
        is_can=entry.get("link_type") == "can",
        is_up="UP" in entry.get("flags", ()),
        kind=info.get("info_kind", ""),
        bitrate=data.get("bittiming", {}).get("bitrate"),
        restart=None if restart is None else restart / 1e3,
        state=data.get("state", ""),
        queue=entry.get("txqlen"),
        data_bitrate=data.get("data_bittiming", {}).get("bitrate"),
        mtu=entry.get("mtu"),
    )


def up_command(name: str, kind: str, bitrate: int, data_bitrate: int | None = None) -> str:
    """Return the command that brings an interface up; only a controller has bit rates [bit/s] and a restart.

    Args:
        name: Name of the interface.
        kind: As in `Interface`.
        bitrate: Bit rate of the bus.
        data_bitrate: Bit rate of the data of CAN FD frames; None for classic frames only.
    """
    if kind not in ("can", ""):
        return f"sudo ip link set {name}{'' if data_bitrate is None else f' mtu {FD_MTU}'} up"
    fd = "" if data_bitrate is None else f" dbitrate {data_bitrate} fd on"
    return f"sudo ip link set {name} up type can bitrate {bitrate}{fd} restart-ms 100"


def known_links() -> list[str]:
    """Return the names of this machine's CAN interfaces."""
    return sorted(folder.name for folder in NET.iterdir() if _number(folder / "type") == _ARPHRD_CAN)


def _from_sys(name: str, folder: Path) -> Interface:
    flags = _number(folder / "flags") or 0
    return Interface(
        name,
        _number(folder / "type") == _ARPHRD_CAN,
        bool(flags & _UP),
        queue=_number(folder / "tx_queue_len"),
        mtu=_number(folder / "mtu"),
    )


def _number(path: Path) -> int | None:
    try:
        return int(path.read_text(), 0)
    except (OSError, ValueError):
        return None
