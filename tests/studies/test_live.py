"""The model service in simulated time: its loops keep their rates, and a play of a lie has a result."""

from pathlib import Path

import numpy as np
import pytest

from gemuco import BodySchema, TrainConfig, fit
from hal.config import load_robot
from simulators.robots.pr2_duster.body import tool_tip
from simulators.robots.pr2_duster.duster import GRASPS
from studies.accuracy.lies import Body
from studies.live import bodies, liars, tools
from studies.live.liars import JOINTS, TIP, arrivals, motion
from studies.live.service import LiveService

GRASP = "l300_phi0"


@pytest.fixture(scope="module")
def model() -> BodySchema:
    robot, draw = load_robot("robots/pr2_duster.yaml"), np.random.default_rng(0)
    low, high = robot.bounds(JOINTS)
    positions = draw.uniform(low, high, (300, 7))
    rows = {JOINTS: positions, TIP: tool_tip(GRASPS[GRASP], positions)}
    episodes = [{name: value[i : i + 30] for name, value in rows.items()} for i in range(0, 300, 30)]
    config = TrainConfig(hidden=(20, 20), latent=6, epochs=2, batch=50)
    return fit(episodes, config, [(JOINTS,)], units={JOINTS: "rad", TIP: "m"})[0]


def test_loops_keep_their_rates_and_a_covered_camera_is_estimated(model: BodySchema) -> None:
    robot = load_robot("robots/pr2_duster.yaml")
    positions = motion(robot, GRASP, 1, 4.0)
    service, methods = LiveService(robot, model), []
    for time, values, age in arrivals(positions, tool_tip(GRASPS[GRASP], positions), 3.0):
        service.run_until(time)
        if not age:
            service.hal(values)
        elif time < 2.0:
            service.camera(values, age)
        latest = service.model.estimation.latest
        methods.append((time, latest.method[TIP] if latest is not None else "none"))
    assert {method for time, method in methods if 0.2 < time < 2.0} == {"measured"}
    assert {method for time, method in methods if time > 2.3} == {"mask"}
    assert service.now == pytest.approx(time)
    done = {loop.name: loop for loop in service.model.loops}
    assert service.model.estimation.latest is not None
    assert done["estimation"].rate == robot.rates.estimation
    assert service.model.estimation.latest.cycle == pytest.approx(time * 50, abs=2)


def test_motion_stays_within_the_limits_and_rests_now_and_then() -> None:
    robot = load_robot("robots/pr2_duster.yaml")
    positions = motion(robot, GRASP, 2, 20.0)
    low, high = robot.bounds(JOINTS)
    assert len(positions) >= 2000
    assert (positions >= low).all() and (positions <= high).all()
    rests = (np.diff(positions, axis=0) == 0.0).all(axis=1).mean()
    assert 0.1 < rests < 0.9


@pytest.mark.parametrize("kind", ["offset", "frozen", "drift", "none"])
def test_lies_of_recorded_motion_are_played_to_the_service(model: BodySchema, kind: str, monkeypatch) -> None:
    monkeypatch.setattr(bodies, "BEFORE", 1)
    monkeypatch.setattr(bodies, "AFTERWARDS", 1)
    joints = np.repeat(motion(load_robot("robots/pr2_duster.yaml"), GRASP, 3, 4.0), 2, axis=0)
    rows = model.scaler.normalise(np.c_[joints, tool_tip(GRASPS[GRASP], joints)])
    columns, given = np.arange(10), []
    body = Body(model, {"": rows}, columns, np.full(10, 0.1), np.zeros((11, 10)), np.ones(10))
    monkeypatch.setattr(LiveService, "hal", lambda self, values: given.append(values[JOINTS]))
    monkeypatch.setattr(LiveService, "camera", lambda self, values, age: given.append(values[TIP]))
    outcome = bodies.play(load_robot("robots/pr2_duster.yaml"), body, kind, 1, learns=False)
    assert bool(outcome.liar) == (kind != "none")
    assert np.isnan(outcome.delay) and not outcome.wrong
    assert outcome.size > 0.0
    assert len(given) == 2 * 2 * bodies.RATE - bodies.LATE, "the camera's values come late"


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_a_changed_tool_is_recognised_and_no_right_sensor_is_hidden(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(liars, "CACHE", tmp_path)
    robot = load_robot("robots/pr2_duster.yaml")
    schema = liars.model_of("pr2_duster")
    for number in range(3):
        play = tools.play(robot, schema, 1, tools.SHIFT * number)
        assert not play.hidden and not play.stops
        assert play.recognised(robot.conditions[-1]), play
        assert play.tools[0][0] == robot.conditions[0]
