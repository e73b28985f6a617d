"""`gemuco top ROBOT`: one running robot in a terminal."""

import contextlib
import math
import time
from collections.abc import Iterable, Sequence

import numpy as np
from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.table import Table
from rich.text import Text

from services import show
from services.client import Client
from services.errors import ServiceError
from services.watch.robot_watch import Descriptions, snapshot_of
from services.watch.service_rows import Level, LoopRow, ServiceRow, service_rows
from services.watch.signal_rows import Kind, SignalRow, signal_rows
from services.watch.snapshot import RobotSnapshot, fresh
from services.watch.trouble import troubles, verdict
from services.wire.messages import Update
from services.wire.plain_text import plain

REFRESH = 0.25
"""The terminal is written at this interval [s]."""
FIRST_WAIT = 2.0
"""`--once` waits at most this time [s] for the first messages."""
STYLES = {
    Level.GOOD: "green",
    Level.NOTE: "cyan",
    Level.DEGRADED: "yellow",
    Level.ANOMALY: "bold yellow",
    Level.TROUBLE: "bold red",
    Level.GONE: "red",
}


def watch(robot: str, once: bool, connect: Iterable[str], console: Console | None = None) -> int:
    """Show the robot until Ctrl-C, or once; return 1 if none of its services is alive.

    Args:
        robot: Name of the robot.
        once: Print once, without taking over the terminal.
        connect: Endpoints, such as a router's, and role files.
        console: Output; standard output if not given.
    """
    console = console or show.console()
    with Client(robot, connect) as client:
        descriptions = Descriptions()
        if once:
            snapshot = _first(client, descriptions)
            console.print(view(snapshot))
            return 0 if snapshot.alive else 1
        with Live(console=console, screen=console.is_terminal, auto_refresh=False) as live:
            while True:
                live.update(view(_snapshot(client, descriptions)), refresh=True)
                time.sleep(REFRESH)


def _snapshot(client: Client, descriptions: Descriptions) -> RobotSnapshot:
    alive = client.alive()
    with contextlib.suppress(ServiceError):  # without a description, elements have numbers as names
        descriptions.update(client, alive)
    answers = descriptions.answers
    return snapshot_of(client, alive, hal=answers["hal"], model=answers["model"])


def _first(client: Client, descriptions: Descriptions) -> RobotSnapshot:
    """Wait until every live service has published its status, and return the snapshot."""
    deadline = time.monotonic() + FIRST_WAIT
    while True:
        snapshot = _snapshot(client, descriptions)
        is_complete = bool(snapshot.alive) and all(fresh(snapshot.statuses.get(name)) for name in snapshot.alive)
        if time.monotonic() > deadline or is_complete:
            return snapshot
        time.sleep(0.05)


def view(snapshot: RobotSnapshot) -> RenderableType:
    """Return everything that is known of the robot: troubles, services, loops, signals, anomaly score, update."""
    services, rows = service_rows(snapshot), signal_rows(snapshot)
    notes = (Text(plain(str(trouble)), style=STYLES[trouble.level]) for trouble in troubles(snapshot, rows))
    motors = plain(snapshot.motors) or "not known"
    return Group(
        Text(f"{snapshot.robot}   motors: {motors}   lease holder: {plain(snapshot.lease_holder)}"),
        _services(services),
        *notes,
        _loops(services),
        _signals(rows),
        _anomaly(snapshot),
        _update(fresh(snapshot.update)),
    )


def _services(services: Sequence[ServiceRow]) -> Table:
    table = Table()
    for column in ("service", "state", ""):
        table.add_column(column)
    for row in services:
        style = STYLES[row.level]
        table.add_row(row.name, Text(plain(row.state), style=style), Text(plain(row.text)))
    return table


