"""The one judge of what is wrong with a robot and how bad it is, for the page and both kinds of `gemuco top`."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from services.watch.service_rows import Level, ServiceRow, needed, service_rows
from services.watch.signal_rows import Kind, SignalRow
from services.watch.snapshot import RobotSnapshot, fresh
from services.wire.query import starter

NAMED = 3
"""At most this number of elements of a signal is named; the others are counted."""
TITLES = {"hal": "HAL", "model": "Model", "vision": "Camera", "simulator": "Simulator", "recorder": "Recorder"}


LEARNING = (
    "The body is not the one whose normal errors the model knows, or its tool is beyond the trained ones. If it is "
    "healthy, let it move, then run `gemuco query ROBOT normal`; a new tool needs data of its own."
)
"""This explains a body on which nothing can be called an anomaly yet."""


@dataclass(frozen=True, slots=True)
class Trouble:
    """One thing that is wrong: a title of a few words and an explanation."""

    level: Level
    title: str
    text: str = ""

    def __str__(self) -> str:
        return f"{self.title}: {self.text}" if self.text else self.title


HEALTHY = Trouble(Level.GOOD, "Healthy", "All signals are measured, and the body is as the model knows it.")


@dataclass(frozen=True, slots=True)
class AnomalyVerdict:
    """Anomaly verdict of the model.

    Attributes:
        kind: `normal`, `environment`, `anomaly`, `unknown` while what is normal was not learned on this body, `outside`
            of what was learned, or empty while there is nothing to judge.
        score: Anomaly score; NaN if it is not known.
        threshold: Score above which the body is not normal; NaN if it is not known.
        is_anomaly: Whether the score has been above the threshold for as long as the robot file requires.
        blamed: Element or part that is most likely wrong, or that is furthest outside of its learned range.
    """

    kind: str
    score: float
    threshold: float
    is_anomaly: bool
    blamed: str

    def __str__(self) -> str:
        return f"anomaly in {self.blamed}" if self.is_anomaly and self.blamed else self.kind


def troubles(snapshot: RobotSnapshot, rows: Sequence[SignalRow] = ()) -> list[Trouble]:
    """Return everything that is wrong with a robot, worst first; `rows` are those of `signal_rows`."""
    return sorted(_troubles(snapshot, rows), key=lambda trouble: -trouble.level)


def verdict(snapshot: RobotSnapshot) -> AnomalyVerdict | None:
    """Return the model's present anomaly verdict, from its stream or from its status; None if there is none."""
    if snapshot.has_streams:
        anomaly = fresh(snapshot.anomaly)
        if anomaly is None:
            return None
        # Before its verdict an anomaly has only the largest part of the present sample, which is no evidence.
        blamed = anomaly.blamed if anomaly.is_anomaly and anomaly.verdict else ""
        return AnomalyVerdict(anomaly.verdict, anomaly.score, anomaly.threshold, anomaly.is_anomaly, blamed)
    facts = snapshot.facts("model").get("anomaly")
    if not isinstance(facts, dict) or not facts:
        return None
    kind, blamed = (text if isinstance(text := facts.get(name), str) else "" for name in ("verdict", "blamed"))
    score, threshold = (_number(facts.get(name)) for name in ("score", "threshold"))
    return AnomalyVerdict(kind, score, threshold, facts.get("is_anomaly") is True, blamed)


def _number(fact: object) -> float:
    return float(fact) if isinstance(fact, int | float) else math.nan


def _troubles(snapshot: RobotSnapshot, rows: Sequence[SignalRow]) -> Iterator[Trouble]:
    if not snapshot.linked:
        text = snapshot.link_text or "There is no connection to the robot's network."
        yield Trouble(Level.GONE, "Router gone", text)
        return
    for text in snapshot.refused:
        yield Trouble(Level.TROUBLE, "Unreadable message", f"{text} Update the older of both programs.")
    for text in snapshot.disordered:
        yield Trouble(Level.NOTE, "Messages out of order", text)
    is_heard = any(newest.is_fresh for newest in (snapshot.sample, *snapshot.statuses.values()) if newest is not None)
    if not snapshot.alive and not is_heard:
        yield _gone(snapshot)
        return
    for service in snapshot.twins:
        text = f"Two '{service}' services publish under this name: give one robot another name."
        yield Trouble(Level.TROUBLE, "Name used twice", text)
    yield from _services(snapshot)
    yield from _streams(snapshot)
    yield from _signals(rows)
    yield from _body(snapshot)


def _gone(snapshot: RobotSnapshot) -> Trouble:
    if not math.isfinite(snapshot.age):
        return Trouble(Level.GONE, "No robot", f"Is '{snapshot.robot}' its name, and is {starter('hal')} running?")
    since = f"Nothing has been heard for {snapshot.age:.0f} s."
    if any(newest.message.state == "stopping" for newest in snapshot.statuses.values()):
        return Trouble(Level.GONE, "Robot gone", f"{since} It was stopped on request.")
    return Trouble(Level.GONE, "Robot gone", f"{since} Is {starter('hal')} running?")


def _services(snapshot: RobotSnapshot) -> Iterator[Trouble]:
    """Yield services that are missing or frozen, or whose status is not `running` or `ready`."""
    for row in service_rows(snapshot):
        title = TITLES[row.name]
        if row.state in ("gone", "absent"):
            if row.name in needed(snapshot):
                yield _missing(snapshot, row)
        elif row.is_frozen:
            yield Trouble(
                Level.TROUBLE, f"{title} service silent", "It is alive and publishes no status: is it frozen?"
            )
        elif row.state == "fault":
            yield Trouble(Level.TROUBLE, f"{title} fault", row.text)
        elif row.state in ("running", "ready"):
            if row.text:
                yield Trouble(Level.NOTE, f"{title} {row.state}", row.text)
        # The rows of the signals name the estimated elements more exactly than the model's status.
        elif row.is_present and not (snapshot.has_streams and row.text.startswith("Estimating")):
            yield Trouble(Level.DEGRADED, f"{title} {row.state}", row.text)


