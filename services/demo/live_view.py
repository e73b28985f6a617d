"""The demo in a terminal: stages, signals, anomaly score and lateness of the loops, written five times a second."""

import contextlib
import math
import time
from collections import deque
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass
from types import TracebackType
from typing import Self

from rich.console import Console, Group
from rich.live import Live
from rich.text import Text

from gemuco.errors import SchemaError
from hal.config import RobotConfig
from services.client import Client
from services.demo.actor import Stage
from services.demo.gauges import STATES, Ranges, States, element_line, sparkline, strip
from services.errors import ServiceError
from services.watch.robot_watch import Descriptions, snapshot_of
from services.watch.service_rows import service_rows
from services.watch.signal_rows import SignalRow, signal_rows
from services.watch.snapshot import RobotSnapshot
from services.watch.trouble import verdict
from services.wire.plain_text import plain

EVERY = 0.2
"""The terminal is written at this interval [s]."""
SPARK_EVERY = 0.5
"""One letter of the sparkline is the largest score of this time [s]."""
SPARKS = 120
MOST_ROWS = 7
"""A signal of at most this number of elements has a row per element; others have one letter per element."""
LEAST_BAR, MOST_BAR = 8, 30
MARKS = {True: ("✓", "bold green"), False: ("✗", "bold red")}


def waiting(console: Console, text: str) -> AbstractContextManager[object]:
    """Return a context manager that shows a text with a spinner, if the output is a terminal."""
    return console.status(text) if console.is_terminal else nullcontext()


