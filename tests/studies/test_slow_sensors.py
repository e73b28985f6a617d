"""Values that come every 0.1 s beside drives that are read in every cycle: right ones are used, lies are found soon."""

from pathlib import Path

import pytest

from studies.live.slow_sensors import learned, play, robot_in

SPEED, SECONDS = 1.0, 30.0


@pytest.mark.slow
def test_slow_sensors_are_judged_at_the_time_of_the_others(tmp_path: Path) -> None:
    robot = robot_in(tmp_path)
    schema = learned(robot)
    for seed in (20, 21, 22):
        assert not play(robot, schema, seed, SPEED, SECONDS).hidden, seed
    for seed, lie in ((23, "force.f01"), (24, "joint_position.b"), (25, "force.f30")):
        outcome = play(robot, schema, seed, SPEED, SECONDS, lie)
        assert outcome.delay < 1.5, lie  # s; beside values that are held it was 2 to 12 s
        assert not outcome.hidden, lie
