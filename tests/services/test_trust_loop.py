"""A lying sensor in the model service: hidden, estimated, marked with the reason; an operator decides otherwise."""

from functools import cache

import numpy as np
import pytest
from arm_model import arm, sample_of, small_model

from gemuco.anomaly.healthy import learn_normal
from gemuco.schema import BodySchema
from gemuco.trust.config import Finding, TrustConfig
from hal.clock import ManualClock
from hal.config import RobotConfig
from hal.errors import ConfigError
from services.errors import BadArguments
from services.model.estimation import Estimation, Freshness
from services.model.model_config import model_config
from services.model.trust_loop import Trust
from services.verbs.ask import estimate_line
from services.wire.messages import Estimates, Sample
from services.wire.streams import Arrival
from simulators.robots.musashi_arm.model import wire_lengths

PERIOD = 0.02
ELBOW = "joint_position.elbow_pitch"


def motion(count: int, seed: int) -> list[dict[str, np.ndarray]]:
    """Samples of smooth motion of the designer's arm, with the noise of sensors."""
    random, robot = np.random.default_rng(seed), arm()
    low, high = robot.bounds("joint_position")
    time = np.arange(count)[:, None] * PERIOD
    phase = random.uniform(0.0, 6.0, 15) + time * random.uniform(0.5, 1.5, 15)
    position = 0.5 * (low + high) + 0.35 * (high - low) * np.sin(phase[:, :5])
    tension = 60.0 + 40.0 * np.sin(phase[:, 5:])
    length = np.array([wire_lengths(q, f) for q, f in zip(position, tension, strict=True)])
    rows = {"joint_position": position, "muscle_tension": tension, "muscle_length": length}
    noise = {"joint_position": 1e-3, "muscle_tension": 0.5, "muscle_length": 5e-5}
    noisy = {name: value + noise[name] * random.normal(size=value.shape) for name, value in rows.items()}
    return [{name: value[index] for name, value in noisy.items()} for index in range(count)]


@cache
def model() -> BodySchema:
    schema = small_model()
    rows = [schema.layout.join(sample) for seed in range(4) for sample in motion(300, 50 + seed)[::2]]
    return schema.with_normal(learn_normal(schema, np.array(rows)))


class Bench:
    """Freshness, trust and estimation on samples in hand."""

    def __init__(
        self, config: TrustConfig | None = None, stops: tuple[str, ...] | None = None, is_known: bool = True,
        robot: RobotConfig | None = None, factor: float = 1.0,
    ) -> None:  # fmt: skip
        factors = np.full(model().layout.size, factor)
        self.clock, self.stops, self.changes = ManualClock(), list[str](), list[float]()
        self.newest: Arrival[Sample] | None = None
        self.freshness = Freshness(robot or arm(), lambda: self.newest, self.clock)
        self.trust = Trust(
            robot or arm(), self.freshness, model, config or TrustConfig(), self.clock, self.stops.append,
            is_known=lambda schema: is_known, changed=self.changes.append, stops=stops, factor=lambda: factors,
        )  # fmt: skip
        self.published: list[Estimates] = []
        self.estimation = Estimation(self.freshness, model, self.published.append, self.clock, lambda: factors)
        self.cycle = 0

    def feed(self, values: dict[str, np.ndarray], age: dict[str, float] | None = None) -> Estimates:
        """Take a sample; `age` [s] is that of all elements of some signals."""
        self.clock.advance(PERIOD)
        self.cycle += 1
        shape = sample_of(0)
        ages = {name: np.full(len(own), (age or {}).get(name, own[0])) for name, own in shape.age.items()}
        sample = Sample(
            cycle=self.cycle, boot=7, source="simulated", complete=True, values=values, age=ages, valid=shape.valid
        )
        self.newest = Arrival(sample, self.clock.monotonic())
        self.trust.tick()
        self.estimation.tick()
        return self.published[-1]


@pytest.mark.long
@pytest.mark.parametrize("slow", ["muscle_tension", "joint_position"])
def test_a_signal_that_is_read_less_often_hides_nothing_in_motion(slow: str) -> None:
    """Ten values of it a second, as messages of a car have, beside fifty of the others."""
    body = arm().model_dump(by_alias=True)
    body["signals"][slow]["stale_after"] = 0.2
    bench = Bench(robot=RobotConfig.model_validate(body))
    held: dict[str, np.ndarray] = {}
    for number, row in enumerate(motion(3000, 7)[::4]):
        if number % 5 == 0:
            held = {slow: row[slow]}
        bench.feed({**row, **held}, {slow: PERIOD * (number % 5)})
        assert not bench.freshness.distrust.reasons, f"{number * PERIOD} s: {bench.freshness.distrust.reasons}"