def _loops(services: Sequence[ServiceRow]) -> Table:
    table = Table(title="loops", title_justify="left")
    table.add_column("loop", no_wrap=True)
    for column in ("want Hz", "Hz", "late p50", "p99", "max ms", "skips", "busy %"):
        table.add_column(column, justify="right")
    for service in services:
        for loop in service.loops if service.is_present else ():
            table.add_row(*_loop(loop))
    return table


def _loop(loop: LoopRow) -> list[Text]:
    return [
        Text(plain(loop.name)),
        Text(f"{loop.wanted:.1f}"),
        Text(f"{loop.rate:.1f}", style="yellow" if loop.is_slow else ""),
        Text(f"{1e3 * loop.p50:.2f}"),
        Text(f"{1e3 * loop.p99:.2f}"),
        Text(f"{1e3 * loop.worst:.2f}", style="yellow" if loop.is_late else ""),
        Text(f"{loop.skipped:.0f}"),
        Text(f"{100 * loop.busy:.0f}"),
    ]


def _signals(rows: Sequence[SignalRow]) -> Table:
    table = Table(title="signals", title_justify="left")
    table.add_column("signal", no_wrap=True)
    table.add_column("valid", justify="right")
    table.add_column("age ms", justify="right")
    for column in ("estimate", "from", "values"):
        table.add_column(column)
    for signal in dict.fromkeys(row.signal for row in rows):
        own = [row for row in rows if row.signal == signal]
        kinds = [row.kind for row in own]
        estimated = next((row for row in own if row.kind is Kind.ESTIMATED), None)
        ages = [row.age for row in own if not math.isnan(row.age)]
        is_measured = all(kind is Kind.MEASURED for kind in kinds)
        method = estimated.method if estimated is not None else "measured" if is_measured else "none"
        state = estimated.state if estimated is not None and estimated.state != "known" else ""
        table.add_row(
            plain(signal),
            f"{kinds.count(Kind.MEASURED)}/{len(own)}",
            f"{1e3 * max(ages):.1f}" if ages else "-",
            Text(plain(f"{method}, {state}" if state else method), style=_style(is_measured, method, state)),
            Text(plain(estimated.source) if estimated is not None else "-"),
            _numbers([math.nan if row.kind is Kind.OLD else row.value for row in own], kinds),
        )
    return table


def _style(is_measured: bool, method: str, state: str) -> str:
    if is_measured:
        return "green"
    return "red" if method == "none" or state == "unknown" else "yellow"


def _numbers(values: Sequence[float] | np.ndarray, kinds: Sequence[Kind] = ()) -> str:
    """Return values in words, those that were estimated with `*`."""
    digits = 1 if np.nanmax(np.abs(values), initial=0.0) >= 10 else 3
    marks = ["*" if kind is Kind.ESTIMATED else "" for kind in kinds] or [""] * len(values)
    return " ".join(f"{value:.{digits}f}{mark}" for value, mark in zip(values, marks, strict=True))


def _anomaly(snapshot: RobotSnapshot) -> Text:
    judged = verdict(snapshot)
    if judged is None or not math.isfinite(judged.score):
        return Text("anomaly: not judged")
    level = Level.NOTE if judged.kind in ("environment", "unknown", "outside") else Level.GOOD
    level = Level.ANOMALY if judged.is_anomaly else level
    words = {"unknown": "; normal is not known on this body yet", "outside": "; outside of what was learned"}
    state = words.get(judged.kind, "")
    return Text(f"anomaly: score {judged.score:.1f}, threshold {judged.threshold:.1f}{state}", style=STYLES[level])


def _update(update: Update | None) -> Text:
    if update is None:
        return Text("update: not known")
    state = "resting" if not update.active else "learning" if update.settled else "recognising"
    text = f"update: {state}, model {update.model_version}, window {update.window}, loss {update.loss:.4f}"
    if len(update.bias):
        text += f", p {_numbers(update.bias)}"
    return Text(f"{text}, W rolled back {update.rolled_back} times" if update.rolled_back else text)
