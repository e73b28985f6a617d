"""`gemuco top`: a running robot at a glance."""

import math
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import TypeVar

import numpy as np
from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.table import Table
from rich.text import Text

from services import show
from services.client import Client
from services.client.live import FRESH_STATUS
from services.errors import WrongVersion
from services.wire import keys
from services.wire.messages import Anomaly, Applied, Estimates, Holder, Message, Sample, Status, Update
from services.wire.plain_text import plain

M = TypeVar("M", bound=Message)
REFRESH = 0.25
FIRST_WAIT = 2.0
"""How long [s] to wait for the first messages when printing only once."""
GOOD = {"running", "ready", "measured", "follow", "hold"}


def watch(robot: str, once: bool, connect: Iterable[str], console: Console | None = None) -> int:
    """Show the robot until Ctrl-C, or once; the exit code is 1 if none of its services is there.

    Args:
        robot: The robot's name.
        once: Print once, without taking over the terminal.
        connect: Endpoints, such as a router's, and role files.
        console: Where to print.
    """
    console = console or show.console()
    with Client(robot, connect) as client:
        view(client)  # subscribes
        if once:
            _first_statuses(client)
            console.print(view(client))
            return 0 if client.alive() else 1
        with Live(view(client), console=console, screen=console.is_terminal, auto_refresh=False) as live:
            while True:
                live.update(view(client), refresh=True)
                time.sleep(REFRESH)


def view(client: Client) -> RenderableType:
    """Everything at a glance, of this moment."""
    notes: dict[str, None] = {}

    def read(reader: Callable[[], M | None]) -> M | None:
        try:
            return reader()
        except WrongVersion as error:  # somebody else's program; the others are to be seen all the same
            notes[plain(str(error))] = None
            return None

    statuses = {name: read(lambda name=name: client.status(name)) for name in keys.SERVICES}  # type: ignore[misc]
    samples, estimate = (read(client.sample), read(client.vision)), read(client.estimate)
    parts: list[RenderableType] = [
        _services(client, statuses, read(client.applied)),
        _loops(statuses),
        _signals(samples, estimate),
        _anomaly(read(client.anomaly)),
        _update(read(client.update)),
    ]
    return Group(*parts, *(Text(note, style="bold red") for note in notes))


def _first_statuses(client: Client) -> None:
    """Wait until every service that is alive has told its status once."""
    deadline = time.monotonic() + FIRST_WAIT
    while time.monotonic() < deadline:
        alive = client.alive()
        if alive and all(client.reader(keys.status(client.robot, name), Status).get(FRESH_STATUS) for name in alive):
            return
        time.sleep(0.05)


def _services(client: Client, statuses: Mapping[str, Status | None], applied: Applied | None) -> Table:
    motors = plain(applied.mode) if applied else "not heard of"
    table = Table(title=f"{client.robot}   motors: {motors}   {_commander(client)}", title_justify="left")
    for column in ("service", "state", ""):
        table.add_column(column)
    for name, status in statuses.items():
        if status is not None:
            table.add_row(name, _word(status.state), status.text)
        elif name in _needed(statuses):
            table.add_row(name, _word("absent"), "")
        else:
            table.add_row(name, "-", "")
    return table


def _commander(client: Client) -> str:
    """Who commands, in words."""
    holder = client.reader(keys.holder(client.robot), Holder).get(FRESH_STATUS)
    if holder is None:
        return "who commands: not heard of"
    if not holder.holder:
        return "who commands: nobody"
    through = " through the model" if holder.through else ""
    return f"who commands: {plain(holder.name) or 'somebody without a name'}{through}, {holder.left:.1f} s"


def _needed(statuses: Mapping[str, Status | None]) -> set[str]:
    """The services that this robot cannot do without; whether it has a camera only they know, who read its file."""
    has_camera = any(status is not None and status.facts.get("camera") for status in statuses.values())
    return {"hal", "model", "vision"} if has_camera else {"hal", "model"}


def _loops(statuses: Mapping[str, Status | None]) -> Table:
    table = Table(title="loops", title_justify="left")
    table.add_column("loop", no_wrap=True)
    for column in ("want Hz", "Hz", "late p50", "p99", "max ms", "skips", "busy %"):
        table.add_column(column, justify="right")
    for status in statuses.values():
        for name, loop in (status.loops if status else {}).items():
            late = [f"{1e3 * loop.get(key, math.nan):.2f}" for key in ("late_p50", "late_p99", "late_max")]
            rates = [f"{loop.get(key, math.nan):.1f}" for key in ("rate_wanted", "rate")]
            busy = f"{100 * loop.get('busy', math.nan):.0f}"
            table.add_row(name, *rates, *late, f"{loop.get('skipped', 0):.0f}", busy)
    return table


def _signals(samples: Sequence[Sample | None], estimate: Estimates | None) -> Table:
    table = Table(title="signals", title_justify="left")
    table.add_column("signal", no_wrap=True)
    table.add_column("valid", justify="right")
    table.add_column("age ms", justify="right")
    for column in ("estimate", "from", "values"):
        table.add_column(column)
    measured = {name: sample for sample in samples if sample is not None for name in sample.values}
    for name in dict.fromkeys((*measured, *(estimate.values if estimate else ()))):
        valid = age = method = source = values = "-"
        if (sample := measured.get(name)) is not None:
            valid = f"{int(sample.valid[name].sum())}/{sample.valid[name].size}"
            age = f"{1e3 * float(sample.age[name].max()):.1f}"
            values = _numbers(sample.values[name], np.zeros(sample.values[name].size, bool))
        if estimate is not None and name in estimate.values:
            method, source = estimate.method[name], estimate.mask[name].replace("+", ", ")
            values = _numbers(estimate.values[name], estimate.estimated[name])
        table.add_row(name, valid, age, _word(method), source, values)
    return table


def _numbers(values: np.ndarray, estimated: np.ndarray) -> str:
    digits = 1 if np.nanmax(np.abs(values), initial=0.0) >= 10 else 3
    return " ".join(f"{v:.{digits}f}{'*' if e else ''}" for v, e in zip(values, estimated, strict=True))


def _anomaly(anomaly: Anomaly | None) -> Text:
    if anomaly is None or not math.isfinite(anomaly.score):
        return Text("anomaly: not judged")
    text = f"anomaly: score {anomaly.score:.1f}, threshold {anomaly.threshold:.1f}"
    if anomaly.verdict == "environment":
        return Text(f"{text}: ENVIRONMENT CHANGED, another condition of the body explains it", style="bold yellow")
    if anomaly.is_anomaly:
        return Text(f"{text}: ANOMALY, most of it in {anomaly.blamed}", style="bold red")
    return Text(text, style="green")


def _update(update: Update | None) -> Text:
    if update is None:
        return Text("update: not heard of")
    state = "resting" if not update.active else "learning" if update.settled else "recognising"
    text = f"update: {state}, model {update.model_version}, window {update.window}, loss {update.loss:.4f}"
    if len(update.bias):
        text += f", p {_numbers(update.bias, np.zeros(len(update.bias), bool))}"
    return Text(f"{text}, W rolled back {update.rolled_back} times" if update.rolled_back else text)


def _word(word: str) -> Text:
    return Text(word, style="green" if word in GOOD else "yellow" if word not in ("fault", "absent", "none") else "red")
