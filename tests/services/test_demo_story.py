"""What the demo waits for where a fast machine would have been ready by itself."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from gemuco.errors import NotEnoughData
from hal.config import load_robot
from hal.errors import CommandRefused
from services.demo import actor as actor_module
from services.demo.actor import NOTICED_WITHIN, REACHED_WITHIN, TRIES, Actor
from services.demo.stories import muscle_story as story_module
from services.demo.stories.arm_story import NORMAL_TRIES, ArmStory
from services.demo.stories.muscle_story import (
    CALM_TRIES,
    LEARNED,
    LEARNING_POSES,
    LOADED,
    LOADING_POSES,
    MOST_POSES,
    NORMAL,
    POSE_TIME,
    TRUE_POSES,
    MuscleStory,
    leaks,
)
from services.errors import ServiceError, ServiceUnavailable, TooLate, TooSlow
from services.wire.messages import Applied, Status, Update

ROBOT = load_robot(Path(__file__).parents[2] / "robots" / "musashi_arm.yaml")


class Machine:
    """Client, actor and timeline of a robot whose model takes in so many samples per pose."""

    def __init__(self, per_pose: int, false_alarms: int = 0) -> None:
        self.per_pose, self.alarms_left = per_pose, false_alarms
        self.window = self.poses = self.stops = 0
        self.said: list[str] = []
        self.normals: list[int] = []

    def story(self) -> MuscleStory:
        return MuscleStory(ROBOT, self, self, 0, self, self.said.append)  # type: ignore[arg-type]

    def update(self, timeout: float = 0.0) -> Update:
        return Update(active=True, model_version=1, window=self.window, dropped=0, loss=0.0)

    def learn_normal(self) -> dict[str, Any]:
        self.normals.append(self.window)
        return {"samples": self.window}

    def go(self, signal: str, pose: np.ndarray, duration: float, ends: object = None) -> None:
        self.poses += 1
        self.window += self.per_pose

    def wait(self, condition: Any, duration: float) -> bool:
        return False

    def now(self) -> float:
        return 0.0

    def between(self, name: str, start: float, end: float) -> np.ndarray:
        assert name == "is_anomaly"
        self.alarms_left -= 1
        return np.array([False, self.alarms_left >= 0])


@pytest.mark.parametrize(("per_pose", "poses"), [(200, 1), (10, 8), (3, MOST_POSES), (0, MOST_POSES)])
def test_poses_go_on_until_enough_samples_are_taken_in(per_pose: int, poses: int) -> None:
    machine = Machine(per_pose)
    assert machine.story()._gather(LEARNED) == per_pose * poses
    assert machine.poses == poses


def test_enough_samples_need_no_more_poses() -> None:
    machine = Machine(per_pose=1)
    machine.window = NORMAL
    assert machine.story()._learn_normal() == NORMAL
    assert machine.poses == 0


@pytest.mark.parametrize(("alarms", "learned"), [(0, 0), (1, 1), (2, 2), (9, CALM_TRIES - 1)])
def test_what_is_normal_is_learned_from_more_until_the_whole_arm_is_calm(alarms: int, learned: int) -> None:
    machine = Machine(per_pose=10, false_alarms=alarms)
    machine.window = NORMAL
    machine.story()._become_calm()
    assert len(machine.normals) == learned
    assert machine.normals == sorted(machine.normals)
    assert machine.poses == learned * LEARNING_POSES
    assert sum("An anomaly is reported for the whole arm" in sentence for sentence in machine.said) == learned


@pytest.mark.parametrize(("tensions", "poses"), [([25.0], 0), ([19.9, LOADED], 1), ([0.0] * 9, LOADING_POSES)])
def test_a_wire_is_cut_where_it_bears_something(
    monkeypatch: pytest.MonkeyPatch, tensions: list[float], poses: int
) -> None:
    machine, is_cut = Machine(0), np.array(ROBOT.signals["muscle_tension"].elements) == "deltoid_side"
    forces = {"muscle_tension": lambda: np.where(is_cut, tensions[machine.poses], 99.0)}
    monkeypatch.setattr(machine, "truth", lambda signal: forces[signal](), raising=False)
    machine.story()._load_muscle()
    assert machine.poses == poses


class Lie(Machine):
    """Rows of a timeline, one a second, while an encoder is wrong by 0.5 rad: those estimated are right."""

    def __init__(self, states: str) -> None:
        """Take a letter for each row: measured, estimated, or nothing was published."""
        super().__init__(0)
        self.states, self.rows = states, np.arange(float(len(states)))

    def fault(self, text: str) -> None:
        self.poses = 0

    def between(self, name: str, start: float, end: float) -> np.ndarray:
        values = {"m": 0.5, "e": 0.01, "n": np.nan}
        marks = {"m": 0.0, "e": 1.0, "n": np.nan}
        columns = {
            "time": self.rows,
            "estimated": np.array([[marks[state]] * 5 for state in self.states]),
            "value": np.array([[values[state]] * 5 for state in self.states]),
            "truth": np.zeros((len(self.states), 5)),
        }
        return columns[name]


@pytest.mark.parametrize(
    ("states", "is_seen", "words"),
    [
        ("mmeeee", True, "hidden after 2.0 s, estimate wrong by 0.010 rad"),
        ("mmeene", True, "hidden after 2.0 s, estimate wrong by 0.010 rad"),  # a moment without a value
        ("mmeeme", False, "wrong as measured later by 0.500 rad"),
        ("mmmmmm", False, "not noticed"),
    ],
)
def test_a_lie_is_passed_on_only_where_a_value_is(
    monkeypatch: pytest.MonkeyPatch, states: str, is_seen: bool, words: str
) -> None:
    story = Lie(states).story()
    monkeypatch.setattr(story, "_reason", lambda element: "frozen")
    monkeypatch.setattr(story, "_is_estimated", lambda index: False)
    text, seen = story._lying("elbow_pitch", "sensor_frozen elbow_pitch_encoder", "frozen")
    assert words in text
    assert seen == is_seen
    assert "nan" not in text


@pytest.mark.parametrize(("stopped", "poses"), [(0, TRUE_POSES), (5, TRUE_POSES + 5), (MOST_POSES, MOST_POSES)])
def test_poses_to_which_the_arm_was_stopped_do_not_count(
    monkeypatch: pytest.MonkeyPatch, stopped: int, poses: int
) -> None:
    machine = Lie("mmeeee")
    story, right = machine.story(), []

    def go(signal: str, pose: np.ndarray, duration: float) -> None:
        machine.poses += 1
        machine.stops += machine.poses <= stopped

    def fault(text: str) -> None:
        machine.poses = 0
        right.append(text)

    monkeypatch.setattr(machine, "go", go)
    monkeypatch.setattr(machine, "fault", fault)
    monkeypatch.setattr(story, "_reason", lambda element: "frozen")
    monkeypatch.setattr(story, "_is_estimated", lambda index: True)
    text, seen = story._lying("elbow_pitch", "sensor_frozen elbow_pitch_encoder", "frozen")
    assert machine.poses == poses
    assert right[-1] == "sensor_true elbow_pitch_encoder"
    assert "not trusted again" in text
    assert not seen


class ManyJoints:
    """Model of an arm whose normal errors need more samples than the first moves give, and the arm's moves."""

    def __init__(self, needed: int) -> None:
        self.needed, self.moves = needed, 0

    def learn_normal(self) -> dict[str, Any]:
        if self.moves < self.needed:
            raise NotEnoughData("Normal statistics of 73 errors need 73 complete samples; there are 68.")
        return {"samples": 68 + 20 * self.moves}

    def go(self) -> None:
        self.moves += 1


