"""`gemuco scan`: list the nodes on the buses of a robot or on one interface, and compare them with the robot file."""

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from hal.config import BusConfig, RobotConfig
from hal.errors import BusGone
from hal.finding.dbc_nodes import dbc_devices
from hal.finding.scan import EXTENDED, Node, Scan, compare, scan
from hal.finding.serial_scan import scan_line
from hal.finding.tap import Tap
from hal.line import SERIAL
from services import show
from services.errors import AlreadyRunning
from services.process.lock import instead_of

COLUMNS = ("bus", "node", "what", "vendor", "product", "revision", "serial", "name", "versions", "heard")
MOST_UNKNOWN = 20


def run_scan(buses: Mapping[str, BusConfig], config: RobotConfig | None, listen: float, ask: bool, mit: bool) -> int:
    """Scan buses at the same time and print their nodes; return 1 if a bus differs from the robot file."""
    console = show.console()
    try:
        if config is None:
            results = _scan_all(buses, listen, ask, mit, None)
        else:
            with instead_of(config.robot, "hal"):
                results = _scan_all(buses, listen, ask, mit, config)
    except AlreadyRunning:
        console.print(
            "The HAL of this robot runs. The scan sends no requests, because each node has only one SDO server."
        )
        results = _scan_all(buses, listen, False, False, config)
    scans = [result for result in results if isinstance(result, Scan)]
    failures = [result for result in results if isinstance(result, BusGone)]
    _show(console, scans, config)
    for failure in failures:
        console.print(f"[bold red]{escape(str(failure))}[/]")
    differences = [text for result in scans for text in compare(result, config)] if config else []
    for text in differences:
        console.print(f"[yellow]{escape(text)}[/]")
    return 1 if differences or failures else 0


def _scan_all(
    buses: Mapping[str, BusConfig], listen: float, ask: bool, mit: bool, config: RobotConfig | None
) -> list[Scan | BusGone]:
    devices = {name: dbc_devices(config, name) if config else () for name in buses}

    def scan_bus(name: str) -> Scan | BusGone:
        try:
            if buses[name].interface in SERIAL:
                return scan_line(name, buses[name]) if ask else BusGone(f"Line '{name}' is in use: see `gemuco top`.")
            with Tap(name, buses[name]) as tap:
                return scan(tap, listen, ask, mit, devices=devices[name])
        except BusGone as error:
            return error

    with ThreadPoolExecutor(len(buses)) as pool:
        return list(pool.map(scan_bus, buses))


def _show(console: Console, scans: Sequence[Scan], config: RobotConfig | None) -> None:
    table = Table(box=None, pad_edge=False)
    for column in (*COLUMNS, *(("robot file",) if config else ())):
        table.add_column(column)
    for result in scans:
        devices = config.devices.items() if config else ()
        names = {device.node: name for name, device in devices if device.bus == result.bus}
        own = {id(node): name for name, node in result.named.items()}
        for node in result.nodes:
            row = _row(result.bus, node)
            name = own.get(id(node)) or names.get(node.node, "-")
            table.add_row(*row, *((escape(name),) if config else ()))
    if table.row_count:
        console.print(table)
    for result in scans:
        silence = f" {result.silence}" if result.silence else ""
        console.print(f"{result.bus}: {len(result.nodes)} nodes, load {result.load:.1%}.{silence}")
        unknown = sorted(result.unknown.items(), key=lambda item: -item[1])
        if unknown:
            frames = ", ".join(f"{_hex(identifier)} {rate:.3g} Hz" for identifier, rate in unknown[:MOST_UNKNOWN])
            console.print(f"{result.bus}: frames of unknown nodes: {frames}")


def _hex(identifier: int) -> str:
    return f"{identifier & ~EXTENDED:08X}h" if identifier & EXTENDED else f"{identifier:03X}h"


def _row(bus: str, node: Node) -> list[str]:
    numbers = [node.number(0x1018, subindex) for subindex in (1, 2, 3, 4)]
    versions = " / ".join(text for text in (node.text(0x1009), node.text(0x100A)) if text)
    cells = [bus, str(node.node), node.kind or node.protocol]
    cells += ["" if number is None else f"{number:X}h" for number in numbers]
    cells += [node.text(0x1008), versions, node.state + (" (two nodes!)" if node.is_doubled else "")]
    return [escape(cell) for cell in cells]
