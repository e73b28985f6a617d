"""`gemuco top` without a robot: all robots of a network in one table, trouble first."""

import time
from collections.abc import Iterable, Sequence

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.table import Table
from rich.text import Text

from services import show
from services.verbs.fleet_watch import SILENT_AFTER, FleetWatch, Glance, Level
from services.wire.plain_text import plain

REFRESH = 0.5
FIRST_WAIT = 2.5
"""How long [s] to wait for the first statuses when printing only once."""
STYLES = {
    Level.GOOD: "green",
    Level.DEGRADED: "yellow",
    Level.ANOMALY: "bold yellow",
    Level.TROUBLE: "bold red",
    Level.GONE: "red",
}
LATE = 0.02
"""Lateness of a loop [s] that is worth a color."""
LONGEST = 200
"""Letters of a sentence that are shown."""


def watch_fleet(once: bool, connect: Iterable[str], console: Console | None = None) -> int:
    """Show all robots until Ctrl-C, or once.

    Args:
        once: Print once, without taking over the terminal.
        connect: Endpoints, such as a router's, and role files; without any the robots of this machine are shown.
        console: Where to print.

    Returns:
        0 if there are robots and none of them is in trouble, has an anomaly or has gone; else 1.

    Raises:
        ServiceUnavailable: The router is not there.
    """
    console = console or show.console()
    where = tuple(connect)
    with FleetWatch(where) as fleet:
        if once:
            deadline = time.monotonic() + FIRST_WAIT
            while not fleet.is_told() and time.monotonic() < deadline:
                time.sleep(0.05)
            glances = fleet.glances()
            console.print(view(glances, fleet, where))
            return 0 if glances and max(one.level for one in glances) < Level.ANOMALY else 1
        with Live(console=console, screen=console.is_terminal, auto_refresh=False) as live:
            while True:
                fleet.look()
                live.update(view(fleet.glances(), fleet, where), refresh=True)
                time.sleep(REFRESH)


def view(glances: Sequence[Glance], fleet: FleetWatch, connect: Sequence[str]) -> RenderableType:
    """The table, or why there is none."""
    notes = []
    if not fleet.has_router:
        notes.append(Text(f"No link to {', '.join(connect)}: what is shown is old.", style="bold red"))
    if fleet.rejected:
        notes.append(Text(f"{fleet.rejected} messages could not be read.", style="yellow"))
    if fleet.strange:
        notes.append(Text(f"{fleet.strange} messages are of no service or of too many robots.", style="yellow"))
    if not glances:
        place = f"through {', '.join(connect)}" if connect else "on this machine; others are behind a router: --connect"
        return Group(*notes, Text(f"No robot is seen {place}."))
    return Group(*notes, table(glances))


def table(glances: Sequence[Glance]) -> Table:
    """A row for each robot, in the order given."""
    counts = {level: sum(one.level == level for one in glances) for level in reversed(Level)}
    told = ", ".join(f"{count} {level.name.lower()}" for level, count in counts.items() if count)
    found = Table(title=f"{len(glances)} robots: {told}", title_justify="left", expand=True)
    found.add_column("robot", no_wrap=True)
    found.add_column("health", no_wrap=True)
    for column in ("services", "motors", "who commands"):
        found.add_column(column)
    found.add_column("meas/est/none", justify="right", no_wrap=True)
    found.add_column("anomaly")
    found.add_column("worst late ms", justify="right")
    found.add_column("heard s", justify="right")
    found.add_column("what is wrong", ratio=1, min_width=20)
    for one in glances:
        found.add_row(*_row(one))
    return found


def _row(one: Glance) -> list[Text | str]:
    style = STYLES[one.level]
    measured = "-" if one.measured is None else "/".join(map(str, one.measured))
    late = Text("-")
    if one.late is not None:
        late = Text(f"{1e3 * one.late[0]:.1f} {plain(one.late[1], 20)}", style="yellow" if one.late[0] > LATE else "")
    return [
        _said(one.robot, style),
        Text(one.level.name.lower(), style=style),
        " ".join(one.services) or "-",
        _said(one.motors),
        _said(one.holder),
        Text(measured, style="yellow" if one.measured is not None and any(one.measured[1:]) else ""),
        _said(one.anomaly, "bold yellow" if one.level == Level.ANOMALY else ""),
        late,
        Text(f"{one.age:.1f}", style="red" if one.age > SILENT_AFTER else ""),
        _said(one.text, style) if one.text else "",
    ]


def _said(text: str, style: str = "") -> Text:
    """What came from elsewhere: no markup, nothing that steers a terminal, and not without end."""
    return Text(plain(text, LONGEST) or "-", style=style)
