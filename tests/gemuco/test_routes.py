"""Which way control goes, and what it reaches: arms that hold a tool, whose structure is that of PR2 and of KXR."""

import numpy as np
import pytest
from tool_arm import LAYOUT, ToolArm, dataset

from gemuco.controller import control
from gemuco.dataset import Dataset, Episode
from gemuco.errors import NotFinite, NotObservable, SchemaError, UnknownSignal, WrongSize
from gemuco.learning.train import TrainConfig
from gemuco.schema import BodySchema
from gemuco.search.descent import DescentConfig
from gemuco.search.losses import Hold, Match, StayNear, StaySmall
from gemuco.structure.determination import learn

ARMS = {"short": ToolArm(0.2), "long": ToolArm(0.4, mass=0.6)}
SMALL = TrainConfig(hidden=(60, 30), latent=6, bias_size=2, epochs=60, batch=100)
PATIENT = DescentConfig(0.5, 10, 60)
COMMAND, TIP, COG = "joint_position", "tool_tip_position", "center_of_gravity"


@pytest.fixture(scope="module")
def simple() -> BodySchema:
    """Joints in, tip out."""
    whole = dataset(ARMS, 600)
    layout = LAYOUT.subset((COMMAND, TIP))
    parts = tuple(Episode(e.condition, {n: e.values[n] for n in layout.names}) for e in whole.episodes)
    return learn(Dataset(layout, parts), SMALL, masks=[{COMMAND}], x_out=[TIP])


@pytest.fixture(scope="module")
def full() -> BodySchema:
    """Everything in, everything out."""
    masks = [{COMMAND}, {COMMAND, COG}, {COMMAND, TIP}, {COG, TIP}]
    return learn(dataset(ARMS, 600), SMALL, masks=masks)


def reached(command: np.ndarray, tool: str) -> np.ndarray:
    """The tip [m] that a command really brings about."""
    return ARMS[tool].measure(command[None], 0)[TIP][0]


def targets(tool: str, count: int = 5) -> list[dict[str, np.ndarray]]:
    """Samples within reach."""
    found = ARMS[tool].sample(count, 77)
    return [{name: values[i] for name, values in found.items()} for i in range(count)]


@pytest.mark.parametrize("tool", ["short", "long"])
def test_a_command_that_is_no_output_descends_as_input(simple, tool):
    under, errors = simple.under(tool), []
    for sample in targets(tool):
        near = sample[COMMAND] + 0.2
        solution = control(
            under,
            {TIP: sample[TIP], COMMAND: near},
            command=COMMAND,
            terms=(Match(TIP), StayNear(COMMAND, 0.05)),
            search=PATIENT,
        )
        assert (solution.route, solution.mask) == ("input", {COMMAND})
        errors.append(np.linalg.norm(reached(solution.command, tool) - sample[TIP]))
        assert np.linalg.norm(solution.command - near) < 1.0  # rad: of many postures one near by
    assert np.mean(errors) < 0.04  # m


def test_the_papers_rule_of_control(full):
    tip = targets("long", 1)[0]
    under = full.under("long")
    assert control(under, {TIP: tip[TIP]}, command=COMMAND).route == "latent"
    both = control(under, {TIP: tip[TIP], COG: tip[COG]}, command=COMMAND)
    assert (both.route, both.mask) == ("mask", {COG, TIP})
    lossy = control(
        under, {TIP: tip[TIP], COG: tip[COG]}, command=COMMAND, terms=(Match(TIP), Match(COG, 0.01), StaySmall(COG))
    )
    assert lossy.route == "latent"
    named = control(under, {TIP: tip[TIP]}, command=COMMAND, route="input")
    assert (named.route, named.mask) == ("input", {COMMAND})


def test_the_command_as_input_does_what_was_predicted(full):
    under = full.under("short")
    errors = {"latent": [], "input": []}
    for sample in targets("short"):
        for route, found in errors.items():
            solution = control(under, {TIP: sample[TIP]}, command=COMMAND, route=route, search=PATIENT)
            found.append(np.linalg.norm(reached(solution.command, "short") - sample[TIP]))
            assert np.isfinite(solution.residual)
    assert np.mean(errors["input"]) < 0.04  # m
    assert np.mean(errors["input"]) < np.mean(errors["latent"])


def test_the_residual_tells_a_command_that_does_not_do_it(full):
    under = full.under("short")
    far = control(under, {TIP: np.array([2.0, 2.0])}, command=COMMAND, route="input")
    near = control(under, {TIP: targets("short", 1)[0][TIP]}, command=COMMAND, route="input", search=PATIENT)
    assert far.residual > 1.0 > 10 * near.residual  # standard deviations


