"""The one judge of trouble, from all messages of a robot and from its statuses alone."""

import math
from dataclasses import replace

import pytest
from msgspec.structs import replace as msgspec_replace
from rich.console import Console
from talking_robot import BOTH, DESCRIBED, anomaly, estimates, sample, seen

from services.verbs import top
from services.view.markup import anomaly_html, signals_html
from services.watch.service_rows import Level, service_rows
from services.watch.signal_rows import Kind, signal_rows
from services.watch.snapshot import Newest, RobotSnapshot
from services.watch.trouble import HEALTHY, Trouble, troubles, verdict
from services.wire.messages import Holder, Status

SICK = {"verdict": "anomaly", "is_anomaly": True, "blamed": "load.elbow", "score": 30.0, "threshold": 20.0}
CHANGED = {"verdict": "environment", "is_anomaly": False, "blamed": "", "score": 30.0, "threshold": 20.0}
NEW_PROGRAM = "The message has version 3; this program reads 2."


def judged(snapshot: RobotSnapshot) -> Trouble:
    return next(iter(troubles(snapshot, signal_rows(snapshot))), HEALTHY)


def statuses(age: float = 0.1, text: str = "", hal: str = "running", model: str = "running", **facts: object):
    return {
        "hal": Newest(Status(service="hal", state=hal, text=text), age),
        "model": Newest(Status(service="model", state=model, facts=facts), 0.1),
    }


def glance(**attributes: object) -> RobotSnapshot:
    """RobotSnapshot of a fleet view, which reads no streams."""
    facts: dict = {"robot": "arm", "has_streams": False, "alive": BOTH, "statuses": statuses()}
    return RobotSnapshot(**(facts | attributes))


def test_a_measured_value_has_its_age():
    row = signal_rows(seen(age=0.1))[1]
    assert (row.name, row.unit, row.kind, row.value) == ("joint_position.elbow", "rad", Kind.MEASURED, -0.5)
    assert row.age == pytest.approx(0.101)


def test_a_lost_sensor_is_estimated_and_its_sources_are_named():
    row = signal_rows(seen(silent=True))[1]
    assert (row.kind, row.value, row.std, row.source) == (Kind.ESTIMATED, -0.48, 0.02, "muscle_tension")
    text = "joint_position (elbow) is estimated from muscle_tension."
    assert judged(seen(silent=True)) == Trouble(Level.DEGRADED, "Sensor lost", text)


def test_an_estimate_outside_of_what_was_learned_is_said():
    report = msgspec_replace(estimates(True), state={"joint_position": "unknown"}, reason={"joint_position": "too far"})
    moment = replace(seen(silent=True), estimate=Newest(report, 0.01))
    row = signal_rows(moment)[1]
    assert (row.state, row.reason) == ("unknown", "too far")
    assert Trouble(Level.DEGRADED, "Estimate unknown", "joint_position (elbow): too far.") in troubles(
        moment, signal_rows(moment)
    )
    console = Console(width=160)
    with console.capture() as shown:
        console.print(top.view(moment))
    assert "mask, unknown" in shown.get()
    assert ' <span class="lost" title="too far">unknown</span>' in signals_html(signal_rows(moment))


def test_a_poor_model_is_a_note():
    known = judged(seen(model={"manifest": {"poor": ["joint_effort"]}}))
    assert known.level is Level.NOTE
    assert known.title == "Poor model"
    assert "joint_effort" in known.text
    assert judged(seen(model={"manifest": {"poor": []}})) is HEALTHY


@pytest.mark.parametrize("estimate", [None, Newest(estimates(True), 3.0)])
def test_without_a_fresh_estimate_a_lost_element_is_masked(estimate):
    row = signal_rows(seen(silent=True, estimate=estimate))[1]
    assert row.kind is Kind.MASKED
    assert math.isnan(row.value)


