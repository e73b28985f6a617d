"""`gemuco can dump`: live frames in words; it sends nothing."""

import sys
import time
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field

from rich.markup import escape
from rich.table import Table

from hal.config import BusConfig, RobotConfig
from hal.finding.book import Book, Frame
from hal.finding.decode import FrameText, describe
from hal.finding.robot_book import books
from hal.finding.tap import frames
from services import show


@dataclass(slots=True)
class DumpOptions:
    """Options of a dump.

    Attributes:
        node: Show only frames of this node; None for all.
        count: Number of frames; None for no limit.
        seconds: Duration [s].
        summary: Print one line per identifier at the end instead of one per frame.
    """

    node: int | None
    count: int | None
    seconds: float
    summary: bool


@dataclass(slots=True)
class _Traffic:
    """Frames of one identifier: the last one, and counts."""

    line: FrameText
    frame: Frame
    kinds: Counter[str] = field(default_factory=Counter)
    count: int = 0


def run_dump(buses: Mapping[str, BusConfig], config: RobotConfig | None, options: DumpOptions) -> int:
    """Print frames as they arrive, or a summary at the end."""
    known = books(config) if config else {name: Book() for name in buses}
    start, shown = time.monotonic(), 0
    traffic: dict[tuple[str, int, bool], _Traffic] = {}
    try:
        for bus, frame in frames(buses, options.seconds):
            book = known[bus]
            book.learn(frame)
            line = describe(frame, book)
            if options.node is not None and line.node != options.node:
                continue
            shown += 1
            if options.summary:
                _count(traffic, bus, frame, line)
            else:
                sys.stdout.write(_line(bus, frame, line, book) + "\n")
                sys.stdout.flush()
            if shown == options.count:
                break
    except KeyboardInterrupt:
        print(file=sys.stderr)
    if options.summary:
        _summarise(traffic, known, time.monotonic() - start)
    elif not shown:
        print("No frame came. Is a node powered? Its nodes may send nothing until a HAL runs.", file=sys.stderr)
    return 0


def _line(bus: str, frame: Frame, line: FrameText, book: Book) -> str:
    seconds, fraction = divmod(frame.stamp, 1.0)
    clock = time.strftime("%H:%M:%S", time.localtime(seconds))
    width = 8 if frame.is_extended else 3
    data = frame.data.hex(" ").upper()
    return (
        f"{clock}.{round(fraction * 1e6) % 1_000_000:06d} {bus} {frame.identifier:0{width}X} [{len(frame.data)}] "
        f"{data:<23}  {line.kind:<9} {_node(line, book):<24} {line.text}"
    ).rstrip()


def _node(line: FrameText, book: Book) -> str:
    """Return number and name of the node of a line; empty if it has no node."""
    return "" if line.node is None else f"{line.node} {book.names.get(line.node, '')}".strip()


def _count(traffic: dict[tuple[str, int, bool], _Traffic], bus: str, frame: Frame, line: FrameText) -> None:
    key = (bus, frame.identifier, frame.is_extended)
    entry = traffic.setdefault(key, _Traffic(line, frame))
    entry.line, entry.frame = line, frame
    entry.kinds[line.kind] += 1
    entry.count += 1


def _summarise(traffic: dict[tuple[str, int, bool], _Traffic], known: Mapping[str, Book], duration: float) -> None:
    table = Table(box=None, pad_edge=False)
    for column in ("bus", "id", "frames", "rate", "kind", "node", "last"):
        table.add_column(column, justify="right" if column in ("frames", "rate") else "left")
    for (bus, identifier, extended), entry in sorted(traffic.items()):
        last = entry.line.text or entry.frame.data.hex(" ").upper()
        rate = f"{entry.count / duration:.1f} Hz"
        name = f"{identifier:08X}" if extended else f"{identifier:03X}"
        kinds = ", ".join(entry.kinds)
        table.add_row(
            *(escape(cell) for cell in (bus, name, str(entry.count), rate, kinds, _node(entry.line, known[bus]), last))
        )
    show.console().print(table)
