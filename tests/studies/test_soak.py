"""The referee of the soak: it must see what is wrong, and only that."""

import os
import time
from collections.abc import Callable, Iterator

import numpy as np
import pytest
import zenoh

from services.wire import keys
from services.wire.messages import Estimates, Message, Sample, encode
from services.wire.session import close_session, open_session
from studies.stack.soak.faults import Faults
from studies.stack.soak.referee import GIVEN_UP, Referee
from studies.stack.soak.verdicts import _creeps

PROMISED = {"joint": np.array([0.01])}
STEP = 0.02
BASE_NS = 1_000_000_000_000


class Stage:
    """A simulator, a HAL and a model that say what a test tells them."""

    def __init__(self, session: zenoh.Session, robot: str) -> None:
        self.referee = Referee(session, robot, PROMISED)
        self._session, self._robot = session, robot
        self.cycle = 0

    def play(self, seconds: float, error: float, estimated: bool = False, std: float = 0.0, truth: float = 1.0) -> None:
        """Let an element be off by `error` for a time [s]."""
        for _ in range(round(seconds / STEP)):
            self.cycle += 1
            stamp = BASE_NS + round(1e9 * STEP * self.cycle)
            whole = {"cycle": self.cycle, "stamp_ns": stamp, "complete": True, "age": {"joint": np.zeros(1)}}
            for key, source, value in ((keys.truth, "truth", truth), (keys.sample, "can", truth + error)):
                sample = Sample(source=source, values={"joint": [value]}, valid={"joint": [True]}, **whole)
                self.put(key(self._robot), sample)
            method = "mask" if estimated else "measured"
            self.say(truth + error, estimated, std, method, self.cycle)

    def say(self, value: float, estimated: bool, std: float, method: str, cycle: int) -> None:
        estimate = Estimates(
            cycle=cycle, values={"joint": [value]}, estimated={"joint": [estimated]}, std={"joint": [std]},
            method={"joint": method}, mask={"joint": ""}, residual={"joint": 0.0}, seq=self.cycle, boot=7,
            stamp_ns=BASE_NS + round(1e9 * STEP * self.cycle),
        )  # fmt: skip
        self.put(keys.estimate(self._robot), estimate)

    def put(self, key: str, message: Message) -> None:
        self._session.put(key, encode(message))

    def until(self, happened: Callable[[], bool]) -> None:
        end = time.monotonic() + 15.0
        while not happened():
            assert time.monotonic() < end, self.referee.summary()
            time.sleep(0.005)

    def judged(self) -> dict:
        """What the referee says of all that was played."""
        self.until(lambda: self.referee.judged + self.referee.unjudged >= self.cycle - 3)
        return self.referee.summary()


@pytest.fixture
def stage() -> Iterator[Stage]:
    robot = f"refereed_{os.getpid()}"
    session = open_session(robot, "client")
    played = Stage(session, robot)
    yield played
    played.referee.close()
    close_session(session)


def test_what_is_wrong_for_longer_than_two_seconds_is_named(stage: Stage) -> None:
    stage.referee.fault = "offset"
    stage.play(0.5, 0.0)
    stage.play(2.5, 0.05)
    stage.play(1.0, 0.0)
    found = stage.judged()
    (wrong,) = found["wrong"]
    assert (wrong["element"], wrong["fault"]) == ("joint.0", "offset")
    assert wrong["until"] - wrong["since"] == pytest.approx(2.5, abs=3 * STEP)
    assert wrong["worst"] == pytest.approx(5.0)
    assert found["longest"] == {"offset": pytest.approx(2.5, abs=3 * STEP)}


def test_a_wrong_value_that_goes_on_is_named_before_its_end(stage: Stage) -> None:
    stage.play(3.0, 0.05)
    assert len(stage.judged()["wrong"]) == 1


def test_moments_of_right_values_do_not_hide_a_wrong_one(stage: Stage) -> None:
    for _ in range(13):  # 2.6 s
        stage.play(0.16, 0.05)
        stage.play(0.04, 0.0)
    assert len(stage.judged()["wrong"]) == 1


@pytest.mark.parametrize(
    ("seconds", "error", "estimated"), [(4.0, 0.029, False), (1.5, 0.5, False), (4.0, 0.5, True)],
    ids=["within three promised std", "short", "estimated"],
)  # fmt: skip
def test_what_is_right_or_short_or_estimated_is_not_named(
    stage: Stage, seconds: float, error: float, estimated: bool
) -> None:
    stage.play(seconds, error, estimated)
    stage.play(1.0, 0.0)
    assert not stage.judged()["wrong"]


def test_a_measured_value_that_is_nan_is_wrong(stage: Stage) -> None:
    stage.play(3.0, float("nan"))
    assert len(stage.judged()["wrong"]) == 1


def test_the_time_of_a_measurement_is_forgiven(stage: Stage) -> None:
    stage.play(0.5, 0.0)
    for number in range(1, 100):
        stage.play(STEP, -0.1, truth=1.0 + 0.1 * number)
    assert not stage.judged()["longest"]


def test_without_a_sample_nothing_may_be_called_measured(stage: Stage) -> None:
    stage.cycle = 1
    stage.say(1.0, False, 0.0, "measured", -1)
    stage.cycle = 2
    stage.say(1.0, True, 0.1, "none", -1)
    stage.until(lambda: stage.referee.baseless == 1)


@pytest.mark.long
def test_an_estimate_that_is_played_again_is_not_judged_twice(stage: Stage) -> None:
    stage.play(1.0, 0.0)
    stage.judged()
    before = stage.referee.summary()["judged"]
    stage.say(9.9, False, 0.0, "measured", stage.cycle)  # number and boot of the newest
    time.sleep(1.1 * GIVEN_UP)
    stage.play(1.0, 0.0)
    stage.until(lambda: stage.referee.judged > before)
    assert not stage.referee.summary()["longest"]


def test_the_plan_has_every_fault_and_kills_only_in_its_first_part() -> None:
    faults = Faults.__new__(Faults)
    names = ["kill model", "kill hal", "replay", "flood", "full disk", *(f"lie {n}" for n in range(22))]
    faults.by_name = dict.fromkeys(names)  # type: ignore[arg-type]
    plan = faults.schedule(60, 20)
    assert len(plan) == 60
    assert set(plan) == set(names)
    assert not any(name.startswith("kill") for name in plan[20:])


def test_threads_and_files_that_grow_are_noticed() -> None:
    assert _creeps([10, 10, 10, 12, 12, 12, 14, 14, 14])
    assert not _creeps([10, 12, 10, 11, 12, 10, 12, 11, 10])