def test_a_constant_reference_and_a_matrix(full):
    terms = (Match(TIP, matrix=((0.0, 1.0),)), Match(COG, 0.01, value=(0.1,)))
    solution = control(full, {TIP: np.array([0.3])}, command=COMMAND, terms=terms, route="input", search=PATIENT)
    assert solution.predicted[TIP][1] == pytest.approx(0.3, abs=0.02)
    with pytest.raises(WrongSize, match="has 1 rows, but its reference has shape"):
        control(full, {TIP: np.zeros(2)}, command=COMMAND, terms=terms, route="input")


def test_commands_stay_inside_limits(full, simple):
    limits = {COMMAND: (np.full(3, -0.1), np.array([0.1, 0.1, np.inf]))}
    for schema, route in ((full, "input"), (full, "latent"), (simple, "auto")):
        solution = control(schema, {TIP: np.array([0.2, 0.7])}, command=COMMAND, route=route, limits=limits)
        assert (solution.command >= -0.1 - 1e-6).all()
        assert (solution.command[:2] <= 0.1 + 1e-6).all()


@pytest.mark.parametrize(("route", "mask"), [("input", None), ("latent", None), ("input", {COMMAND, COG})])
def test_a_held_element_is_held(full, route, mask):
    terms = (Match(TIP), Hold(COMMAND, (np.nan, 0.35, np.nan)))
    solution = control(
        full, {TIP: np.array([0.5, 0.5])}, command=COMMAND, terms=terms, route=route, mask=mask and frozenset(mask)
    )
    assert solution.command[1] == pytest.approx(0.35, abs=1e-3)


def test_a_held_prediction_is_held_on_the_way_of_inputs(simple):
    goal = np.array([0.7, 0.4])
    terms = (StayNear(COMMAND), Hold(TIP))
    home = {COMMAND: np.zeros(3)}
    solution = control(simple.under("short"), {TIP: goal}, home, command=COMMAND, terms=terms, search=PATIENT)
    np.testing.assert_allclose(solution.predicted[TIP], goal, atol=1e-3)
    free = control(
        simple.under("short"), {TIP: goal}, home, command=COMMAND, terms=(StayNear(COMMAND), Match(TIP)), search=PATIENT
    )
    assert np.linalg.norm(free.predicted[TIP] - goal) > 0.01  # a norm that loses


def test_says_what_is_wrong(simple, full):
    tip = {TIP: np.array([0.5, 0.5])}
    with pytest.raises(NotObservable, match="not in x_out; use input"):
        control(simple, tip, command=COMMAND, route="latent")
    with pytest.raises(NotObservable, match=r"is not feasible for this schema\. Feasible masks: joint_position,"):
        control(full, tip, command=COMMAND, route="input", mask=frozenset({TIP}))
    with pytest.raises(SchemaError, match="A mask goes with route mask or input"):
        control(full, tip, command=COMMAND, route="latent", mask=frozenset({COMMAND}))
    with pytest.raises(NotObservable, match="is in no term"):
        control(full, {**tip, COG: np.zeros(1)}, command=COMMAND, terms=(Match(TIP),))
    with pytest.raises(NotObservable, match="but a term is about 'joint_position'"):
        control(simple, {COMMAND: np.zeros(3)}, command=TIP, route="latent")
    with pytest.raises(NotFinite, match="every element needs a number"):
        control(full, {TIP: np.array([0.5, np.nan])}, command=COMMAND)
    with pytest.raises(NotObservable, match="There is nothing to reach"):
        control(full, {}, command=COMMAND)
    with pytest.raises(NotObservable, match="has no value"):
        control(full, {}, command=COMMAND, terms=(Hold(COG),), route="input")
    with pytest.raises(UnknownSignal, match="Known signals"):
        control(full, {"tip": np.zeros(2)}, command=COMMAND)
    with pytest.raises(SchemaError, match="is above its upper limit"):
        control(full, tip, command=COMMAND, route="input", limits={COMMAND: (np.ones(3), np.zeros(3))})
    with pytest.raises(SchemaError, match="must be a finite number"):
        Match(TIP, -1.0)
    with pytest.raises(SchemaError, match="std or si"):
        StaySmall(TIP, unit="mm")
    with pytest.raises(WrongSize, match="needs 2 columns"):
        control(full, tip, command=COMMAND, terms=(Match(TIP, matrix=((1.0,),)),))
    with pytest.raises(SchemaError, match="gamma_max > 0"):
        DescentConfig(gamma_max=float("nan"))
    with pytest.raises(WrongSize, match="needs numbers"):
        control(full, {TIP: ["far", "away"]}, command=COMMAND)
    with pytest.raises(UnknownSignal, match="Known signals"):
        control(full, tip, command=COMMAND, limits={"tip": (np.zeros(2), np.ones(2))})
    with pytest.raises(WrongSize, match="has 3 elements"):
        control(full, tip, command=COMMAND, limits={COMMAND: (np.zeros(2), np.ones(2))})