def _missing(snapshot: RobotSnapshot, row: ServiceRow) -> Trouble:
    title = f"{TITLES[row.name]} service gone"
    if row.name == "hal" and fresh(snapshot.sample) is not None:
        return Trouble(Level.DEGRADED, title, "Its samples still arrive; its token does not.")
    since = f"Its last status is {row.age:.0f} s old. " if math.isfinite(row.age) else ""
    effect = "Only measured values are known. " if row.name == "model" else ""
    return Trouble(row.level, title, f"{since}{effect}Is {starter(row.name)} running?")


def _streams(snapshot: RobotSnapshot) -> Iterator[Trouble]:
    """Yield live services whose samples or estimates do not arrive."""
    if not snapshot.has_streams:
        return
    if fresh(snapshot.sample) is None:
        if "hal" in snapshot.alive:
            since = f"Nothing was measured for {snapshot.sample.age:.0f} s. " if snapshot.sample else ""
            yield Trouble(Level.TROUBLE, "Robot silent", f"{since}The HAL is alive, and no sample arrives.")
    elif "model" in snapshot.alive and fresh(snapshot.estimate) is None:
        yield Trouble(Level.TROUBLE, "Model service silent", "It is alive, and no estimate arrives.")


def _signals(rows: Sequence[SignalRow]) -> Iterator[Trouble]:
    estimated = [row for row in rows if row.kind is Kind.ESTIMATED and not row.distrust]
    masked = [row for row in rows if row.kind is Kind.MASKED and not row.distrust]
    for row in [row for row in rows if row.distrust]:
        instead = (
            f"estimated from {row.source}" if row.source else "estimated" if row.kind is Kind.ESTIMATED else "masked"
        )
        yield Trouble(Level.ANOMALY, "Sensor distrusted", f"{row.name} is {instead}, {row.distrust}.")
    if estimated:
        sources = " and ".join(dict.fromkeys(row.source for row in estimated if row.source))
        origin = f" from {sources}" if sources else ""
        yield Trouble(Level.DEGRADED, "Sensor lost", f"{_names(estimated)} {_is(estimated)} estimated{origin}.")
    for state, level in (("unknown", Level.DEGRADED), ("doubtful", Level.NOTE)):
        bad = [row for row in estimated if row.state == state]
        if bad:
            reasons = "; ".join(dict.fromkeys(row.reason for row in bad if row.reason))
            yield Trouble(level, f"Estimate {state}", f"{_names(bad)}: {reasons or 'no reason was given'}.")
    if masked:
        text = f"{_names(masked)} {_is(masked)} neither measured nor estimated."
        yield Trouble(Level.DEGRADED, "Not measured", text)


def _body(snapshot: RobotSnapshot) -> Iterator[Trouble]:
    manifest = snapshot.model.get("manifest")
    poor = manifest.get("poor") if isinstance(manifest, dict) else None
    if poor:
        names = " and ".join(map(str, poor))
        yield Trouble(Level.NOTE, "Poor model", f"The error of {names} is above the threshold of the training.")
    yield from _suspects(snapshot)
    judged = verdict(snapshot)
    if judged is None:
        return
    score = f" Score {judged.score:.1f}, threshold {judged.threshold:.1f}." if math.isfinite(judged.score) else ""
    if judged.kind == "unknown":
        yield Trouble(Level.NOTE, "Normal not known", f"{LEARNING}{score}")
    elif judged.kind == "environment":
        text = f"Another condition of the body explains what is measured.{score}"
        yield Trouble(Level.NOTE, "Environment changed", text)
    elif judged.kind == "outside":
        text = f"{judged.blamed} is outside of its learned range; larger errors are to be expected there.{score}"
        yield Trouble(Level.NOTE, "Outside of what was learned", text)
    elif judged.is_anomaly:
        small = " The deviation is small and lasts." if judged.score <= judged.threshold else ""
        text = f"Most likely wrong: {judged.blamed or 'not known yet'}.{small}{score}"
        yield Trouble(Level.ANOMALY, "Anomaly", text)


def _suspects(snapshot: RobotSnapshot) -> Iterator[Trouble]:
    """Yield the sensors that are suspected and still used, from the model's status."""
    trust = snapshot.facts("model").get("trust")
    findings = trust.get("findings") if isinstance(trust, dict) else None
    for finding in findings if isinstance(findings, list) else []:
        if isinstance(finding, dict) and finding.get("state") == "suspect" and isinstance(finding.get("text"), str):
            yield Trouble(Level.NOTE, "Sensors contradict each other", finding["text"])


def _names(rows: Sequence[SignalRow]) -> str:
    """Return the signals with their elements, in words."""
    names: list[str] = []
    for signal in dict.fromkeys(row.signal for row in rows):
        elements = [row.element for row in rows if row.signal == signal]
        more = f" and {len(elements) - NAMED} more" if len(elements) > NAMED else ""
        names.append(f"{signal} ({', '.join(elements[:NAMED])}{more})")
    return ", ".join(names)


def _is(rows: Sequence[SignalRow]) -> str:
    return "is" if len(rows) == 1 else "are"
