"""What the model service can be asked, near and far: the same verbs, the same numbers, the same exceptions."""

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pytest
from arm_model import arm, small_model, states
from talking_robot import TalkingRobot

from gemuco.anomaly.score import score
from gemuco.errors import NotEnoughData, NotFinite, NotObservable, UnknownSignal, WrongSize
from gemuco.estimation import estimate
from services.client import SLOW_TIMEOUT, Client
from services.errors import BadArguments
from services.model import model_verbs
from services.model.control_config import controller_of, simulator_of
from services.model.gemuco_service import GemucoService
from services.model.model_verbs import ModelVerbs
from services.process.service import Service
from services.verbs.ask import ask_robot, estimate_line


@pytest.fixture
def model(robot: str) -> Iterator[GemucoService]:
    config = arm().model_copy(update={"robot": robot})
    with Service(robot, "model", (), dict) as service:
        made = GemucoService(config, small_model(), service)
        for name, handler in ModelVerbs(made).handlers().items():
            service.verb(name, handler)
        yield made


@pytest.fixture
def client(model: GemucoService, robot: str) -> Iterator[Client]:
    with Client(robot) as far:
        yield far


@pytest.fixture
def sample() -> dict[str, np.ndarray]:
    return {name: rows[3] for name, rows in states(seed=5).items()}


def test_estimates_given_values_like_the_schema_itself(client: Client, sample: dict[str, np.ndarray]) -> None:
    far = client.estimate(sample, hide=["joint_position"])
    near = estimate(small_model(), {name: value for name, value in sample.items() if name != "joint_position"})
    assert far is not None
    for name, known in near.items():
        np.testing.assert_allclose(far.values[name], known.value)
        np.testing.assert_allclose(far.std[name], known.std)
        assert far.method[name] == known.method
    assert far.mask["joint_position"] == "muscle_tension+muscle_length"


def test_judges_given_values_like_the_schema_itself(client: Client, sample: dict[str, np.ndarray]) -> None:
    broken = {**sample, "muscle_tension": sample["muscle_tension"] + 100.0}
    for values in (sample, broken):
        far, near = client.anomaly(values), score(small_model(), values)
        assert far is not None
        assert far.score == pytest.approx(near.score)
        assert (far.is_anomaly, far.blamed) == (near.is_anomaly, near.blamed)
    assert near.is_anomaly


def test_solves_for_a_command_without_moving(
    client: Client, model: GemucoService, sample: dict[str, np.ndarray]
) -> None:
    target = {"joint_position": sample["joint_position"]}
    assert model.config.control is not None
    near = controller_of(small_model(), model.robot, model.config.control).solve(target, sample)
    far = client.control(target, sample)
    np.testing.assert_allclose(far["values"], near.command)
    assert (far["signal"], far["route"], far["mask"]) == ("muscle_length", "input", "joint_position+muscle_tension")
    assert far["residual"] == pytest.approx(near.residual)
    low, high = model.robot.bounds("muscle_length")
    assert ((low <= far["values"]) & (far["values"] <= high)).all()


def test_verbs_that_compute_for_long_run_below_the_loops(
    client: Client, sample: dict[str, np.ndarray], monkeypatch: pytest.MonkeyPatch
) -> None:
    lowered: list[int] = []

    @contextmanager
    def at_most(priority: int) -> Iterator[None]:
        lowered.append(priority)
        yield

    monkeypatch.setattr(model_verbs, "at_most", at_most)
    client.estimate(sample)
    client.anomaly(sample)
    assert not lowered  # they take less than a millisecond
    client.control({"joint_position": sample["joint_position"]}, sample)
    client.simulate([sample["muscle_length"]], values=sample)
    with pytest.raises(NotEnoughData):
        client.learn_normal()
    assert lowered == [10, 10, 10]


@pytest.mark.parametrize("verb", ["normal", "rollback"])
def test_what_takes_long_is_waited_for(verb: str, robot: str, monkeypatch: pytest.MonkeyPatch) -> None:
    waited: dict[str, float] = {}

    def ask(client: Client, service: str, verb: str, arguments: object = None, timeout: float = 2.0) -> dict[str, int]:
        waited[f"{service} {verb}"] = timeout
        return {"samples": 100, "model_version": 1}

    monkeypatch.setattr(Client, "ask", ask)
    assert ask_robot(robot, verb, [], (), False, ()) == 0
    assert waited == {f"model {verb}": SLOW_TIMEOUT}


