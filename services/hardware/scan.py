"""`gemuco scan`: who is on the buses of a robot, or on one interface, beside what the robot file says."""

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from hal.config import BusConfig, RobotConfig
from hal.errors import BusGone
from hal.finding.scan import Found, Scan, compare, scan
from hal.finding.tap import Tap
from services import show
from services.errors import AlreadyRunning
from services.process.lock import instead_of

COLUMNS = ("bus", "node", "what", "vendor", "product", "revision", "serial", "name", "versions", "heard")
MOST_UNKNOWN = 20


def run_scan(buses: Mapping[str, BusConfig], config: RobotConfig | None, listen: float, ask: bool, mit: bool) -> int:
    """Scan some buses at the same time and print what was found; 1 if a robot's bus is not as its file says."""
    console = show.console()
    try:
        if config is None:
            found = _scan_all(buses, listen, ask, mit)
        else:
            with instead_of(config.robot, "hal"):
                found = _scan_all(buses, listen, ask, mit)
    except AlreadyRunning:
        console.print("The HAL of this robot runs: nobody is asked, since its nodes have but one SDO server.")
        found = _scan_all(buses, listen, False, False)
    _show(console, [one for one in found if isinstance(one, Scan)], config)
    for one in found:
        if isinstance(one, BusGone):
            console.print(f"[bold red]{escape(str(one))}[/]")
    told = [text for one in found if isinstance(one, Scan) and config for text in compare(one, config)]
    for text in told:
        console.print(f"[yellow]{escape(text)}[/]")
    return 1 if told or any(isinstance(one, BusGone) for one in found) else 0


def _scan_all(buses: Mapping[str, BusConfig], listen: float, ask: bool, mit: bool) -> list[Scan | BusGone]:
    def one(name: str) -> Scan | BusGone:
        try:
            with Tap(name, buses[name]) as tap:
                return scan(tap, listen, ask, mit)
        except BusGone as error:
            return error

    with ThreadPoolExecutor(len(buses)) as pool:
        return list(pool.map(one, buses))


def _show(console: Console, scans: Sequence[Scan], config: RobotConfig | None) -> None:
    table = Table(box=None, pad_edge=False)
    for column in (*COLUMNS, *(("robot file",) if config else ())):
        table.add_column(column)
    for one in scans:
        wanted = (
            {device.node: name for name, device in config.devices.items() if device.bus == one.bus} if config else {}
        )
        for found in one.nodes:
            row = _row(one.bus, found)
            table.add_row(*row, *((escape(wanted.get(found.node, "-")),) if config else ()))
    if table.row_count:
        console.print(table)
    for one in scans:
        silence = f" {one.silence}" if one.silence else ""
        console.print(f"{one.bus}: {len(one.nodes)} nodes, load {one.load:.1%}.{silence}")
        unknown = sorted(one.unknown.items(), key=lambda item: -item[1])
        if unknown:
            told = ", ".join(f"{identifier:03X}h {rate:.3g} Hz" for identifier, rate in unknown[:MOST_UNKNOWN])
            console.print(f"{one.bus}: frames of nobody who is known: {told}")


def _row(bus: str, found: Found) -> list[str]:
    numbers = [found.number(0x1018, subindex) for subindex in (1, 2, 3, 4)]
    versions = " / ".join(text for text in (found.text(0x1009), found.text(0x100A)) if text)
    cells = [bus, str(found.node), found.kind or found.protocol]
    cells += ["" if number is None else f"{number:X}h" for number in numbers]
    cells += [found.text(0x1008), versions, found.state + (" (two nodes!)" if found.is_doubled else "")]
    return [escape(cell) for cell in cells]