def test_an_estimate_from_before_the_loss_is_none_of_the_lost_element():
    row = signal_rows(seen(silent=True, estimate=Newest(estimates(False), 0.01)))[1]
    assert row.kind is Kind.MASKED
    assert math.isnan(row.value)


def test_a_camera_that_no_service_described_is_still_hidden_when_the_model_says_so():
    moment = RobotSnapshot(robot="arm", vision=Newest(sample(), 0.1), estimate=Newest(estimates(True), 0.1))
    assert signal_rows(moment)[1].kind is Kind.ESTIMATED


def test_the_value_of_a_slow_camera_is_measured_as_long_as_the_model_uses_it():
    signals = {"signals": {"joint_position": DESCRIBED["signals"]["joint_position"] | {"source": "vision"}}}
    for is_lost, kind in ((False, Kind.MEASURED), (True, Kind.ESTIMATED)):
        report = Newest(estimates(is_lost), 0.1)
        moment = RobotSnapshot(robot="arm", model=signals, vision=Newest(sample(), 0.9), estimate=report)
        assert signal_rows(moment)[1].kind is kind


FAULT = statuses(hal="fault", text="It broke.")
ENDED = {"hal": Newest(Status(service="hal", state="running"), 9.0)}


@pytest.mark.parametrize(
    ("moment", "level", "title"),
    [
        (seen(), Level.GOOD, "Healthy"),
        (seen(anomaly=Newest(anomaly("anomaly"), 0.0)), Level.ANOMALY, "Anomaly"),
        (seen(anomaly=Newest(anomaly("environment"), 0.0)), Level.NOTE, "Environment changed"),
        (seen(anomaly=Newest(anomaly("outside"), 0.0)), Level.NOTE, "Outside of what was learned"),
        (seen(alive=frozenset({"hal"}), estimate=None), Level.TROUBLE, "Model service gone"),
        (seen(estimate=Newest(estimates(), 3.0)), Level.TROUBLE, "Model service silent"),
        (seen(alive=frozenset({"model"})), Level.DEGRADED, "HAL service gone"),
        (seen(alive=frozenset({"model"}), age=5.0), Level.TROUBLE, "HAL service gone"),
        (seen(age=5.0), Level.TROUBLE, "Robot silent"),
        (seen(age=5.0, alive=frozenset()), Level.GONE, "Robot gone"),
        (RobotSnapshot(robot="arm"), Level.GONE, "No robot"),
        (seen(linked=False, link_text="No answer."), Level.GONE, "Router gone"),
        (seen(refused=(NEW_PROGRAM,)), Level.TROUBLE, "Unreadable message"),
        (seen(disordered=("A sample came twice.",)), Level.NOTE, "Messages out of order"),
        (seen(statuses=FAULT), Level.TROUBLE, "HAL fault"),
        (seen(statuses=statuses(text="A command was refused.")), Level.NOTE, "HAL running"),
        (seen(statuses=statuses(age=9.0)), Level.TROUBLE, "HAL service silent"),
        (glance(), Level.GOOD, "Healthy"),
        (glance(statuses=statuses(anomaly=SICK)), Level.ANOMALY, "Anomaly"),
        (glance(statuses=statuses(anomaly=CHANGED)), Level.NOTE, "Environment changed"),
        (glance(statuses=FAULT), Level.TROUBLE, "HAL fault"),
        (glance(statuses=statuses(model="degraded")), Level.DEGRADED, "Model degraded"),
        (glance(statuses=statuses(hal="starting")), Level.DEGRADED, "HAL starting"),
        (glance(statuses=statuses(age=9.0)), Level.TROUBLE, "HAL service silent"),
        (glance(alive=frozenset({"model"})), Level.TROUBLE, "HAL service gone"),
        (glance(alive=frozenset({"hal"})), Level.TROUBLE, "Model service gone"),
        (glance(statuses=statuses(camera=True)), Level.DEGRADED, "Camera service gone"),
        (glance(twins=("hal",)), Level.TROUBLE, "Name used twice"),
        (glance(alive=frozenset(), statuses=ENDED), Level.GONE, "Robot gone"),
    ],
)  # fmt: skip
def test_every_state_has_its_trouble(moment, level, title):
    worst = judged(moment)
    assert (worst.level, worst.title) == (level, title)


