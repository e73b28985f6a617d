"""`gemuco top` without a robot: all robots of a network in one table, the worst first."""

import math
import time
from collections.abc import Iterable, Sequence
from typing import Any

from rich import box
from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.table import Table
from rich.text import Text

from services import show
from services.client.live import FRESH_STATUS
from services.verbs.top import STYLES
from services.watch.fleet_watch import FleetWatch
from services.watch.service_rows import Level, service_rows
from services.watch.snapshot import RobotSnapshot
from services.watch.trouble import HEALTHY, Trouble, troubles, verdict
from services.wire import keys
from services.wire.plain_text import plain

REFRESH = 0.5
"""The terminal is written at this interval [s]."""
FIRST_WAIT = 2.5
"""`--once` waits at most this time [s] for the first statuses."""
LONGEST = 200
"""At most this number of letters of a sentence is shown."""
WIDE = 150
"""A terminal of at least this number of columns has a column per fact; a narrower one lists them below the sentence."""
LONGEST_NAME = 20


def watch_fleet(once: bool, connect: Iterable[str], console: Console | None = None) -> int:
    """Show all robots until Ctrl-C, or once.

    Args:
        once: Print once, without taking over the terminal.
        connect: Endpoints, such as a router's, and role files; without any the robots of this machine are shown.
        console: Output; standard output if not given.

    Returns:
        0 if there are robots, and all of them are good or degraded; else 1.

    Raises:
        ServiceUnavailable: The router does not answer.
    """
    console = console or show.console()
    where = tuple(connect)
    with FleetWatch(where) as fleet:
        if once:
            deadline = time.monotonic() + FIRST_WAIT
            while not fleet.is_complete() and time.monotonic() < deadline:
                time.sleep(0.05)
            robots = ranked(fleet.snapshots())
            console.print(view(robots, fleet, where, console.width))
            return 0 if robots and robots[0][1].level < Level.ANOMALY else 1
        with Live(console=console, screen=console.is_terminal, auto_refresh=False) as live:
            while True:
                fleet.look()
                live.update(view(ranked(fleet.snapshots()), fleet, where, console.width), refresh=True)
                time.sleep(REFRESH)


def ranked(snapshots: Iterable[RobotSnapshot]) -> list[tuple[RobotSnapshot, Trouble]]:
    """Return each robot with its worst trouble, the worst robot first, then by name."""
    robots = [(snapshot, next(iter(troubles(snapshot)), HEALTHY)) for snapshot in snapshots]
    return sorted(robots, key=lambda robot: (-robot[1].level, robot[0].robot))


def view(
    robots: Sequence[tuple[RobotSnapshot, Trouble]], fleet: FleetWatch, connect: Sequence[str], width: int = WIDE
) -> RenderableType:
    """Return the table for a terminal of this width, or the reason why there is none."""
    notes = []
    if not fleet.has_router:
        notes.append(Text(f"No link to {', '.join(connect)}: the table is old.", style="bold red"))
    if fleet.rejected:
        notes.append(Text(f"{fleet.rejected} messages could not be read.", style="yellow"))
    if fleet.strange:
        notes.append(Text(f"{fleet.strange} messages are of unknown services or of too many robots.", style="yellow"))
    if not robots:
        place = f"through {', '.join(connect)}" if connect else "on this machine; others are behind a router: --connect"
        return Group(*notes, Text(f"No robot is seen {place}."))
    return Group(*notes, table(robots, width))


def table(robots: Sequence[tuple[RobotSnapshot, Trouble]], width: int = WIDE) -> Table:
    """Return one row per robot, in the order given, for a terminal of this width."""
    counts = {level: sum(worst.level == level for _, worst in robots) for level in reversed(Level)}
    summary = ", ".join(f"{count} {level.name.lower()}" for level, count in counts.items() if count)
    title = f"{len(robots)} robot{'' if len(robots) == 1 else 's'}: {summary}"
    if width < WIDE:
        return _narrow(robots, title)
    table = Table(title=title, title_justify="left", expand=True)
    table.add_column("robot", no_wrap=True)
    table.add_column("health", no_wrap=True)
    for column in ("services", "motors", "lease holder"):
        table.add_column(column)
    table.add_column("meas/est/none", justify="right", no_wrap=True)
    table.add_column("anomaly")
    table.add_column("worst late ms", justify="right")
    table.add_column("heard s", justify="right")
    table.add_column("what is wrong", ratio=1, min_width=20)
    for snapshot, worst in robots:
        table.add_row(*_row(snapshot, worst))
    return table


