import numpy as np
import pytest
from arm_model import MASKS, arm, fresh, small_model, states

from gemuco.adaption.config import UpdateConfig as Learning
from gemuco.adaption.update import Updater, UpdateResult
from gemuco.dataset import Dataset, Episode
from gemuco.errors import NotEnoughData
from gemuco.learning.train import TrainConfig, fit
from gemuco.schema import BodySchema
from hal.clock import ManualClock
from services.model.estimation import Freshness
from services.model.living_model import LivingModel, layout_of
from services.model.model_config import UpdateConfig
from services.model.update_loop import OnlineUpdate
from services.wire.messages import Sample, Update
from services.wire.streams import Arrival


class Bench:
    """The update loop of an arm that goes from state to state."""

    def __init__(self, window: int = 50, interval: float = 0.1, schema: BodySchema | None = None) -> None:
        self.clock = ManualClock()
        self.newest: Arrival[Sample] | None = None
        self.engaged = self.doubted = False
        self.report: list[Update] = []
        self.living = LivingModel(schema or small_model())
        self.update = OnlineUpdate(
            Freshness(arm(), lambda: self.newest, self.clock),
            self.living,
            UpdateConfig(window=window, interval=interval),
            lambda schema: Updater(schema, Learning(window=window, minimum=10, batch=10)),
            lambda: self.engaged,
            self.report.append,
            self.clock,
            is_doubted=lambda: self.doubted,
        )

    def turn(self, index: int, silent: tuple[str, ...] = ()) -> Update:
        self.clock.advance(0.1)
        self.newest = fresh(index, self.clock.monotonic(), silent=silent)
        self.update.tick()
        return self.report[-1]


@pytest.mark.long
def test_the_window_is_bounded_and_the_oldest_go() -> None:
    bench = Bench(window=20)
    bench.turn(0)
    bench.update.adapt(True)
    for index in range(1, 31):
        report = bench.turn(index)
    assert (report.active, report.window, report.dropped) == (True, 20, 10)
    assert report.model_version > 0
    assert np.isfinite(report.loss)


def test_a_model_is_swapped_whole_and_can_be_rolled_back() -> None:
    bench = Bench()
    first = bench.living.schema
    bench.turn(0)
    bench.update.adapt(True)
    for index in range(1, 20):
        bench.turn(index)
    learned = bench.living.schema
    assert learned is not first
    assert bench.living.before is first
    version = bench.living.version
    assert bench.update.rollback() == version + 1
    assert bench.living.schema is first
    assert not bench.update.is_active
    assert bench.turn(40).active is False
    assert bench.living.schema is first


def test_another_w_is_used_four_times_a_second_at_most_and_the_last_one_stays() -> None:
    bench, used = Bench(), []
    bench.turn(0)
    bench.update.adapt(True)
    learner = bench.update._learner
    assert learner is not None
    for index in range(1, 21):
        before = bench.living.version
        bench.turn(index)
        if bench.living.version > before:
            used.append(index)
    assert len(used) >= 6
    assert np.diff(used).min() == 3, "ticks are 0.1 s apart"
    assert bench.living.schema is not learner.schema
    bench.update.adapt(False)
    assert bench.living.schema is learner.schema


def test_normal_errors_learned_meanwhile_stay_if_the_update_learned_nothing() -> None:
    bench = Bench(window=200)
    for index in range(150):
        bench.turn(index)
    bench.update.adapt(True)
    bench.update.learn_normal()
    learned = bench.living.schema
    bench.update.adapt(False)
    assert bench.living.schema is learned


def test_nothing_is_learned_while_a_sensor_is_suspected_of_a_gross_lie() -> None:
    bench = Bench(window=200)
    bench.turn(0)
    bench.update.adapt(True)
    for index in range(1, 31):
        bench.turn(index)
    bench.doubted = True
    for index in range(31, 60):
        assert bench.turn(index).window == 11, "nor from the 2 s before"
    bench.doubted = False
    assert bench.turn(60).window == 12


def test_what_was_learned_while_a_sensor_lied_is_dropped() -> None:
    bench = Bench(window=200)
    bench.turn(0)
    bench.update.adapt(True)
    models = [bench.living.schema]
    for index in range(1, 31):
        bench.turn(index)
        models.append(bench.living.schema)
    bench.update.forget(bench.clock.monotonic() - 0.95)  # ten samples ago
    assert bench.living.schema is models[30], "other loops do not wait for it"
    bench.turn(30)  # nothing new
    assert bench.living.schema.weights is models[20].weights is not models[30].weights
    assert bench.turn(31).window == 21


@pytest.mark.parametrize("why", ["rest", "silent", "stale"])
def test_a_useless_sample_is_not_learned_from(why: str) -> None:
    bench = Bench()
    bench.turn(0)
    bench.update.adapt(True)
    for _ in range(5):
        if why == "stale":
            bench.clock.advance(1.0)
            bench.update.tick()
        else:
            bench.turn(0 if why == "rest" else 1, ("muscle_length.biceps",) if why == "silent" else ())
    assert bench.report[-1].window == 0
    assert bench.living.version == 0


