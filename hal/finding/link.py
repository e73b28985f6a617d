"""What Linux knows of a CAN interface: whether it is there and up, its bit rate, its state, and when it restarts.

Source: `ip -details -json link show`; /sys/class/net where there is no `ip` (it knows neither bit rate nor restart).
"""

import json
import subprocess
from dataclasses import dataclass
from pathlib import Path
from typing import Any

NET = Path("/sys/class/net")
_ARPHRD_CAN = 280
_UP = 1


@dataclass(frozen=True, slots=True)
class Link:
    """A network interface.

    Attributes:
        name: As in `can0`.
        is_can: Whether it is a CAN interface.
        is_up: Whether it is set up.
        kind: `can` for a controller, `vcan`, `vxcan`, ...; empty if not known.
        bitrate: [bit/s]; None if it has none, as a virtual one, or it is not known.
        restart: After how long [s] a controller that is bus-off starts again; 0 for never, None if not known.
        state: Of the controller, as `ERROR-ACTIVE`; empty if not known.
        queue: Frames that wait at most to be sent; None if not known.
    """

    name: str
    is_can: bool
    is_up: bool
    kind: str = ""
    bitrate: int | None = None
    restart: float | None = None
    state: str = ""
    queue: int | None = None


def look_up(name: str) -> Link | None:
    """An interface of this machine; None if there is no such interface."""
    folder = NET / name
    if not folder.exists():
        return None
    try:
        shown = subprocess.run(
            ["ip", "-details", "-json", "link", "show", "dev", name], capture_output=True, check=True, timeout=5.0
        )
        return parse(json.loads(shown.stdout))
    except (OSError, subprocess.SubprocessError, ValueError, LookupError):
        return _from_sys(name, folder)


def parse(shown: list[dict[str, Any]]) -> Link:
    """What `ip -details -json link show dev NAME` printed.

    Raises:
        LookupError: It names no interface.
    """
    entry = next((entry for entry in shown if entry), {})  # older versions put empty ones around it
    info = entry.get("linkinfo", {})
    data = info.get("info_data", {})
    restart = data.get("restart_ms", 0 if info.get("info_kind") == "can" else None)
    return Link(
        name=entry["ifname"],
        is_can=entry.get("link_type") == "can",
        is_up="UP" in entry.get("flags", ()),
        kind=info.get("info_kind", ""),
        bitrate=data.get("bittiming", {}).get("bitrate"),
        restart=None if restart is None else restart / 1e3,
        state=data.get("state", ""),
        queue=entry.get("txqlen"),
    )


def known_links() -> list[str]:
    """Names of this machine's CAN interfaces."""
    return sorted(folder.name for folder in NET.iterdir() if _number(folder / "type") == _ARPHRD_CAN)


def _from_sys(name: str, folder: Path) -> Link:
    flags = _number(folder / "flags") or 0
    return Link(
        name, _number(folder / "type") == _ARPHRD_CAN, bool(flags & _UP), queue=_number(folder / "tx_queue_len")
    )


def _number(path: Path) -> int | None:
    try:
        return int(path.read_text(), 0)
    except (OSError, ValueError):
        return None
