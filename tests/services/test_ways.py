"""Ways to estimate missing elements: a tick never tries one, and normal samples of another body decide nothing."""

import numpy as np
import pytest
from arm_model import small_model, states

from gemuco.estimation import Recipe, fill
from gemuco.schema import BodySchema
from services.model.ways import Ways

ELEMENT = 5


class Known:
    """The body of which normal errors are known, or another one."""

    def __init__(self, is_known: bool = True) -> None:
        self.is_known = is_known

    def __call__(self, schema: BodySchema) -> bool:
        return self.is_known


@pytest.fixture(scope="module")
def finite() -> np.ndarray:
    """One element is missing."""
    elements = np.ones(small_model().layout.size, bool)
    elements[ELEMENT] = False
    return elements


@pytest.fixture
def tried(monkeypatch: pytest.MonkeyPatch) -> list[bool]:
    """Every recipe that is made, as whether its ways are tried."""
    made, make = [], Recipe.of

    def of(schema: BodySchema, finite: np.ndarray, is_tried: bool = False) -> Recipe:
        made.append(is_tried)
        return make(schema, finite, is_tried)

    monkeypatch.setattr(Recipe, "of", of)
    return made


def lasting(ways: Ways, schema: BodySchema, finite: np.ndarray) -> None:
    """Let elements be missing for two turns of the loop of verdicts."""
    for _ in range(2):
        ways.at_hand(schema, finite)
        ways.prepare()


def test_a_tick_tries_nothing_and_uses_what_was_tried_before(finite: np.ndarray, tried: list[bool]) -> None:
    schema, ways = small_model(), Ways(Known())
    first = ways.at_hand(schema, finite)
    assert not any(tried)
    lasting(ways, schema, finite)
    assert tried[-1]
    count, best = len(tried), ways.at_hand(schema, finite)
    assert len(tried) == count
    assert best is ways.best(schema, finite)
    assert best is not first


def test_nothing_is_tried_twice_or_for_a_whole_sample(finite: np.ndarray, tried: list[bool]) -> None:
    schema, ways = small_model(), Ways(Known())
    lasting(ways, schema, np.ones(len(finite), bool))
    assert not any(tried)
    for _ in range(3):
        lasting(ways, schema, finite)
    assert sum(tried) == 1


def test_sensors_that_are_late_for_a_moment_are_no_reason_for_a_trial(tried: list[bool]) -> None:
    schema, ways = small_model(), Ways(Known())
    for late in range(8):  # another one in every turn, as on a busy machine
        ways.at_hand(schema, np.arange(schema.layout.size) != late)
        ways.prepare()
        ways.prepare()  # and none was late
    assert not any(tried)


def test_another_body_is_not_judged_by_these_normal_samples(finite: np.ndarray, tried: list[bool]) -> None:
    schema, known = small_model(), Known()
    ways = Ways(known)
    lasting(ways, schema, finite)
    best = ways.at_hand(schema, finite)
    known.is_known = False
    assert ways.at_hand(schema, finite) is not best
    assert ways.best(schema, finite) is not best
    lasting(ways, schema, finite)
    assert sum(tried) == 1
    known.is_known = True
    assert ways.at_hand(schema, finite) is best


def test_another_schema_is_tried_anew(finite: np.ndarray) -> None:
    schema, ways = small_model(), Ways(Known())
    other = schema.with_weights(schema.weights)
    before = ways.best(schema, finite)
    assert ways.at_hand(other, finite) is not before
    lasting(ways, other, finite)
    assert ways.at_hand(other, finite) is ways.best(other, finite)


def test_the_tried_way_is_at_least_as_good(finite: np.ndarray) -> None:
    schema, ways = small_model(), Ways(Known())
    rows = schema.layout.join(states(seed=3))[:200]
    quick, best = ways.at_hand(schema, finite), ways.best(schema, finite)
    errors = []
    for recipe in (quick, best):
        hidden = np.where(finite, rows, np.nan)
        hidden.setflags(write=False)
        estimates = np.array([fill(schema, row, recipe).value[ELEMENT] for row in hidden])
        errors.append(np.sqrt(np.mean((estimates - rows[:, ELEMENT]) ** 2)))
    assert errors[1] < 1.2 * errors[0]