def _narrow(robots: Sequence[tuple[RobotSnapshot, Trouble]], title: str) -> Table:
    """Return the table for a narrow terminal: most of it belongs to what is wrong, with the facts below."""
    table = Table(title=title, title_justify="left", expand=True, box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0))
    table.add_column("robot", no_wrap=True, max_width=LONGEST_NAME)
    table.add_column("health", no_wrap=True)
    table.add_column("motors", no_wrap=True, max_width=8)
    table.add_column("what is wrong, and facts", ratio=1)
    for snapshot, worst in robots:
        style = STYLES[worst.level]
        wrong = Text(f"{plain(str(worst), LONGEST)}\n" if worst.level > Level.GOOD else "", style=style)
        name, health = _plain(snapshot.robot, style), Text(worst.level.name.lower(), style=style)
        table.add_row(name, health, _plain(snapshot.motors), Text.assemble(wrong, _facts(snapshot)))
    return table


def _facts(snapshot: RobotSnapshot) -> Text:
    """Return everything but the trouble, in one line."""
    counts, judged, holder, age = _signal_counts(snapshot), verdict(snapshot), snapshot.lease_holder, snapshot.age
    facts = []
    if counts:
        words = ("measured", "estimated", "none")
        facts.append(", ".join(f"{count} {word}" for count, word in zip(counts, words, strict=True) if count))
    if judged is not None and judged.kind and not judged.is_anomaly:
        facts.append(plain(str(judged), 40))
    late = _worst_loop(snapshot).plain
    if late != "-":
        facts.append(f"late {late.replace(' ', ' ms ', 1)}")
    if holder not in ("none", "not known"):
        facts.append(f"lease {plain(holder, 40)}")
    facts.append(f"heard {age:.1f} s ago" if math.isfinite(age) else "never heard")
    return Text(" · ".join(facts), style="dim")


def _row(snapshot: RobotSnapshot, worst: Trouble) -> list[Text | str]:
    style = STYLES[worst.level]
    counts, judged = _signal_counts(snapshot), verdict(snapshot)
    holder = snapshot.lease_holder
    age = snapshot.age
    return [
        _plain(snapshot.robot, style),
        Text(worst.level.name.lower(), style=style),
        " ".join(name for name in keys.SERVICES if name in snapshot.alive) or "-",
        _plain(snapshot.motors),
        _plain("" if holder in ("none", "not known") else holder),
        Text("/".join(map(str, counts)) or "-", style="yellow" if any(counts[1:]) else ""),
        _plain("" if judged is None else str(judged), style if judged is not None and judged.is_anomaly else ""),
        _worst_loop(snapshot),
        Text(f"{age:.1f}" if math.isfinite(age) else "-", style="red" if age > FRESH_STATUS else ""),
        _plain(str(worst), style) if worst.level > Level.GOOD else "",
    ]


def _signal_counts(snapshot: RobotSnapshot) -> tuple[int, ...]:
    """Return the numbers of signals that are measured, estimated and neither; empty if the model publishes none."""
    facts = snapshot.facts("model").get("signals")
    counts: list[Any] = []
    if isinstance(facts, dict):
        counts = [facts.get(name) for name in ("measured", "estimated", "none")]
    return tuple(counts) if all(isinstance(count, int) for count in counts) else ()


def _worst_loop(snapshot: RobotSnapshot) -> Text:
    """Return the largest lateness of a loop in the last second, and the loop."""
    loops = [loop for row in service_rows(snapshot) if row.is_present for loop in row.loops if loop.worst >= 0]
    worst = max(loops, key=lambda loop: loop.worst, default=None)
    if worst is None:
        return Text("-")
    return Text(f"{1e3 * worst.worst:.1f} {plain(worst.name, 20)}", style="yellow" if worst.is_late else "")


def _plain(text: str, style: str = "") -> Text:
    """Return text of another program without markup or control characters, and not longer than 200 letters."""
    return Text(plain(text, LONGEST) or "-", style=style)
