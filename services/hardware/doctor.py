"""`gemuco doctor`: check everything that a robot, or this machine, needs; one line per check with its remedy."""

import socket
import struct
import time
from collections.abc import Callable, Iterable, Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from rich.markup import escape
from rich.table import Table

from hal.config import RobotConfig, load_robot
from hal.errors import ConfigError
from hal.finding import doctor
from hal.finding.doctor import Finding, Severity, bad, check_interfaces, ok, warning
from services import show
from services.client import Client
from services.errors import AlreadyRunning, ServiceError
from services.hardware import host_checks
from services.model.artifacts import robot_file
from services.process.lock import instead_of
from services.wire import keys
from services.wire.connect import certificate_end, expiry_warning, exposure_warning, role_file, split_connect
from services.wire.messages import Status
from services.wire.session import is_loopback, port

APPEARS_WITHIN = 3.0
"""The status of a running HAL arrives within this time [s]."""
CONNECTS_WITHIN = 0.5
"""A new client sees running services within this time [s]."""
LATE = 0.005
"""A p99 of the cycle's lateness above this value [s] is a warning."""
_MARKS = {Severity.OK: "[green]ok[/]", Severity.WARNING: "[yellow]warning[/]", Severity.BAD: "[bold red]bad[/]"}
_LISTENING = {"tcp": "0A", "udp": "07"}
"""In /proc/net, a listening socket has this state."""


More = Callable[[RobotConfig], Iterable[Finding]]
"""A function of this type yields further findings on a robot."""


def run_doctor(robot: str | None, connect: Iterable[str] = (), more: More = lambda _: ()) -> int:
    """Print all findings and return the exit code: 1 if anything is bad.

    Args:
        robot: Name or file; None for this machine alone.
        connect: Endpoints, such as a router's, and role files.
        more: Checks of what this room does not know, such as topics of ROS 2.
    """
    counts = dict.fromkeys(Severity, 0)
    console = show.console()
    connect = tuple(connect)
    for finding in _of_machine(connect) if robot is None else _findings(robot, connect, more):
        counts[finding.verdict] += 1
        if console.is_terminal:
            row = Table.grid(padding=(0, 2))
            row.add_column(width=7)
            row.add_column(width=24)
            row.add_row(_MARKS[finding.verdict], finding.what, escape(finding.text))
            console.print(row)
        else:  # a table would wrap lines in a file or pipe
            print(f"{finding.verdict:<8} {finding.what:<24} {finding.text}")
    console.print(f"{counts[Severity.OK]} ok, {counts[Severity.WARNING]} warnings, {counts[Severity.BAD]} bad.")
    if robot is None:
        console.print("Name a robot to check its buses and nodes too: gemuco doctor ROBOT.")
    return 1 if counts[Severity.BAD] else 0


def _of_machine(connect: tuple[str, ...]) -> Iterator[Finding]:
    yield from host_checks.installation()
    yield from host_checks.can_interfaces()
    yield from _of_host(connect)


def _of_host(connect: tuple[str, ...]) -> Iterator[Finding]:
    yield from host_checks.clocks()
    yield from host_checks.real_time()
    yield from host_checks.other_users(bool(split_connect(connect)[1]))
    yield from role_files(connect)


def _findings(robot: str, connect: tuple[str, ...], more: More) -> Iterator[Finding]:
    try:
        config = load_robot(robot_file(robot))
    except ConfigError as error:
        yield bad("robot file", str(error))
        return
    findings = list(doctor.check_file(config))
    yield from findings
    is_sound = all(finding.what != "robot file" or finding.verdict is Severity.OK for finding in findings)
    if is_sound:
        yield from check_interfaces(config)
        if not config.has_topics:
            yield from _devices(config, connect)
        yield from more(config)
    yield from _of_host(connect)
    yield from _network(config, connect)


def _devices(config: RobotConfig, connect: tuple[str, ...]) -> Iterator[Finding]:
    """Yield findings from the HAL of this machine if it runs; otherwise open the buses here."""
    try:
        with instead_of(config.robot, "hal"):
            yield ok("HAL", "It does not run. The buses are opened here, with the motors off.")
            yield from doctor.check_devices(config)
    except ConfigError as error:
        yield bad("devices", str(error))
    except AlreadyRunning as error:
        try:
            with Client(config.robot, connect) as client:
                status = client.status("hal", timeout=APPEARS_WITHIN)
        except ServiceError as cause:
            yield bad("HAL", f"{error} Its status cannot be read: {cause}")
            return
        if status is None:
            yield bad("HAL", f"{error} It publishes no status. Is it still starting?")
        else:
            yield from from_status(status)