def test_one_sample_of_a_body_at_rest_tells_p() -> None:
    rows, layout = states(count=400), layout_of(arm())
    halves = zip(("empty", "loaded"), np.split(np.arange(len(rows["joint_position"])), 2), strict=True)
    episodes = tuple(Episode(name, {signal: value[part] for signal, value in rows.items()}) for name, part in halves)
    config = TrainConfig(hidden=(20,), epochs=2, bias_size=1)
    bench = Bench(schema=fit(Dataset(layout, episodes), config, MASKS)[0])
    bench.turn(0)
    bench.update.adapt(True)
    assert [bench.turn(0).window for _ in range(3)] == [1, 1, 1]
    bench.update.adapt(False)
    bench.update.adapt(True)
    bench.update.adapt(False)
    assert bench.turn(0).window == 0
    bench.update.adapt(True)
    assert bench.turn(1, ("muscle_length.biceps",)).window == 1, "what is left still tells p"
    bench.update.adapt(False)


@pytest.mark.long
def test_the_normal_is_learned_from_samples_since_the_model_changed() -> None:
    bench = Bench(window=200)
    bench.engaged = True
    for index in range(10):
        bench.turn(index)
    with pytest.raises(NotEnoughData, match="Let the robot move for a while"):
        bench.update.learn_normal()
    for index in range(10, 120):
        bench.turn(index)
    before = bench.living.schema.normal
    assert bench.update.learn_normal() == 120
    assert bench.living.schema.normal is not before
    bench.update.adapt(True)
    bench.update.adapt(False)
    with pytest.raises(NotEnoughData):
        bench.update.learn_normal()


def test_normal_errors_that_are_learned_twice_from_the_same_samples_are_the_same() -> None:
    """What the first time left behind is no knowledge beside these samples: they would seem to be predicted by it."""
    bench = Bench(window=200)
    bench.engaged = True
    for index in range(120):
        bench.turn(index)
    learned = []
    for _ in range(2):
        assert bench.update.learn_normal() == 120
        learned.append(bench.living.schema.normal)
    assert learned[1].watch.count == learned[0].watch.count
    assert learned[1].threshold == learned[0].threshold


@pytest.mark.long
def test_the_interval_is_between_samples_that_are_learned_from() -> None:
    bench = Bench(window=200, interval=0.4)
    bench.engaged = True
    for index in range(80):
        bench.turn(index)
    assert bench.update.learn_normal() == 80
    bench.update.adapt(True)
    for index in range(80, 100):
        report = bench.turn(index)
    assert report.window == 5


def test_learning_gives_way_and_goes_on() -> None:
    """While another loop is slow samples are kept and W stays; afterwards they are learned from."""
    bench, may = Bench(), [True]
    bench.update._may_learn = lambda: may[0]
    bench.turn(0)
    bench.update.adapt(True)
    for index in range(1, 15):
        bench.turn(index)
    may[0] = False
    version, window = bench.living.version, bench.report[-1].window
    for index in range(15, 20):
        report = bench.turn(index)
    assert (report.active, bench.living.version, bench.update.waited) == (True, version, 5)
    assert report.window == window + 5
    may[0] = True
    report = bench.turn(20)
    assert report.window == window + 6
    assert bench.living.version > version


class SlowLearner:
    """A learner that owes steps of a known duration [s]."""

    def __init__(self, schema: BodySchema, clock: ManualClock, duration: float, owed: int) -> None:
        self.schema, self.owed, self.taken = schema, owed, []
        self._clock, self._duration = clock, duration

    def add(self, values: object) -> bool:
        self.owed += 1
        return True

    def forget(self, count: int, schema: BodySchema) -> None:
        """Keep all."""

    def step(self, most: int) -> UpdateResult:
        steps = min(most, self.owed)
        self.owed -= steps
        self.taken.append(steps)
        self._clock.advance(steps * self._duration)
        nothing = np.zeros(0)
        return UpdateResult(steps, 0.1, 10, 0, nothing, nothing, True, False, 0.1, 0)


@pytest.mark.parametrize("duration", [0.5e-3, 5e-3])
@pytest.mark.long
def test_steps_for_rare_samples_leave_most_of_a_tick_free(duration: float) -> None:
    bench = Bench()
    learner = SlowLearner(bench.living.schema, bench.clock, duration, round(1.6 / duration))
    bench.update._make_learner = lambda schema: learner
    bench.turn(0)
    bench.update.adapt(True)
    for index in range(1, 100):
        bench.turn(index)
    late = learner.taken[15:50]
    assert max(late) * duration <= 0.026  # [s], a quarter of the period
    assert min(late) * duration >= 0.015
    assert learner.owed == 0
    assert learner.taken[-1] == 1, "what is new is still learned from at once"
