import numpy as np
import pytest
from small_hand import TOOLS, config, gravity_of, tip_of

from hal.errors import ConfigError
from services.demo.stories import tool_targets
from services.demo.stories.tool_targets import APART, CLOSE, common_targets
from services.learning.motion import NowhereToGo

BOTH = ("short", "long")
LIMITS = {"joint_position": {"low": [-1.0, -2.2], "high": [1.0, 2.2]}}
"""So far an elbow must bend that the long tool comes to where the short one is."""


def test_targets_are_reached_with_either_tool() -> None:
    targets, postures = common_targets(config(limits=LIMITS), "tool_tip_position", BOTH, 5, seed=3)
    np.testing.assert_allclose(tip_of(postures, TOOLS["short"]), targets)
    assert (np.abs(gravity_of(postures, TOOLS["short"])) <= [0.05, 0.03]).all()
    others = np.random.default_rng(0).uniform([-1.0, -2.2], [1.0, 2.2], (50_000, 2))
    for target in targets:
        assert np.linalg.norm(tip_of(others, TOOLS["long"]) - target, axis=1).min() < CLOSE
    steps = np.linalg.norm(np.diff(targets, axis=0), axis=1)
    assert (steps >= APART[0]).all()
    assert (steps <= APART[1]).all()


def test_a_seed_chooses_the_targets() -> None:
    one, again, other = (
        common_targets(config(limits=LIMITS), "tool_tip_position", BOTH, 3, seed)[0] for seed in (1, 1, 2)
    )
    np.testing.assert_array_equal(one, again)
    assert not np.array_equal(one, other)


def test_what_cannot_be_reached_or_is_not_known_is_said() -> None:
    with pytest.raises(NowhereToGo, match="Only 1 of 2 targets near one another are reached with both tools"):
        collect = {"forecast": "small_hand:forecast"}
        limits = {"joint_position": {"low": [0.0, 0.0], "high": [0.01, 0.01]}}
        common_targets(config(collect=collect, limits=limits), "tool_tip_position", ("short", "short"), 2, 0)
    with pytest.raises(ConfigError, match=r"has no collect\.forecast"):
        common_targets(config(collect={"samples": 5}), "tool_tip_position", BOTH, 2, 0)
    with pytest.raises(ConfigError, match="the targets are of foot_force"):
        common_targets(config(), "foot_force", BOTH, 2, 0)


def test_targets_are_drawn_again_if_too_few_are_near_the_first_one(monkeypatch: pytest.MonkeyPatch) -> None:
    whole, tries = tool_targets._next, []

    def next_target(order: np.ndarray, first: np.ndarray, second: np.ndarray, chosen: list[int]) -> int | None:
        tries.append(len(chosen))
        return None if tries.count(0) == 1 and len(chosen) == 2 else whole(order, first, second, chosen)

    monkeypatch.setattr(tool_targets, "_next", next_target)
    targets, _ = common_targets(config(limits=LIMITS), "tool_tip_position", BOTH, 4, seed=3)
    assert len(targets) == 4
    assert tries == [0, 1, 2, 0, 1, 2, 3]