@pytest.mark.long
def test_a_lying_encoder_is_estimated_and_marked_until_it_agrees() -> None:
    bench, samples = Bench(), motion(1000, 1)
    for sample in samples[:300]:
        bench.feed(sample)
    assert not any(estimates.distrusted for estimates in bench.published)
    for sample in samples[300:500]:
        sample["joint_position"][3] += 1.0
        estimates = bench.feed(sample)
    assert estimates.distrusted[ELBOW].startswith("distrusted: offset since ")
    assert estimates.estimated["joint_position"].tolist() == [False, False, False, True, False]
    assert abs(estimates.values["joint_position"][3] - (samples[499]["joint_position"][3] - 1.0)) < 0.2
    hidden = [bool(estimates.distrusted) for estimates in bench.published]
    assert hidden.index(True) - 300 < 50, "hidden within a second"
    text = bench.trust.text()
    assert "joint_position.elbow_pitch is distrusted: offset since" in text
    assert "`gemuco calibrate` measures elbow_pitch_encoder anew" in text
    assert bench.changes and not bench.stops
    for sample in samples[500:]:
        estimates = bench.feed(sample)
    assert not estimates.distrusted
    assert not estimates.estimated.flat.any()


@pytest.mark.parametrize(("tension", "is_cut"), [(0.0, True), pytest.param(None, False, marks=pytest.mark.long)])
def test_a_wire_that_is_cut_is_not_taken_for_a_lying_sensor_alone(tension: float | None, is_cut: bool) -> None:
    bench, samples = Bench(), motion(500, 2)
    place = arm().signals["muscle_length"].elements.index("deltoid_side")
    for sample in samples[:300]:
        bench.feed(sample)
    for sample in samples[300:400]:
        wrong = {name: value.copy() for name, value in sample.items()}
        wrong["muscle_length"][place] -= 0.0127
        if tension is not None:
            wrong["muscle_tension"][place] = tension
        reasons = bench.feed(wrong).distrusted
        if reasons:
            break
    (name, reason), text = *reasons.items(), bench.trust.text()
    assert name == ("muscle_tension.deltoid_side" if is_cut else "muscle_length.deltoid_side"), "what is out of range"
    assert reason.endswith(", or deltoid_side itself has changed") == is_cut
    assert ("muscle_tension.deltoid_side is outside of what was learned" in text) == is_cut
    assert f"`gemuco calibrate` measures deltoid_side_{'cell' if is_cut else 'drive'} anew" in text


def test_a_part_whose_sensors_are_all_contradicted_may_itself_have_changed() -> None:
    bench = Bench()
    names = [model().layout.element(index) for index in range(model().layout.size)]
    lying = tuple(names.index(f"{signal}.biceps") for signal in ("muscle_tension", "muscle_length"))
    bench.trust.findings = (Finding(lying, "part", "offset", bench.clock.monotonic(), 50.0, is_distrusted=True),)
    text = bench.trust.text()
    assert text.startswith("muscle_tension.biceps and muscle_length.biceps are distrusted: offset since ")
    assert text.endswith(", off by 50 N, or biceps itself has changed.")


@pytest.mark.parametrize(
    ("is_wrong", "is_known"),
    [(False, True), *(pytest.param(True, known, marks=pytest.mark.long) for known in (True, False))],
)
def test_an_element_that_returns_is_used_when_it_agrees(is_wrong: bool, is_known: bool) -> None:
    """The HAL takes a value that has jumped by a radian, and stays there, for five seconds only."""
    bench, samples = Bench(is_known=is_known), motion(800, 3)
    place = arm().signals["joint_position"].elements.index("elbow_pitch")
    for sample in samples[:300]:
        bench.feed(sample)
    for sample in samples[300:400]:
        bench.feed(sample | {"joint_position": np.where(np.arange(5) == place, np.nan, sample["joint_position"])})
    shown = []
    for sample in samples[400:]:
        estimates = bench.feed(sample | {"joint_position": sample["joint_position"] + is_wrong * np.eye(5)[place]})
        if not estimates.estimated["joint_position"][place]:
            shown.append(estimates)
        else:
            assert estimates.distrusted[ELBOW].startswith("distrusted: ")
    if is_wrong:
        assert not shown
        bench.trust.trust(ELBOW)  # an operator knows better
        assert not bench.feed(samples[-1]).estimated["joint_position"][place]
    else:
        assert len(shown) >= 400 - 20  # within 0.4 s
        assert not bench.stops


@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_an_element_that_returns_is_held_against_the_std_that_others_are_promised(factor: float) -> None:
    place = arm().signals["joint_position"].elements.index("elbow_pitch")
    is_used = {}
    for errors in (1.5, 4.5):
        bench, samples = Bench(factor=factor), motion(300, 4)
        for sample in samples:
            bench.feed(sample)
        position = samples[-1]["joint_position"].copy()
        position[place] = np.nan
        for _ in range(30):
            estimates = bench.feed(samples[-1] | {"joint_position": position})
        assert estimates.estimated["joint_position"][place]
        position[place] = estimates.values["joint_position"][place] + errors * estimates.std["joint_position"][place]
        for _ in range(20):
            estimates = bench.feed(samples[-1] | {"joint_position": position})
        is_used[errors] = not estimates.estimated["joint_position"][place]
    assert is_used == {1.5: True, 4.5: False}


