"""The experiments on the PR2: their tools, and the whole of them with a model too small to be good."""

from pathlib import Path

import numpy as np
import pytest

from gemuco.search.descent import DescentConfig
from hal.config import RobotConfig, load_robot
from studies.paper.pr2 import arm as pr2_arm
from studies.paper.pr2 import trials as pr2_trials
from studies.paper.pr2.actual import actual, flexible_grasps, split
from studies.paper.pr2.arm import JOINTS, TIP, Arm, Geometry, duster_motion
from studies.paper.pr2.experiment import Outcome, summary
from studies.paper.pr2.figures import draw
from studies.paper.pr2.simulated import BELIEVED, ELEVATION, OTHER_ELEVATION, simulate
from studies.paper.runs import open_run

ROBOT = load_robot(Path(__file__).parents[2] / "robots" / "pr2_duster.yaml")


def small(robot: RobotConfig) -> RobotConfig:
    parts = {
        "network": {"hidden": [40], "latent": 20, "bias": 2},
        "structure": {"threshold_out": 0.4, "threshold_in": 0.4, "epochs": 15},
        "training": {"epochs": 30, "batch": 50, "rate": 0.01},
    }
    return robot.model_copy(update={"model": {**robot.model, **parts}, "collect": {**robot.collect, "samples": 60}})


def test_the_motion_is_the_papers():
    motion = duster_motion()
    assert motion[5] - motion[0] == pytest.approx([0.2, 0.0, -0.2])
    assert motion[10] - motion[0] == pytest.approx([0.0, 0.1, 0.0])
    assert motion[-1] - motion[0] == pytest.approx([0.0, 0.4, 0.0])


@pytest.mark.parametrize("elevation", [ELEVATION, OTHER_ELEVATION])
def test_inverse_kinematics_meets_the_motion_and_the_tools_rotation(elevation):
    geometry, motion = Geometry(ROBOT), duster_motion()[:6]
    postures = geometry.follow(motion, BELIEVED, elevation)
    assert geometry.tips(BELIEVED, postures) == pytest.approx(motion, abs=1e-4)
    assert geometry.elevations(postures) == pytest.approx(np.full((6, 1), np.sin(elevation)), abs=1e-4)
    assert (postures > geometry.low).all()
    assert (postures < geometry.high).all()


def test_the_arm_arrives_within_its_limits_and_takes_another_duster():
    geometry = Geometry(ROBOT)
    with Arm(ROBOT, "nominal", 0, "l300_phi0") as arm:
        posture = geometry.high - 0.1
        measured = arm.go(posture)
        assert measured[JOINTS] == pytest.approx(posture, abs=1e-3)
        assert arm.tip() == pytest.approx(geometry.tips("l300_phi0", posture[None])[0], abs=1e-3)
        arm.hold("l700_phi60")
        assert arm.tip() == pytest.approx(geometry.tips("l700_phi60", posture[None])[0], abs=1e-3)
        assert arm.go(geometry.high + 1.0)[JOINTS] == pytest.approx(geometry.high, abs=1e-3)


def test_the_flexible_duster_has_six_grasps_that_the_file_does_not_list():
    assert len(flexible_grasps(ROBOT)) == 6
    assert not set(flexible_grasps(ROBOT)) & set(ROBOT.conditions)


@pytest.mark.slow
def test_both_experiments_run_and_have_all_figures(tmp_path, monkeypatch):
    monkeypatch.setattr(pr2_arm, "STROKES", 2)
    monkeypatch.setattr(pr2_trials, "SEARCH", DescentConfig(0.5, 10, 10))
    run = open_run(small(ROBOT), tmp_path, seed=0)
    shares: list[float] = []
    simulated = simulate(run, lambda share, text: shares.append(share))
    tuned = actual(run, simulated.schema, lambda share, text: shares.append(share))
    assert simulated.schema.x_out == (TIP,)
    assert max(shares) <= 1.0
    assert simulated.controlled["p"].trial.errors[0] == pytest.approx(0.26, abs=0.12)
    report = summary([0], [Outcome(simulated, tuned)])
    assert all(np.isfinite(row.values).all() for row in report.rows)
    draw(tmp_path, [simulated], [tuned])
    assert {path.name for path in tmp_path.glob("*.png")} == {
        "bias_map.png",
        "estimation.png",
        "control.png",
        "actual.png",
    }
    again = simulate(open_run(small(ROBOT), tmp_path, seed=0), lambda share, text: None)
    assert again.held_out == simulated.held_out
    first, last = split(run.cached("nominal", lambda: pytest.fail("collected again")), 0.5)
    assert len(first) + len(last) == 9 * 60
