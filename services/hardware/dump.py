"""`gemuco can dump`: live frames in words; sends nothing."""

import sys
import time
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field

from rich.markup import escape
from rich.table import Table

from hal.config import BusConfig, RobotConfig
from hal.finding.book import Book, Frame
from hal.finding.decode import Line, describe
from hal.finding.robot_book import books
from hal.finding.tap import frames
from services import show


@dataclass(slots=True)
class Wanted:
    """Which frames, and how many.

    Attributes:
        node: Only those of this node; None for all.
        count: How many frames; None for no end.
        seconds: How long [s].
        summary: One line per identifier at the end in place of one per frame.
    """

    node: int | None
    count: int | None
    seconds: float
    summary: bool


@dataclass(slots=True)
class _Seen:
    """What passed under one identifier."""

    line: Line
    frame: Frame
    kinds: Counter[str] = field(default_factory=Counter)
    count: int = 0


def run_dump(buses: Mapping[str, BusConfig], config: RobotConfig | None, wanted: Wanted) -> int:
    """Print frames as they come, or a summary at the end."""
    known = books(config) if config else {name: Book() for name in buses}
    begun, shown = time.monotonic(), 0
    seen: dict[tuple[str, int, bool], _Seen] = {}
    try:
        for bus, frame in frames(buses, wanted.seconds):
            book = known[bus]
            book.learn(frame)
            line = describe(frame, book)
            if wanted.node is not None and line.node != wanted.node:
                continue
            shown += 1
            if wanted.summary:
                _count(seen, bus, frame, line)
            else:
                sys.stdout.write(_printed(bus, frame, line, book) + "\n")
                sys.stdout.flush()
            if shown == wanted.count:
                break
    except KeyboardInterrupt:
        print(file=sys.stderr)
    if wanted.summary:
        _summarise(seen, known, time.monotonic() - begun)
    elif not shown:
        print("No frame came. Is a node powered? A silent bus stays silent until a HAL runs.", file=sys.stderr)
    return 0


def _printed(bus: str, frame: Frame, line: Line, book: Book) -> str:
    seconds, fraction = divmod(frame.stamp, 1.0)
    clock = time.strftime("%H:%M:%S", time.localtime(seconds))
    width = 8 if frame.is_extended else 3
    who = "" if line.node is None else f"{line.node} {book.names.get(line.node, '')}".strip()
    data = frame.data.hex(" ").upper()
    return (
        f"{clock}.{round(fraction * 1e6) % 1_000_000:06d} {bus} {frame.identifier:0{width}X} [{len(frame.data)}] "
        f"{data:<23}  {line.kind:<9} {who:<24} {line.text}"
    ).rstrip()


def _count(seen: dict[tuple[str, int, bool], _Seen], bus: str, frame: Frame, line: Line) -> None:
    key = (bus, frame.identifier, frame.is_extended)
    one = seen.setdefault(key, _Seen(line, frame))
    one.line, one.frame = line, frame
    one.kinds[line.kind] += 1
    one.count += 1


def _summarise(seen: dict[tuple[str, int, bool], _Seen], known: Mapping[str, Book], duration: float) -> None:
    table = Table(box=None, pad_edge=False)
    for column in ("bus", "id", "frames", "rate", "kind", "node", "last"):
        table.add_column(column, justify="right" if column in ("frames", "rate") else "left")
    for (bus, identifier, extended), one in sorted(seen.items()):
        node = one.line.node
        who = "" if node is None else f"{node} {known[bus].names.get(node, '')}".strip()
        last = one.line.text or one.frame.data.hex(" ").upper()
        rate = f"{one.count / duration:.1f} Hz"
        name = f"{identifier:08X}" if extended else f"{identifier:03X}"
        kinds = ", ".join(one.kinds)
        table.add_row(*(escape(cell) for cell in (bus, name, str(one.count), rate, kinds, who, last)))
    show.console().print(table)