def test_elements_that_were_all_late_are_used_at_once() -> None:
    bench, samples = Bench(), motion(400, 3)
    for sample in samples[:300]:
        bench.feed(sample)
    for sample in samples[300:350]:
        bench.feed({name: np.full_like(value, np.nan) for name, value in sample.items()})
    for sample in samples[350:]:
        estimates = bench.feed(sample)
        assert not any(marks.any() for marks in estimates.estimated.values())


def test_a_gross_lie_that_is_still_used_is_a_doubt_and_a_hidden_one_is_none() -> None:
    bench, samples = Bench(is_known=False), motion(900, 3)
    place = arm().signals["joint_position"].elements.index("elbow_pitch")
    for sample in samples[:300]:
        bench.feed(sample)
        assert not bench.trust.doubts
    doubts = 0
    for index, sample in enumerate(samples[300:]):
        lie = 0.5 * min(1.0, index / 50) * np.eye(5)[place]  # rad; no jump
        estimates = bench.feed(sample | {"joint_position": sample["joint_position"] + lie})
        doubts += bench.trust.doubts
        assert not (bench.trust.doubts and estimates.estimated["joint_position"][place])
    assert doubts > 50
    assert estimates.estimated["joint_position"][place], "it explained five seconds of motion"
    assert not bench.trust.doubts


def test_an_operator_distrusts_and_trusts() -> None:
    bench, samples = Bench(), motion(60, 2)
    bench.feed(samples[0])
    bench.trust.distrust(ELBOW)
    estimates = bench.feed(samples[1])
    assert "by an operator since" in estimates.distrusted[ELBOW]
    assert estimates.estimated["joint_position"][3]
    assert bench.trust.facts()["findings"][0]["by_hand"]
    bench.trust.trust(ELBOW)
    assert not bench.feed(samples[2]).distrusted
    with pytest.raises(BadArguments, match=r"Known elements: joint_position\.shoulder_roll"):
        bench.trust.distrust("joint_position.knee")


def test_a_robot_stops_without_an_element_that_motion_needs() -> None:
    bench = Bench()
    bench.feed(motion(1, 3)[0])
    assert not bench.trust.refusal()
    bench.trust.distrust("muscle_length.biceps")
    assert len(bench.stops) == 1
    assert "muscle_length.biceps is distrusted: by an operator" in bench.stops[0]
    assert "motion needs it" in bench.trust.refusal()
    bench.trust.distrust(ELBOW)
    assert len(bench.stops) == 1, "an encoder of a joint can be estimated, and the arm goes on"


@pytest.mark.parametrize(
    ("stops", "stopping"), [((), []), (("joint_position.elbow_pitch",), [ELBOW]), (("joint_position",), [ELBOW])]
)
def test_the_robot_file_says_without_which_elements_the_robot_stops(
    stops: tuple[str, ...], stopping: list[str]
) -> None:
    bench = Bench(stops=stops)
    bench.feed(motion(1, 3)[0])
    bench.trust.distrust("muscle_length.biceps")
    assert not bench.stops and not bench.trust.refusal()
    bench.trust.distrust(ELBOW)
    assert [ELBOW in text for text in bench.stops] == [True for _ in stopping]
    assert bool(bench.trust.refusal()) is bool(stopping)


def test_the_line_of_an_estimate_gives_the_reason() -> None:
    reply = {
        "signal": "joint_position", "unit": "rad", "elements": ["a", "b"], "values": [1.0, 2.0], "std": [0.1, 0.0],
        "estimated": [True, False], "method": "mask", "mask": "muscle_length",
        "distrusted": {"joint_position.a": "distrusted: frozen since 12:03:11"},
    }  # fmt: skip
    assert estimate_line(reply).endswith("expected error 0.100 rad; a distrusted: frozen since 12:03:11")


def test_settings_of_the_robot_file() -> None:
    given = {"false_alarms": 1.0, "size": 5.0, "sizes": {"muscle_tension": 8.0}, "pairs": "use"}
    robot = arm().model_copy(update={"model": arm().model | {"trust": given}})
    assert model_config(robot).trust.config() == TrustConfig(1.0, 5.0, {"muscle_tension": 8.0}, "use")
    assert model_config(arm()).trust.config() == TrustConfig()
    assert model_config(arm()).trust.stops is None


def test_an_unknown_element_that_is_to_stop_the_robot_is_refused() -> None:
    robot = arm().model_copy(update={"model": arm().model | {"trust": {"stops": ["joint_position.elbow_pich"]}}})
    with pytest.raises(
        ConfigError, match=r"stops 'joint_position\.elbow_pich' is neither .* joint_position\.elbow_pitch"
    ):
        model_config(robot)
