"""The compiled loops of a muscle-driven body against numpy."""

from typing import Any

import numba
import numpy as np
import pytest

from simulators import muscle_kernels
from simulators.muscle_kernels import held, paths
from simulators.robots.musashi_arm.model import chain


def test_a_point_is_where_the_chain_has_it() -> None:
    random = np.random.default_rng(0)
    for position in random.uniform(chain().low, chain().high, (20, 5)):
        point, frame = random.uniform(-0.3, 0.3, 3), int(random.integers(1, 6))
        lengths, arms = np.zeros(1), np.zeros((1, 5))
        ends = np.array([[np.zeros(3), point, np.zeros(3)]])
        frames = np.array([[0, frame, 0]])
        paths(position, chain().axes, chain().offsets, np.array([0]), frames, ends, np.zeros(1), lengths, arms)
        pose = chain().pose(position)
        placed = pose.points(np.array([frame]), point[None])[0]
        assert lengths[0] == pytest.approx(np.linalg.norm(placed), abs=1e-12)
        way = placed / lengths[0]
        torque = chain().moves[frame] * (np.concatenate([way, np.cross(placed, way)]) @ pose.screws())
        assert arms[0] == pytest.approx(torque, abs=1e-12)


def test_what_holds_the_joints_is_a_weighted_square_of_the_arms() -> None:
    random = np.random.default_rng(1)
    arms, weight, diagonal = random.normal(size=(10, 5)), random.uniform(1, 9, 10), random.uniform(0, 1, 5)
    assert held(arms, weight, diagonal) == pytest.approx((arms.T * weight) @ arms + np.diag(diagonal))


def test_where_nothing_can_be_written_it_is_compiled_at_every_start(monkeypatch: pytest.MonkeyPatch) -> None:
    njit = numba.njit

    def without_a_folder(**options: Any) -> Any:
        if options.get("cache"):
            raise RuntimeError("cannot cache function: no locator available for file")
        return njit(**options)

    monkeypatch.setattr(numba, "njit", without_a_folder)
    assert muscle_kernels._compiled(lambda number: number + 1)(2) == 3
