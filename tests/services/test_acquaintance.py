import dataclasses

import numpy as np
import pytest
from arm_model import arm, sample_of, small_model, states
from msgspec.structs import replace

from hal.clock import ManualClock
from services.model.acquaintance import CALM_SAMPLES, CALM_TIME, Acquaintance
from services.model.anomaly_loop import AnomalyWatch
from services.model.estimation import Freshness
from services.wire.messages import Anomaly, Sample
from services.wire.streams import Arrival


class Bench:
    """The anomaly loop of an arm whose normal errors have to be known first."""

    def __init__(self) -> None:
        self.clock, self.published = ManualClock(), list[Anomaly]()
        self.newest: Arrival[Sample] | None = None
        self.schema, self.acquaintance = small_model(), Acquaintance()
        freshness = Freshness(arm(), lambda: self.newest, self.clock)
        self.watch = AnomalyWatch(
            freshness, lambda: self.schema, 0.05, self.published.append, self.clock, self.acquaintance
        )
        self.cycle = 0

    def turn(self, index: int, off: float = 0.0, silent: tuple[str, ...] = ()) -> Anomaly:
        """Take one sample whose second muscle pulls by `off` [N] more."""
        self.clock.advance(0.1)
        self.cycle += 1
        sample = sample_of(index, self.cycle, silent)
        tension = sample.values["muscle_tension"].copy()
        tension[1] += off
        cut = replace(sample, values=sample.values | {"muscle_tension": tension})
        self.newest = Arrival(cut, self.clock.monotonic())
        self.watch.tick()
        self.watch.judge()
        return self.published[-1]


@pytest.mark.long
def test_a_body_that_was_never_normal_is_unknown_and_nothing_is_blamed() -> None:
    bench = Bench()
    for index in range(80):
        state = bench.turn(index, off=150.0)
        assert state.score > state.threshold
        assert (state.verdict, state.is_anomaly, state.blamed) == ("unknown", False, "")


def test_a_body_that_was_normal_may_have_an_anomaly() -> None:
    bench = Bench()
    for index in range(max(CALM_SAMPLES, round(10 * CALM_TIME)) + 3):
        bench.turn(index)
    assert bench.published[0].verdict == "unknown"
    assert bench.published[-1].verdict == "normal"
    assert bench.acquaintance.is_known(bench.schema)
    states = [bench.turn(5, off=150.0) for _ in range(5)]
    assert states[-1].is_anomaly
    assert states[-1].verdict == "anomaly"


def test_another_w_has_to_be_known_again_and_learned_normal_errors_are_known_at_once() -> None:
    bench = Bench()
    bench.acquaintance.learned(bench.schema)
    assert bench.acquaintance.is_known(bench.schema)
    arrays = bench.schema.weights
    bench.schema = bench.schema.with_weights(arrays.replaced([array.copy() for array in arrays.arrays()]))
    assert not bench.acquaintance.is_known(bench.schema)
    assert bench.turn(5, off=150.0).verdict == "unknown"
    bench.acquaintance.learned(bench.schema)
    assert bench.acquaintance.is_known(bench.schema.with_bias(bench.schema.bias)), "p does not change what is normal"


def test_the_first_sample_without_an_element_waits_for_its_statistics() -> None:
    bench = Bench()
    bench.acquaintance.learned(bench.schema)
    bench.turn(1)
    first = bench.turn(2, silent=("joint_position.elbow_pitch",))
    assert np.isnan(first.score)
    second = bench.turn(3, silent=("joint_position.elbow_pitch",))
    assert np.isfinite(second.score)
    assert not second.is_anomaly


@pytest.mark.long
def test_a_small_shift_that_lasts_becomes_an_anomaly() -> None:
    bench = Bench()
    for index in range(100):
        bench.turn(index)
    assert not any(state.is_anomaly for state in bench.published[30:])
    shifted = [bench.turn(100 + index, off=40.0) for index in range(100)]
    above = np.mean([state.score > state.threshold for state in shifted])
    assert any(state.is_anomaly for state in shifted)
    assert above < 0.5
    normal = bench.schema.normal
    assert normal is not None and shifted[-1].is_anomaly
    bench.schema = bench.schema.with_normal(dataclasses.replace(normal, windows=None))
    bench.acquaintance.learned(bench.schema)
    bench.watch.tick()
    assert not bench.published[-1].is_anomaly, "a verdict ends with the statistics that it came from"


def test_a_place_that_was_not_learned_is_no_anomaly_and_a_lie_there_is() -> None:
    joint = states()["joint_position"][:, 0]
    middle, most = np.quantile(joint, [0.5, 0.9])
    bench = Bench()
    bench.schema = small_model(middle)
    bench.acquaintance.learned(bench.schema)
    for index in np.flatnonzero(joint <= middle)[:10]:
        assert bench.turn(index).verdict in ("", "normal")
    away = [bench.turn(index) for index in np.flatnonzero(joint > most)[:30]]
    assert all(state.score > state.threshold for state in away)
    assert not any(state.is_anomaly for state in away)
    assert {state.verdict for state in away[5:]} == {"outside"}
    assert {state.blamed for state in away[5:]} == {f"joint_position.{arm().signals['joint_position'].elements[0]}"}
    lies = [bench.turn(index, off=400.0) for index in np.flatnonzero(joint > most)[30:60]]
    assert lies[-1].is_anomaly
    assert lies[-1].verdict == "anomaly"