def from_status(status: Status) -> Iterator[Finding]:
    """Yield findings from the status of a running HAL, without access to its buses."""
    facts = status.facts
    yield ok("HAL", f"Runs, mode '{facts.get('mode')}'. It reports its state; the buses are not opened here.")
    if facts.get("fault"):
        yield bad("fault", str(facts["fault"]))
    for name, bus in facts.get("buses", {}).items():
        yield from _bus(name, bus)
    devices: dict[str, Any] = facts.get("devices", {})
    faulty = {name: device for name, device in devices.items() if device["text"]}
    for name, device in faulty.items():
        is_bad = device["state"] in ("silent", "fault", "opening", "closed")
        yield (bad if is_bad else warning)(f"node {name}", device["text"])
    if not faulty:
        yield ok("nodes", f"All {len(devices)} answer. Identity and mapping were checked when they were opened.")
    cycles, incomplete = int(facts.get("cycles", 0)), int(facts.get("incomplete", 0))
    if cycles:
        text = f"{1 - incomplete / cycles:.1%} of {cycles} cycles were complete."
        yield (warning if incomplete > 0.02 * cycles else ok)("cycles", text)
    loop = status.loops.get("hal", {})
    if loop:
        late = loop.get("late_p99", 0.0)
        text = f"{loop.get('rate', 0):.1f} of {loop.get('rate_wanted', 0):g} Hz, late by {late * 1e3:.2g} ms (p99)."
        yield (warning if late > LATE else ok)("cycle time", text + (" Is this machine busy?" if late > LATE else ""))
    if facts.get("limits"):
        yield warning("limits", str(facts["limits"]))


def _bus(name: str, bus: dict[str, Any]) -> Iterator[Finding]:
    text = f"{bus['state']}, load {bus['load']:.0%}. {bus['text']}".strip()
    verdict = {"ok": ok, "warning": warning}.get(bus["state"], bad)
    yield verdict(f"bus {name}", text)
    if bus.get("unknown"):
        senders = ", ".join(map(str, bus["unknown"]))
        yield warning(f"unknown nodes {name}", f"Frames of nodes that are not in the robot file: {senders}.")


def role_files(connect: Iterable[str]) -> Iterator[Finding]:
    """Check that the certificates in these role files are valid, and that only their owner can read the files."""
    try:
        for file in split_connect(connect)[1]:
            configuration = role_file(file)
            until = certificate_end(configuration)
            if until is None:
                yield warning("role file", f"'{file}' holds no certificate.")
            elif text := expiry_warning(configuration):
                yield (bad if until <= datetime.now(UTC) else warning)("role file", text)
            else:
                yield ok("role file", f"The certificate in '{file}' is valid until {until:%Y-%m-%d}.")
            if text := exposure_warning(file):
                yield bad("role file", text)
    except (ServiceError, OSError) as error:
        yield bad("role file", str(error))


def _network(config: RobotConfig, connect: tuple[str, ...]) -> Iterator[Finding]:
    """Check that a session opens, and list ports that other machines can reach."""
    try:
        with Client(config.robot, connect) as client:
            deadline = time.monotonic() + CONNECTS_WITHIN
            while not (alive := sorted(client.alive())) and time.monotonic() < deadline:
                time.sleep(0.02)
    except ServiceError as error:
        yield bad("zenoh", str(error))
        return
    yield ok("zenoh", f"A session opens. Running services: {', '.join(alive) or 'none'}.")
    ports = {port(config.robot, service) for service in keys.SERVICES}
    outside: dict[str, set[int]] = {"tcp": set(), "udp": set()}
    for protocol, address, number in listening():
        if number in ports and not is_loopback(address):
            outside[protocol].add(number)
    if outside["tcp"]:
        numbers = ", ".join(map(str, sorted(outside["tcp"])))
        text = f"Port {numbers} is open to other machines. Any client that reaches it may move the robot, unless a role"
        yield warning("outside", f"{text} file requires a certificate. Is that intended?")
    if outside["udp"]:
        numbers = ", ".join(map(str, sorted(outside["udp"])))
        yield ok("outside", f"Port {numbers} is open to other machines over QUIC. Role files require a certificate.")
    if not any(outside.values()):
        yield ok("outside", "No port of this robot is open to other machines.")


def listening() -> Iterator[tuple[str, str, int]]:
    """Yield protocol (`tcp` or `udp`), address and port of every listening socket of this machine."""
    for protocol, state in _LISTENING.items():
        for path in (Path(f"/proc/net/{protocol}"), Path(f"/proc/net/{protocol}6")):
            if not path.exists():
                continue
            for line in path.read_text().splitlines()[1:]:
                words = line.split()
                if words[3] == state:
                    address, _, number = words[1].partition(":")
                    yield protocol, _address(address), int(number, 16)


def _address(text: str) -> str:
    """Convert an address from /proc: words of four bytes in the machine's byte order."""
    raw = b"".join(struct.pack("=I", int(text[start : start + 8], 16)) for start in range(0, len(text), 8))
    return socket.inet_ntop(socket.AF_INET if len(raw) == 4 else socket.AF_INET6, raw)
