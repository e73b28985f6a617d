import math

import numpy as np
from arm_model import arm, fresh, sample_of, small_model
from msgspec.structs import replace

from hal.clock import ManualClock
from services.model.anomaly_loop import AnomalyWatch
from services.model.estimation import Estimation, Freshness
from services.wire.messages import Anomaly, Estimates, Sample
from services.wire.streams import Arrival


class Bench:
    """The estimation loop with the newest sample in hand."""

    def __init__(self) -> None:
        self.clock = ManualClock()
        self.newest: Arrival[Sample] | None = None
        self.published: list[Estimates] = []
        self.freshness = Freshness(arm(), lambda: self.newest, self.clock)
        self.estimation = Estimation(self.freshness, small_model, self.published.append, self.clock)

    def tick(self) -> Estimates:
        self.estimation.tick()
        return self.published[-1]


def test_measured_values_pass_through_unmarked() -> None:
    bench = Bench()
    bench.newest = fresh(3, bench.clock.monotonic(), cycle=42)
    report = bench.tick()
    assert report.cycle == 42
    assert set(report.method.values()) == {"measured"}
    assert not any(part.any() for part in report.estimated.values())
    for name, value in bench.newest.message.values.items():
        np.testing.assert_array_equal(report.values[name], value)


def test_a_silent_encoder_is_estimated_and_marked() -> None:
    bench = Bench()
    bench.newest = fresh(3, bench.clock.monotonic(), silent=("joint_position.elbow_pitch",))
    report = bench.tick()
    assert report.method["joint_position"] == "mask"
    assert report.mask["joint_position"] == "muscle_tension+muscle_length"
    assert report.estimated["joint_position"].tolist() == [False, False, False, True, False]
    truth = sample_of(3).values["joint_position"]
    assert abs(report.values["joint_position"][3] - truth[3]) < 0.2  # rad
    np.testing.assert_array_equal(report.values["joint_position"][:3], truth[:3])
    assert 0 < report.std["joint_position"][3] < 0.3
    assert report.residual["joint_position"] > 0


def test_no_sample_gives_nothing_and_no_old_values() -> None:
    bench = Bench()
    report = bench.tick()
    assert report.cycle == -1
    assert set(report.method.values()) == {"none"}
    assert all(np.isnan(value).all() for value in report.values.values())


def test_a_sample_that_waited_too_long_is_no_sample() -> None:
    bench = Bench()
    bench.newest = fresh(3, bench.clock.monotonic())
    bench.clock.advance(0.021)
    report = bench.tick()
    assert report.cycle == -1
    assert all(np.isnan(value).all() for value in report.values.values())


def test_a_sample_of_wrong_shape_is_as_good_as_silent() -> None:
    bench = Bench()
    sample = sample_of(3)
    broken = Sample(
        cycle=1, source="simulated", complete=True, values=sample.values | {"joint_position": np.zeros(4)},
        age=sample.age | {"joint_position": np.zeros(4)}, valid=sample.valid | {"joint_position": np.ones(4, bool)},
    )  # fmt: skip
    bench.newest = Arrival(broken, bench.clock.monotonic())
    assert bench.tick().method["joint_position"] == "mask"


def test_values_come_in_the_order_of_the_model() -> None:
    bench = Bench()
    bench.newest = fresh(3, bench.clock.monotonic(), silent=("joint_position.elbow_pitch",))
    names = tuple(reversed(small_model().layout.names))
    other = Freshness(arm(), lambda: bench.newest, bench.clock, names=names)
    _, report = other.take()
    assert tuple(report) == names
    for name, value in bench.freshness.take()[1].items():
        np.testing.assert_array_equal(report[name], value)
    estimation = Estimation(other, small_model, bench.published.append, bench.clock)  # puts them right by itself
    estimation.tick()
    for name, value in bench.tick().values.items():
        np.testing.assert_array_equal(bench.published[0].values[name], value)


def test_nothing_is_computed_twice_while_nothing_changes() -> None:
    bench = Bench()
    bench.newest = fresh(3, bench.clock.monotonic())
    _, first = bench.freshness.take()
    bench.newest = Arrival(bench.newest.message, bench.newest.received)
    assert bench.freshness.take()[1] is first
    assert not first.flat.flags.writeable
    bench.clock.advance(0.021)
    fresh_now, later = bench.freshness.take()
    assert later is not first and np.isnan(later.flat).all() and fresh_now is None


def test_an_anomaly_must_last() -> None:
    bench = Bench()
    report: list[Anomaly] = []
    watch = AnomalyWatch(bench.freshness, small_model, 0.05, report.append, bench.clock)
    sample = sample_of(5)
    tension = sample.values["muscle_tension"].copy()
    tension[1] += 150.0  # N
    cut = replace(sample, values=sample.values | {"muscle_tension": tension})
    for _ in range(5):
        bench.newest = Arrival(cut, bench.clock.monotonic())
        watch.tick()
        watch.judge()
        bench.clock.advance(0.02)
    assert all(one.score > one.threshold for one in report)
    assert [one.is_anomaly for one in report] == [False, False, False, False, True]
    assert [one.verdict for one in report] == ["", "", "", "", "anomaly"]
    assert report[-1].blamed.split(".")[0] in arm().signals
    bench.newest = fresh(5, bench.clock.monotonic())
    watch.tick()
    assert not report[-1].is_anomaly
    assert report[-1].verdict == "normal"


def test_a_verdict_is_of_what_is_odd_now_and_never_of_what_was() -> None:
    bench = Bench()
    report: list[Anomaly] = []
    watch = AnomalyWatch(bench.freshness, small_model, 0.05, report.append, bench.clock)
    sample = sample_of(5)
    tension = sample.values["muscle_tension"] + 150.0  # N
    odd = replace(sample, values=sample.values | {"muscle_tension": tension})

    def tick(sample: Sample) -> Anomaly:
        bench.clock.advance(0.06)
        bench.newest = Arrival(sample, bench.clock.monotonic())
        watch.tick()
        return report[-1]

    tick(odd)
    tick(odd)
    watch.judge()
    assert tick(odd).verdict == "anomaly"
    assert tick(sample).verdict == "normal"
    assert tick(odd).verdict == ""
    assert not report[-1].is_anomaly
    bench.clock.advance(1.0)  # nobody judges: it is told all the same
    assert tick(odd).is_anomaly
    assert report[-1].verdict == ""


def test_without_a_sample_nothing_is_judged() -> None:
    bench = Bench()
    report: list[Anomaly] = []
    AnomalyWatch(bench.freshness, small_model, 0.05, report.append, bench.clock).tick()
    assert math.isnan(report[0].score)
    assert not report[0].is_anomaly
    assert report[0].blamed == ""