@pytest.mark.parametrize(
    ("needed", "moves", "words"),
    [(0, 0, "anew from 68 samples"), (3, 4, "anew from 148 samples"), (99, 6, "not learned: Normal statistics of 73")],
)
def test_an_arm_of_many_joints_moves_on_until_its_normal_errors_are_learned(
    monkeypatch: pytest.MonkeyPatch, needed: int, moves: int, words: str
) -> None:
    model = ManyJoints(needed)
    story = ArmStory.__new__(ArmStory)
    monkeypatch.setattr(ArmStory, "_go", lambda _: model.go())
    actor = Actor(model, lambda: None, print)  # type: ignore[arg-type]
    assert words in actor.learn_normal(story._go_on, NORMAL_TRIES)
    assert model.moves == moves


class Stopping:
    """A robot that the HAL stops on the way so many times."""

    def __init__(self, stops: int) -> None:
        self.stops_left, self.targets, self.mode = stops, 0, "follow"

    def applied(self, timeout: float = 0.0) -> Applied:
        command = np.zeros(10)
        return Applied(
            cycle=1, mode=self.mode, signal="muscle_length", desired=command, values=command, limited_by=[], sender=0
        )

    def status(self, service: str, timeout: float = 0.0) -> Status:
        return Status(service="hal", state="running", facts={"fault": "Life guard or heartbeat error."})

    def ask(self, service: str, verb: str, given: dict[str, Any]) -> None:
        self.targets += 1
        self.stops_left -= 1
        self.mode = "fault" if self.stops_left >= 0 else "follow"

    def estimate(self) -> SimpleNamespace | None:
        return None

    def reset(self) -> None:
        self.mode = "off"

    def engage(self) -> None:
        self.mode = "follow"


