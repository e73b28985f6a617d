"""The one sentence that matters most now, and the others below it."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import IntEnum

from services.view.rows import Kind, Row
from services.view.seen import Seen
from services.wire import keys

LINGERS = 1.0
"""How long [s] something worse stays on the page after it has passed, so that the page is quiet."""
NAMED = 3
"""So many elements are named; the rest is counted."""
STARTED_BY = {"hal": "gemuco hal", "model": "gemuco serve"}


class Level(IntEnum):
    """How bad it is; the worst is told first."""

    OK = 0
    NOTE = 1
    """Worth a look."""
    WARN = 2
    """Going on without something."""
    BAD = 3
    """Somebody has to act."""
    GONE = 4
    """Nothing is known any more."""


@dataclass(frozen=True, slots=True)
class Banner:
    """What a person should know first.

    Attributes:
        also: Whatever else is not as it should be, in one sentence each.
    """

    level: Level
    title: str
    text: str
    also: tuple[str, ...] = ()


def banner(seen: Seen, rows: Sequence[Row]) -> Banner:
    """What is the matter, worst first."""
    found = sorted(_troubles(seen, rows), key=lambda one: -one.level)
    if not found:
        return Banner(Level.OK, "Healthy", "All signals are measured, and the body is as the model knows it.")
    worst, *others = found
    return Banner(worst.level, worst.title, worst.text, tuple(f"{one.title}: {one.text}" for one in others))


class Steady:
    """Shows something worse at once, and something milder only after a while."""

    def __init__(self) -> None:
        self._shown: Banner | None = None
        self._seen_at = 0.0

    def show(self, new: Banner, now: float) -> Banner:
        """What to show at this time [monotonic s]."""
        shown = self._shown
        if shown is None or new.level >= shown.level or now - self._seen_at > LINGERS:
            self._shown, self._seen_at = new, now
            return new
        return shown


def _troubles(seen: Seen, rows: Sequence[Row]) -> Iterator[Banner]:
    if not seen.linked:
        yield Banner(Level.GONE, "Router gone", seen.link_text or "There is no connection to the robot's network.")
        return
    yield from _services(seen)
    yield from _lost(rows)
    yield from _judged(seen)
    for name, heard in seen.statuses.items():
        status = seen.fresh(heard)
        if status is None or name not in seen.alive or not status.text:
            continue
        if status.state == "fault":
            yield Banner(Level.BAD, "Fault", status.text)
        elif not (name == "model" and status.text.startswith("Estimating")):  # that is told better above
            level = Level.NOTE if status.state in ("running", "ready", "starting") else Level.WARN
            yield Banner(level, f"{name} {status.state}", status.text)


def _services(seen: Seen) -> Iterator[Banner]:
    is_there, is_measured = "hal" in seen.alive, seen.fresh(seen.sample) is not None
    if not is_measured:
        yield _without_samples(seen, is_there)
    elif not is_there:
        yield Banner(Level.WARN, "HAL service gone", "Its samples still come; its token does not.")
    if "model" not in seen.alive and (is_there or is_measured):
        heard = seen.statuses.get("model")
        since = "" if heard is None else f" {heard.age:.0f} s ago"
        text = f"Last heard of{since}. " if since else ""
        yield Banner(
            Level.BAD,
            "Model service gone",
            f"{text}Only what is measured is shown. Is `{STARTED_BY['model']}` running?",
        )
    elif "model" in seen.alive and is_measured and seen.fresh(seen.estimate) is None:
        yield Banner(Level.BAD, "Model service silent", "It is there, and no estimate comes.")


def _without_samples(seen: Seen, is_there: bool) -> Banner:
    since = "" if seen.sample is None else f"Nothing was measured for {seen.sample.age:.0f} s. "
    if is_there:
        return Banner(Level.GONE, "Robot silent", f"{since}The HAL is there, and no sample comes.")
    title = "Robot gone" if since else "No robot"
    others = sorted(seen.alive & set(keys.SERVICES))
    told = f"Still there: {', '.join(others)}. " if others else ""
    asked = f"Is `{STARTED_BY['hal']}` running? This page goes on by itself when it is back."
    return Banner(Level.GONE, title, f"{since}{told}{asked}")


def _lost(rows: Sequence[Row]) -> Iterator[Banner]:
    estimated = [row for row in rows if row.kind is Kind.ESTIMATED]
    masked = [row for row in rows if row.kind is Kind.MASKED]
    if estimated:
        sources = " and ".join(dict.fromkeys(row.source for row in estimated if row.source))
        yield Banner(
            Level.WARN, "Sensor lost",
            f"{_names(estimated)} {_is(estimated)} estimated{f' from {sources}' if sources else ''}.",
        )  # fmt: skip
    if masked:
        yield Banner(Level.WARN, "Not measured", f"{_names(masked)} {_is(masked)} neither measured nor estimated.")


def _judged(seen: Seen) -> Iterator[Banner]:
    anomaly = seen.fresh(seen.anomaly)
    if anomaly is None:
        return
    compared = f"Score {anomaly.score:.1f}, threshold {anomaly.threshold:.1f}."
    if anomaly.verdict == "environment":
        yield Banner(
            Level.NOTE, "Environment changed", f"Another condition of the body explains what is measured. {compared}"
        )
    elif anomaly.is_anomaly:
        yield Banner(Level.BAD, "Anomaly", f"Most likely wrong: {anomaly.blamed or 'nobody knows'}. {compared}")


def _names(rows: Sequence[Row]) -> str:
    """The elements, or whole signals, in words."""
    names: list[str] = []
    for signal in dict.fromkeys(row.signal for row in rows):
        elements = [row.element for row in rows if row.signal == signal]
        named = ", ".join(elements[:NAMED])
        more = f" and {len(elements) - NAMED} more" if len(elements) > NAMED else ""
        names.append(f"{signal} ({named}{more})")
    return ", ".join(names)


def _is(rows: Sequence[Row]) -> str:
    return "is" if len(rows) == 1 else "are"