def test_simulates_commands_step_after_step(
    client: Client, model: GemucoService, sample: dict[str, np.ndarray]
) -> None:
    commands = [sample["muscle_length"], sample["muscle_length"] + 0.005]
    far = client.simulate(commands, values=sample)
    near = list(simulator_of(small_model(), model.robot, model.config.simulation).run(commands, None, sample))
    np.testing.assert_allclose(far["states"]["joint_position"], [step.values["joint_position"] for step in near])
    np.testing.assert_allclose(far["residual"], [step.residual for step in near])
    assert far["route"] == near[0].route


def test_an_error_is_the_same_near_and_far(client: Client, sample: dict[str, np.ndarray]) -> None:
    with pytest.raises(UnknownSignal, match="Known signals: joint_position"):
        client.control({"elbow": [0.0]})
    with pytest.raises(NotObservable, match="is in no term"):
        client.control({"joint_position": sample["joint_position"], "muscle_length": sample["muscle_length"]})
    with pytest.raises(NotFinite, match="every element needs a number"):
        client.control({"joint_position": [0.0, np.nan, 0.0, 0.0, 0.0]})
    with pytest.raises(WrongSize, match="has 10 elements"):
        client.simulate([[0.1, 0.2]])
    with pytest.raises(UnknownSignal, match="Known signals"):
        client.anomaly(hide=["elbow"])
    with pytest.raises(BadArguments, match="must be a list of 1 to 200 commands"):
        client.simulate([])
    with pytest.raises(BadArguments, match="must be a map"):
        client.ask("model", "control", {"target": [1.0]})
    with pytest.raises(BadArguments, match="Known arguments: target, values"):
        client.ask("model", "control", {"targets": {}})


def test_the_command_line_asks_too(model: GemucoService, robot: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert ask_robot(robot, "control", ["joint_position", "0", "0", "0", "-0.6", "0"], (), False, ()) == 0
    assert "signal: muscle_length" in capsys.readouterr().out
    assert ask_robot(robot, "anomaly", [], ["joint_position"], False, ()) == 0
    scored = capsys.readouterr().out
    assert "score:" in scored
    assert "verdict:" not in scored, "a single sample has none"
    command = [str(value) for value in states(seed=5)["muscle_length"][3]]
    assert ask_robot(robot, "simulate", command, (), False, ()) == 0
    assert "states:" in capsys.readouterr().out


def test_the_command_line_returns_the_verdict_that_is_published(robot: str, capsys: pytest.CaptureFixture[str]) -> None:
    with TalkingRobot(robot) as talking:
        talking.verdict = "environment"
        assert ask_robot(robot, "anomaly", [], (), False, ()) == 0
    assert "verdict: environment\nis_anomaly: false\n" in capsys.readouterr().out


def test_history_holds_what_was_estimated(client: Client, model: GemucoService) -> None:
    for _ in range(3):
        model.estimation.tick()
    found = client.history(60.0, timeout=20.0)
    assert len(found.stamp_ns) == 3
    assert list(found.values) == list(small_model().layout.names)
    latest = model.estimation.latest
    assert latest is not None
    for name, values in latest.values.items():
        np.testing.assert_array_equal(found.values[name][-1], values)
        np.testing.assert_array_equal(found.estimated[name][-1], latest.estimated[name])
    with pytest.raises(BadArguments, match="Known arguments: seconds, signals, begin, end"):
        client.ask("model", "history", {"minutes": 1})


def test_an_estimate_that_is_not_known_says_why_in_its_line() -> None:
    reply = {
        "signal": "joint_position", "unit": "rad", "elements": ["elbow"], "values": [0.3], "std": [0.2],
        "estimated": [True], "method": "mask", "mask": "muscle_length", "state": "unknown", "reason": "too far",
    }  # fmt: skip
    line = "joint_position [rad]  elbow +0.300*  * estimated from muscle_length, expected error 0.200 rad"
    assert estimate_line(reply) == f"{line}; unknown: too far"
    assert estimate_line(reply | {"state": "known", "reason": ""}) == line


def test_the_std_is_widened_by_the_errors_seen(
    client: Client, model: GemucoService, sample: dict[str, np.ndarray]
) -> None:
    before = client.estimate(sample, hide=["joint_position"])
    joints = slice(0, 5)
    for _ in range(40):
        missed = np.full(25, np.nan)
        missed[joints] = 1.0  # rad
        model.hindsight._errors.see(missed, np.full(25, 0.1))
    after = client.estimate(sample, hide=["joint_position"])
    assert before is not None and after is not None
    ratio = after.std["joint_position"] / before.std["joint_position"]
    np.testing.assert_allclose(ratio, 1.0 / 0.16449, rtol=1e-3)
    assert after.state["joint_position"] in ("doubtful", "unknown")