@pytest.mark.parametrize(("stops", "targets", "counted"), [(0, 1, 0), (1, 2, 1), (9, TRIES, TRIES - 1)])
def test_a_target_is_given_again_when_the_hal_stopped_the_arm_on_the_way(
    monkeypatch: pytest.MonkeyPatch, stops: int, targets: int, counted: int
) -> None:
    monkeypatch.setattr(actor_module, "ENGAGED_WITHIN", 0.02)
    robot, said = Stopping(stops), []
    mover = Actor(robot, lambda: None, said.append)  # type: ignore[arg-type]
    mover.go("joint_position", np.zeros(5), 0.02)
    assert (robot.targets, mover.stops) == (targets, counted)
    assert sum("Life guard" in sentence for sentence in said) == counted


@pytest.mark.parametrize(
    ("first", "hidden", "leaked"),
    [
        (0.0, 0.6, 0.0),  # wrong at once, and hidden in time
        (3.0, 3.6, 0.0),  # frozen while the arm rests: wrong when it moves
        (3.0, 6.0, 1.0),  # wrong from 3 s on, so a leak from 5 s to 6 s
        (0.0, 9.0, 6.0),
    ],
)
def test_a_leak_is_counted_from_the_first_wrong_value(first: float, hidden: float, leaked: float) -> None:
    at = np.arange(0.0, 8.0, 0.01)
    late = leaks(at, at >= hidden, np.where(at >= first, 0.3, 0.02))
    assert late.sum() * 0.01 == pytest.approx(leaked, abs=0.02)
    assert not leaks(at, np.zeros(len(at), bool), np.full(len(at), np.nan)).any()


class Creeping:
    """An arm that begins to move after 0.3 s and arrives after `arrives` [s]; the waits are not waited."""

    def __init__(self, arrives: float) -> None:
        self.arrives, self.now, self.waited = arrives, 100.0, 0.0

    def monotonic(self) -> float:
        return self.now

    def truth(self, signal: str) -> np.ndarray:
        share = np.clip((self.now - 100.0 - 0.3) / (self.arrives - 0.3), 0.0, 1.0)
        return share * np.array([0.0, 1.0, -0.5, 0.0, 0.2])

    def go(self, signal: str, values: np.ndarray, duration: float, ends: Any) -> None:
        end = self.now + duration
        has_ended = ends()
        while self.now < end and not has_ended():
            self.now += 0.01
        self.waited = self.now - 100.0


@pytest.mark.parametrize(("arrives", "waited"), [(0.31, 0.71), (1.2, 1.5), (9.0, POSE_TIME)])
def test_a_test_pose_lasts_until_the_arm_rests(monkeypatch: pytest.MonkeyPatch, arrives: float, waited: float) -> None:
    arm = Creeping(arrives)
    monkeypatch.setattr(story_module, "time", arm)
    played = MuscleStory(ROBOT, arm, arm, 0, arm, print)  # type: ignore[arg-type]
    played._actor.go("joint_position", np.zeros(5), POSE_TIME, ends=played._at_rest)
    assert arm.waited == pytest.approx(waited, abs=0.03)


def test_a_wait_begins_anew_with_the_target_that_is_sent_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(actor_module, "ENGAGED_WITHIN", 0.02)
    robot, begun = Stopping(1), []
    mover = Actor(robot, lambda: None, print)  # type: ignore[arg-type]
    mover.go("joint_position", np.zeros(5), 0.02, ends=lambda: begun.append(robot.targets) or (lambda: False))  # type: ignore[func-returns-value]
    assert begun == [1, 2]


class Cut(Stopping):
    """A robot that the HAL stops because an element of a cut muscle is distrusted, a moment after it has stopped."""

    def __init__(self) -> None:
        super().__init__(1)
        self.looks = 0

    def estimate(self) -> SimpleNamespace:
        self.looks += 1
        reasons = {"muscle_length.deltoid_side": "distrusted: offset since 12:03:11"} if self.looks > 3 else {}
        return SimpleNamespace(distrusted=reasons)

    def engage(self) -> None:
        raise CommandRefused("muscle_length.deltoid_side is distrusted, and motion needs it.")


def test_an_arm_with_a_cut_muscle_may_stay_off() -> None:
    robot, said = Cut(), []
    mover = Actor(robot, lambda: None, said.append)  # type: ignore[arg-type]
    mover.go("joint_position", np.zeros(5), 0.02, lambda: bool(robot.estimate().distrusted))
    assert (robot.targets, mover.stops, said) == (1, 0, [])