class Screen:
    """Output of a story: plain lines, and a live view while one is open."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._view: LiveView | None = None

    @contextmanager
    def live(self, robot: RobotConfig, client: Client, play: "Play", services: Collection[str]) -> Iterator[None]:
        """Open a live view until the block ends, if the output is a terminal."""
        if not self._console.is_terminal:
            yield
            return
        with LiveView(self._console, robot, client, play, services) as self._view:
            yield
        self._view = None

    def report(self, text: str) -> None:
        """Print a line of text on an event, or show it in the live view."""
        if self._view is None:
            self._console.print(text)
        else:
            self._view.report(text)

    def turn(self) -> None:
        """Write what is due in the live view; call it often."""
        if self._view is not None:
            self._view.turn()


@dataclass(frozen=True, slots=True)
class Play:
    """Facts on the story that the view shows.

    Attributes:
        names: Names of all stages.
        played: Stages played so far; the caller appends to it.
        shown: Signals with a row per element; others have one letter per element.
        footer: Returns the last lines.
    """

    names: Sequence[str]
    played: Sequence[Stage]
    shown: Sequence[str]
    footer: Callable[[], Sequence[str]]


class LiveView:
    """A context manager that keeps the lower part of the terminal; call `turn` often.

    Args:
        console: A terminal.
        robot: Content of the robot file.
        client: Client of the robot.
        play: The story.
        services: Names of the running services.
    """

    def __init__(
        self, console: Console, robot: RobotConfig, client: Client, play: Play, services: Collection[str]
    ) -> None:
        self._console, self._robot, self._client, self._play = console, robot, client, play
        self._alive = frozenset(services)
        self._descriptions = Descriptions()
        self._ranges, self._states = Ranges(limits_of(robot)), States()
        self._sparks: deque[tuple[float, bool]] = deque(maxlen=SPARKS)
        self._spark_at = self._turn_at = -math.inf
        self._events: deque[str] = deque(maxlen=1)
        self._begun = time.monotonic()
        self._live = Live(console=console, auto_refresh=False, vertical_overflow="crop")

    def __enter__(self) -> Self:
        self._live.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if error is None:
            self._turn_at = -math.inf
            self.turn()
        self._live.stop()

    def report(self, text: str) -> None:
        """Show an event until the next one; warnings stay above the view."""
        if text.lstrip().startswith(("[yellow]", "[red]")):
            self._live.console.print(text)
        elif not text.startswith(" "):  # the measured values are below their stage
            self._events.append(text)

    def turn(self) -> None:
        """Write what is due."""
        now = time.monotonic()
        if now - self._turn_at < EVERY:
            return
        self._turn_at = now
        self._live.update(self.view(self._snapshot(), now), refresh=True)

    def _snapshot(self) -> RobotSnapshot:
        with contextlib.suppress(ServiceError, SchemaError):  # asked again; until then elements have numbers as names
            self._descriptions.update(self._client, self._alive)
        answers = self._descriptions.answers
        return snapshot_of(self._client, self._alive, hal=answers["hal"], model=answers["model"])

    def view(self, snapshot: RobotSnapshot, now: float) -> Group:
        """Return everything, in at most as many lines as the terminal has."""
        below = [*self._signals(snapshot, now), self._anomaly(snapshot, now), self._loops(snapshot)]
        footer = [Text.from_markup(event) for event in self._events]
        footer += [Text(line, style="dim") for line in self._play.footer()]
        room = self._console.height - len(below) - len(footer) - len(self._play.names) - 3
        lines = [self._title(now), *self._stages(room), Text(""), *below, *footer]
        for line in lines:
            line.no_wrap, line.overflow = True, "ellipsis"
        return Group(*lines)

    def _title(self, now: float) -> Text:
        minutes, seconds = divmod(int(now - self._begun), 60)
        title = Text.assemble((f"{self._robot.robot} {minutes}:{seconds:02d}", "bold"))
        for state in ("measured", "estimated", "distrusted", "lost", "recovered"):
            title += Text.assemble(("  ■ ", STATES[state]), (state, "dim"))
        return title

    def _stages(self, room: int) -> list[Text]:
        """Return one line per stage, and the measured values of the latest stages in at most `room` lines."""
        played, blocks = list(self._play.played), []
        for index, name in reversed(list(enumerate(self._play.names))):
            if index < len(played):
                stage = played[index]
                mark, style = MARKS[stage.observed]
                lines = [Text.assemble((f" {mark} ", style), name)]
                figures = [Text(f"     {plain(figure, 300)}", style="dim") for figure in stage.figures]
                lines += figures[: max(0, room)]
                room -= len(lines) - 1
            elif index == len(played):
                spinner = "◐◓◑◒"[int(4.0 * time.monotonic()) % 4]
                lines = [Text.assemble((f" {spinner} ", "bold cyan"), (name, "bold"))]
            else:
                lines = [Text(f" ○ {name}", style="dim")]
            blocks.append(lines)
        return [line for lines in reversed(blocks) for line in lines]

    def _signals(self, snapshot: RobotSnapshot, now: float) -> list[Text]:
        rows = signal_rows(snapshot)
        lines: list[Text] = []
        for signal in sorted({row.signal for row in rows}, key=self._order):
            own = [row for row in rows if row.signal == signal]
            title = f"{plain(signal, 30)} [{plain(own[0].unit, 10)}]"
            if signal in self._play.shown and len(own) <= MOST_ROWS:
                lines.append(Text(title, style="bold"))
                lines += [self._element(row, index, now) for index, row in enumerate(own)]
            else:
                states = [self._states.of(row, now)[0] for row in own]
                bars = strip([self._ranges.share(row) for row in own], [STATES[state] for state in states])
                lines.append(Text(f"{title:<26} ", style="bold") + bars + self._extremes(own))
        return lines

    def _element(self, row: SignalRow, index: int, now: float) -> Text:
        state = self._states.of(row, now)
        off = math.nan
        truth = self._client.truth() if state[0] in ("estimated", "distrusted") else None
        if truth is not None and row.signal in truth.values:
            off = abs(row.value - float(truth.values[row.signal][index]))
        return element_line(row, self._ranges.share(row), state, off, self._room(76, MOST_BAR))

    @staticmethod
    def _extremes(rows: Sequence[SignalRow]) -> Text:
        values = [row.value for row in rows if math.isfinite(row.value)]
        return Text(f" {min(values):.3g} to {max(values):.3g}" if values else " no values", style="dim")

    def _order(self, signal: str) -> tuple[bool, str]:
        return signal not in self._play.shown, signal

    def _anomaly(self, snapshot: RobotSnapshot, now: float) -> Text:
        judged = verdict(snapshot)
        is_known = judged is not None and judged.kind != "unknown"
        ratio = math.nan if judged is None else judged.score / judged.threshold
        if now - self._spark_at >= SPARK_EVERY:
            self._spark_at = now
            self._sparks.append((ratio, is_known))
        elif self._sparks and ratio > self._sparks[-1][0]:
            self._sparks[-1] = ratio, is_known
        line = Text.assemble(("anomaly ", "bold"), sparkline(list(self._sparks), self._room(60, 60)))
        if judged is None or not math.isfinite(judged.score):
            return line.append(" not judged", style="dim")
        line.append(f" {judged.score:.1f}, threshold {judged.threshold:.1f}")
        if judged.is_anomaly:
            return line.append(f"  ANOMALY: {plain(judged.blamed) or 'cause not known yet'}", style="bold red")
        words = "normal not known on this body yet" if judged.kind == "unknown" else judged.kind
        return line.append(f"  {words}", style="dim")

    def _loops(self, snapshot: RobotSnapshot) -> Text:
        """Return the lateness of every loop, the largest first: it is cut in a narrow terminal."""
        services = [service for service in service_rows(snapshot) if service.is_present]
        loops = [loop for service in services for loop in service.loops if math.isfinite(loop.p99)]
        line = Text.assemble(("lateness", "bold"), (" p99 ms", "dim"))
        for loop in sorted(loops, key=lambda loop: -loop.p99):
            style = "yellow" if loop.is_late or loop.is_slow else "green"
            line += Text.assemble((f"  {plain(loop.name, 12)} ", "dim"), (f"{1e3 * loop.p99:.2f}", style))
        return line

    def _room(self, taken: int, most: int) -> int:
        """Return the width of a picture beside text of `taken` letters, at most `most`."""
        return max(LEAST_BAR, min(most, self._console.width - taken))


def limits_of(robot: RobotConfig) -> dict[str, tuple[float, float]]:
    """Return element -> lowest and highest value in the robot file [its unit]; infinite where not stated."""
    limits: dict[str, tuple[float, float]] = {}
    for name, signal in robot.signals.items():
        low, high = robot.bounds(name)
        for index, element in enumerate(signal.elements):
            limits[f"{name}.{element}"] = float(low[index]), float(high[index])
    return limits
