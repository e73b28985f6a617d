"""A simulator of a user's own beside the robot file: the one that docs/robots.md shows."""

import re
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import yaml
from on_bench import arrives, cycle_until, virtual

from hal.config import RobotConfig, load_robot
from hal.robot import open_robot
from services.hardware.stand_in import simulator_of

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "robots.md").read_text()
ROBOT = """\
robot: pendulum
signals:
  joint_position: {unit: rad, elements: [swing]}
  joint_effort: {unit: N m, elements: [swing]}
command: {signal: joint_position}
limits: {joint_position: {low: -1.5, high: 1.5, rate: 5}}
buses: {can0: {interface: hub, channel: pendulum_can0}}
kinds:
  drive: {driver: mit, settings: {motor: DM4310, stiffness: 40, damping: 2, ramp: 0.1}}
devices:
  swing: {kind: drive, bus: can0, node: 1, elements: {position: joint_position.swing, effort: joint_effort.swing}}
simulator: my_sim:simulator
"""


@pytest.fixture
def file(tmp_path: Path) -> Iterator[Path]:
    (code,) = re.findall(r'```python\n("""my_sim.py: .*?)```', PAGE, re.DOTALL)
    (tmp_path / "my_sim.py").write_text(code)
    (tmp_path / "pendulum.yaml").write_text(ROBOT)
    before = sys.path.copy()
    yield tmp_path / "pendulum.yaml"
    sys.path[:] = before
    sys.modules.pop("my_sim", None)


def test_it_is_found_beside_the_robot_file_and_swings_without_a_bus(file: Path) -> None:
    config = load_robot(file)
    simulator = simulator_of(config)
    assert simulator.variants == ("nominal",)
    robot = simulator.direct(config, "nominal", 0)
    with robot:
        angles = []
        for _ in range(600):
            sample, _ = robot.cycle()
            angles.append(float(sample.values["joint_position"][0]))
            robot.clock.sleep_until(robot.clock.monotonic() + robot.period)
    assert min(angles) < -0.05  # it swings to the other side
    assert abs(angles[-1]) < 0.3


@pytest.mark.long
def test_it_answers_on_the_bus_and_is_held(file: Path) -> None:
    load_robot(file)  # makes its folder known
    config: RobotConfig = virtual(yaml.safe_load(file.read_text()) | {"folder": file.parent})
    rig = simulator_of(config).rig(config, "nominal", 0)
    rig.start()
    try:
        with open_robot(config) as robot:
            cycle_until(robot, arrives("joint_position", np.array([0.8]), 0.05), np.array([0.8]))
    finally:
        rig.stop()