class Lost(Stopping):
    """A robot whose drives were lost when it was reset, and return with a fault while it is off."""

    def __init__(self) -> None:
        super().__init__(0)
        self.mode, self.resets = "fault", 0

    def status(self, service: str, timeout: float = 0.0) -> Status:
        return Status(service="hal", state="running" if self.resets > 1 else "degraded")

    def sample(self) -> None:
        return None

    def reset(self) -> None:
        super().reset()
        self.resets += 1

    def engage(self) -> None:
        if self.resets < 2:
            raise CommandRefused("'elbow_drive' is fault, not ready, so nothing was enabled.")
        super().engage()


def test_drives_that_return_with_a_fault_are_reset_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(actor_module, "ENGAGED_WITHIN", 0.02)
    robot = Lost()
    Actor(robot, lambda: None, print).engage()  # type: ignore[arg-type]
    assert (robot.mode, robot.resets) == ("follow", 2)


class Reporting:
    """A clock that advances by what is slept, and a report that is true in some spans of it [s]."""

    def __init__(self, *spans: tuple[float, float]) -> None:
        self.now, self.spans = 0.0, spans

    def monotonic(self) -> float:
        return self.now

    def sleep(self, duration: float) -> None:
        self.now += duration

    def is_reported(self) -> bool:
        return any(start <= self.now < end for start, end in self.spans)


@pytest.mark.parametrize(
    ("spans", "expected"),
    [
        ([(0.1, 9.0)], (True, 0.1)),
        ([(0.1, 0.14), (0.5, 9.0)], (True, 0.5)),  # one late message looked like the event
        ([(0.1, 0.14)], (False, NOTICED_WITHIN)),
        ([], (False, NOTICED_WITHIN)),
        ([(NOTICED_WITHIN + 0.5, 9.0)], (False, NOTICED_WITHIN)),
    ],
)
def test_an_event_is_noticed_when_its_report_stays(
    monkeypatch: pytest.MonkeyPatch, spans: list[tuple[float, float]], expected: tuple[bool, float]
) -> None:
    reporting = Reporting(*spans)
    monkeypatch.setattr(actor_module, "time", reporting)
    noticed, delay = Actor(None, lambda: None, print).notice(reporting.is_reported)  # type: ignore[arg-type]
    assert (noticed, delay) == (expected[0], pytest.approx(expected[1], abs=0.02))


@pytest.mark.parametrize(("stall", "ends"), [(0.0, 1.0), (0.05, 1.05), (5.0, 6.0)])
def test_time_in_which_the_machine_stands_still_is_not_counted(
    monkeypatch: pytest.MonkeyPatch, stall: float, ends: float
) -> None:
    clock = Reporting()
    stalls = iter([stall])
    monkeypatch.setattr(actor_module, "time", clock)

    def idle() -> None:
        if clock.now > 0.5:
            clock.sleep(next(stalls, 0.0))

    assert not Actor(None, idle, print).wait(lambda: False, 1.0)  # type: ignore[arg-type]
    assert clock.now == pytest.approx(ends, abs=0.12)


class Unreachable:
    """A client whose camera cannot be reached for so many questions of 2 s, on a clock of its own."""

    def __init__(self, misses: int) -> None:
        self.now, self.misses, self.faults = 0.0, misses, []  # type: ignore[var-annotated]

    def monotonic(self) -> float:
        return self.now

    def fault(self, text: str, service: str) -> None:
        if self.misses:
            self.misses -= 1
            self.now += 2.0
            kind = (TooSlow, ServiceUnavailable, TooLate)[self.misses % 3]
            raise kind(f"No '{service}' service answered within 2 s.")
        self.faults.append((service, text))

    def sleep(self, duration: float) -> None:
        self.now += duration


@pytest.mark.parametrize(("misses", "is_reached"), [(0, True), (3, True), (9, False)])
def test_a_camera_that_is_out_of_reach_for_a_moment_is_asked_again(
    monkeypatch: pytest.MonkeyPatch, misses: int, is_reached: bool
) -> None:
    client, idled = Unreachable(misses), []
    monkeypatch.setattr(actor_module, "time", client)
    actor = Actor(client, lambda: idled.append(client.now), print)  # type: ignore[arg-type]
    if is_reached:
        actor.fault("camera_covered", "vision")
        assert client.faults == [("vision", "camera_covered")]
        assert len(idled) == misses
    else:
        with pytest.raises(ServiceError, match="No 'vision' service"):
            actor.fault("camera_covered", "vision")
        assert client.now <= REACHED_WITHIN + 2.1
