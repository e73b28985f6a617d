"""Errors on measured signals, which widen the intervals of lost ones."""

import numpy as np
import pytest
from arm_model import arm, fresh, sample_of, small_model, states
from msgspec.structs import replace

from gemuco.adaption.seen import SeenErrors
from gemuco.certainty.certainty import NINETY
from gemuco.intervals.widening import NARROWEST
from hal.clock import ManualClock
from services.model.estimation import Estimation, Freshness
from services.model.hindsight import Hindsight
from services.wire.messages import Estimates, Sample
from services.wire.streams import Arrival

LOST = "joint_position.elbow_pitch"


class Bench:
    """The estimation loop and the look back, with the newest sample in hand."""

    def __init__(self, offset: float = 0.0) -> None:
        self.clock, self.offset = ManualClock(), offset
        self.newest: Arrival[Sample] | None = None
        self.published: list[Estimates] = []
        self.freshness = Freshness(arm(), lambda: self.newest, self.clock)
        self.schema = small_model()
        self.hindsight = Hindsight(self.freshness, lambda: self.schema, self.clock)
        self.estimation = Estimation(
            self.freshness, lambda: self.schema, self.published.append, self.clock, lambda: self.hindsight.factor
        )

    def sample(self, index: int, silent: tuple[str, ...] = ()) -> np.ndarray:
        """Receive a sample of a body whose joints are off [rad], and return its joint positions."""
        sample = sample_of(index, index, seed=1)
        joints = sample.values["joint_position"] + self.offset
        values = sample.values | {"joint_position": joints}
        silenced = sample_of(index, index, silent, seed=1)
        if silent:
            values = {name: np.where(silenced.valid[name], part, np.nan) for name, part in values.items()}
        self.newest = Arrival(replace(silenced, values=values), self.clock.monotonic())
        return joints

    def look(self, indices: range) -> None:
        for index in indices:
            self.sample(index)
            self.hindsight.look()
            self.clock.advance(0.11)

    def estimate(self, index: int) -> tuple[float, float, Estimates]:
        """Error and std of the lost joint [rad], and the message."""
        truth = self.sample(index, (LOST,))
        self.estimation.tick()
        message = self.published[-1]
        values, std = message.values["joint_position"], message.std["joint_position"]
        return float(abs(values[3] - truth[3])), float(std[3]), message


@pytest.mark.long
def test_on_the_learned_body_the_std_stays_about_as_it_is() -> None:
    bench = Bench()
    _, before, message = bench.estimate(0)
    assert message.state["joint_position"] in ("known", "doubtful")
    bench.look(range(1, 200))
    assert bench.hindsight.factor.min() >= NARROWEST
    _, after, _ = bench.estimate(0)
    assert 0.5 * before <= after < 2.5 * before


@pytest.mark.long
def test_on_another_body_the_interval_of_a_lost_joint_is_honest_and_it_is_said() -> None:
    bench = Bench(offset=0.3)
    bench.look(range(300))
    wrong = [bench.estimate(index) for index in range(300, 400)]
    hits = np.mean([missed <= NINETY * std for missed, std, _ in wrong])
    assert hits > 0.8
    plain = [missed <= NINETY * std / bench.hindsight.factor[3] for missed, std, _ in wrong]
    assert np.mean(plain) < 0.6
    said = [message for _, _, message in wrong if message.state["joint_position"] == "doubtful"]
    assert said
    texts = {message.reason["joint_position"] for message in said}
    assert any("while it was measured, the errors of joint_position.elbow_pitch were" in text for text in texts)
    assert all(message.state["muscle_length"] == "known" for message in said)  # it is measured


@pytest.mark.long
def test_errors_that_the_update_measured_too_do_not_count_twice() -> None:
    bench, learned = Bench(offset=0.3), small_model()
    seen = SeenErrors(learned)
    bench.look(range(300))
    for index in range(300):
        joints = bench.sample(index)
        values = sample_of(index, index, seed=1).values | {"joint_position": joints}
        seen.see(learned, learned.normalise_one(values))
    before = bench.hindsight.factor[3]
    bench.schema = seen.renewed(learned)
    bench.look(range(300, 320))
    assert before > 4.0 > 2.0 > bench.hindsight.factor[3]
    missed, std, _ = np.array([bench.estimate(index) for index in range(320, 420)], object).T
    hits = np.mean(missed <= NINETY * std)
    assert hits > 0.8
    assert np.median(std) < 3.0 * np.median(missed)


@pytest.mark.long
def test_a_robot_at_rest_shows_nothing() -> None:
    bench = Bench(offset=0.3)
    for _ in range(50):
        bench.sample(5)
        bench.hindsight.look()
        bench.clock.advance(0.11)
    assert bench.hindsight.factor.max() < 1.5


def test_without_samples_or_outputs_there_is_nothing_to_see() -> None:
    bench = Bench()
    bench.hindsight.look()
    bench.newest = fresh(3, bench.clock.monotonic(), silent=tuple(_all_elements()))
    bench.hindsight.look()
    assert (bench.hindsight.factor == 1.0).all()


def _all_elements() -> list[str]:
    return [f"{name}.{element}" for name in states() for element in arm().signals[name].elements]
