"""Moving a robot from the page, with a HAL, simulated drives and a client between."""

import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from small_arm import Processes, eventually

from services.client import Client
from services.errors import CommandHeld
from services.view.teaching import PAGE_PATIENCE, PRESSED, NotTeaching, Reach, Teacher

PAGE, OTHER = 1, 2
HAL = {
    "signals": {"joint_position": {"unit": "rad", "elements": ["a", "b"]}},
    "command": {"signal": "joint_position", "time_to_live": 0.1},
    "limits": {"joint_position": {"low": [-1.0, 0.0], "high": 1.0, "rate": 2.0}},
}
REACH = Reach("muscle_length", "m", ("biceps", "triceps"), np.full(2, -0.2), np.full(2, 0.2), np.full(2, 0.05), 0.2)


@pytest.fixture
def arm(robot: str, tmp_path: Path) -> Iterator[Processes]:
    with Processes(robot, tmp_path) as found:
        yield found


@pytest.fixture
def teacher(arm: Processes) -> Iterator[Teacher]:
    found = Teacher(lambda: arm.client)
    found.start()
    yield found
    found.stop()


def lengths(arm: Processes) -> np.ndarray:
    sample = arm.client.sample(timeout=2.0)
    assert sample is not None
    return sample.values["muscle_length"].copy()


def taken(arm: Processes, teacher: Teacher) -> np.ndarray:
    teacher.take_over(PAGE, REACH)
    eventually(lambda: teacher.set_point is not None)
    at = teacher.set_point
    assert at is not None
    return at


def test_limits_are_those_of_the_robot_file():
    reach = Reach.of(HAL)
    assert reach.low.tolist() == [-1.0, 0.0]
    assert reach.high.tolist() == [1.0, 1.0]
    assert np.all(reach.speed < 2.0)
    with pytest.raises(NotTeaching, match="needs limits"):
        Reach.of(HAL | {"limits": {}})
    with pytest.raises(NotTeaching, match="has not described"):
        Reach.of({})


@pytest.mark.long
def test_it_moves_while_the_button_is_held_and_stops_when_it_is_not(arm: Processes, teacher: Teacher):
    start = taken(arm, teacher)
    teacher.set_target(start + 5.0)
    time.sleep(0.3)  # nothing but time would show that it moves by itself
    assert np.allclose(lengths(arm), start, atol=2e-3)
    until = time.monotonic() + 0.6
    while time.monotonic() < until:
        teacher.hold(PAGE)
        teacher.hold(OTHER)
        time.sleep(0.05)
    eventually(lambda: not teacher.is_moving)
    where = teacher.set_point
    assert where is not None
    assert np.all(where - start > 0.01)
    assert np.all(where - start < REACH.speed * (1.0 + PRESSED + 0.6))  # the robot file's limit is 0.25 m/s
    eventually(lambda: arm.mode() in ("hold", "follow"))
    eventually(lambda: np.allclose(lengths(arm), where, atol=3e-3))


@pytest.mark.long
def test_a_step_goes_so_far_and_no_further(arm: Processes, teacher: Teacher):
    start = taken(arm, teacher)
    teacher.set_target(np.array([0.2, start[1]]))
    teacher.step(OTHER)
    assert not teacher.is_moving
    teacher.step(PAGE)
    eventually(lambda: not teacher.is_moving)
    assert teacher.set_point == pytest.approx(np.add(start, (0.008, 0.0)), abs=1e-6)


@pytest.mark.long
def test_the_robot_is_let_go_when_the_page_is_closed(arm: Processes, teacher: Teacher):
    taken(arm, teacher)
    teacher.let_go("The page was closed.", OTHER)
    assert teacher.owner == PAGE
    teacher.let_go("The page was closed.", PAGE)
    assert teacher.owner is None
    eventually(lambda: arm.mode() == "off")


@pytest.mark.long
def test_the_robot_is_let_go_when_the_page_hangs(arm: Processes, teacher: Teacher):
    taken(arm, teacher)
    begun = time.monotonic()
    eventually(lambda: teacher.owner is None)
    assert time.monotonic() - begun < PAGE_PATIENCE + 1.5
    assert "hangs" in teacher.text
    eventually(lambda: arm.mode() == "off")


@pytest.mark.long
def test_a_page_that_answers_keeps_the_robot(arm: Processes, teacher: Teacher):
    taken(arm, teacher)
    until = time.monotonic() + PAGE_PATIENCE + 0.5
    while time.monotonic() < until:
        teacher.confirm_page(PAGE)
        time.sleep(0.1)
    assert teacher.owner == PAGE


@pytest.mark.long
def test_the_robot_is_let_go_when_the_hal_dies(arm: Processes, teacher: Teacher):
    taken(arm, teacher)
    arm.kill("hal")
    eventually(lambda: teacher.owner is None)
    assert teacher.text


@pytest.mark.long
def test_only_one_teaches_and_nobody_while_another_client_commands(arm: Processes, teacher: Teacher):
    taken(arm, teacher)
    with pytest.raises(NotTeaching, match="Another browser window"):
        teacher.take_over(OTHER, REACH)
    teacher.let_go("")
    eventually(lambda: arm.mode() == "off")
    with Client(arm.robot, name="somebody else") as other, other.lease():
        with pytest.raises(CommandHeld, match="somebody else"):
            teacher.take_over(PAGE, REACH)
        assert teacher.owner is None