def test_the_worst_is_first():
    moment = seen(silent=True, anomaly=Newest(anomaly("anomaly"), 0.0))
    assert [trouble.title for trouble in troubles(moment, signal_rows(moment))] == ["Anomaly", "Sensor lost"]
    assert "muscle_tension.biceps" in judged(moment).text


def test_a_robot_that_was_stopped_on_request_is_distinguished_from_a_crash():
    stopping = {"hal": Newest(Status(service="hal", state="stopping"), 9.0)}
    crashed = {"hal": Newest(Status(service="hal", state="running"), 9.0)}
    texts = [judged(glance(alive=frozenset(), statuses=status)).text for status in (stopping, crashed)]
    assert "stopped on request" in texts[0]
    assert "Nothing has been heard for 9 s" in texts[1]
    assert "request" not in texts[1]


@pytest.mark.parametrize("facts", [{"mode": ["x"]}, {"signals": 3}, {"anomaly": [1]}, {"anomaly": {"score": "x"}}])
def test_facts_may_hold_anything(facts):
    moment = glance(statuses=statuses(**facts))
    assert not troubles(moment)
    assert moment.motors == ""
    assert verdict(moment) is None or math.isnan(verdict(moment).score)


def test_timing_of_loops_is_judged_by_rate_and_lateness():
    timing = {"good": (199.0, 0.01), "slow": (150.0, 0.01), "late": (200.0, 0.03)}
    loops = {name: {"rate_wanted": 200.0, "rate": rate, "late_max": late} for name, (rate, late) in timing.items()}
    status = Newest(Status(service="hal", state="running", loops=loops), 0.1)
    rows = {row.name: row for row in service_rows(seen(statuses={"hal": status}))[0].loops}
    assert [(row.is_slow, row.is_late) for row in rows.values()] == [(False, False), (True, False), (False, True)]


@pytest.mark.parametrize(
    ("holder", "words"),
    [
        (None, "not known"),
        (Newest(Holder(name="", holder=0), 0.1), "none"),
        (Newest(Holder(name="anna", holder=3, left=4.0), 9.0), "not known"),
        (Newest(Holder(name="anna", holder=3, through=5, left=4.0), 0.1), "anna through the model, 4 s left"),
    ],
)
def test_the_lease_holder_in_words(holder, words):
    assert seen(holder=holder).lease_holder == words


def test_top_shows_troubles_signals_and_a_robot_without_a_model():
    console = Console(width=160)
    measured = Newest(sample(silent=True), 0.01)
    with console.capture() as shown:
        console.print(top.view(RobotSnapshot(robot="arm", alive=frozenset({"hal"}), sample=measured)))
    text = shown.get()
    assert "Model service gone: Only measured values are known. Is `gemuco serve` running?" in text
    row = next(line for line in text.splitlines() if "joint_position" in line and "1/2" in line)
    assert "0.250 nan" in row


@pytest.mark.parametrize(
    ("kind", "words"),
    [("outside", "outside of what was learned"), ("unknown", "not known on this body"), ("environment", "changed")],
)
def test_the_page_says_a_verdict_that_is_no_anomaly_and_blames_nothing(kind, words):
    page = anomaly_html(seen(anomaly=Newest(anomaly(kind), 0.0)))
    assert words in page
    assert "most likely wrong" not in page


def test_the_terminal_says_that_the_body_is_outside_of_what_was_learned():
    console = Console(width=100)
    with console.capture() as shown:
        console.print(top.view(seen(anomaly=Newest(anomaly("outside"), 0.0))))
    assert "threshold 20.0; outside of what was learned" in shown.get()
