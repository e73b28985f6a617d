"""What the demo's record says of values that were to be marked as estimated."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from services.demo.timeline import Timeline, hidden_error


class Arm:
    """Client whose camera is measured or estimated, and whose newest estimate may be old."""

    def __init__(self) -> None:
        self.newest: SimpleNamespace | None = None

    def publish(self, stamp: float, value: float, is_estimated: bool) -> None:
        self.newest = SimpleNamespace(
            values={"tip": np.array([value, value])},
            estimated={"tip": np.array([is_estimated, is_estimated])},
            stamp_ns=round(1e9 * stamp),
            method={"tip": "encoder"},
            mask={"tip": "joint_position"},
        )

    def estimate(self) -> Any:
        return self.newest

    def nothing(self) -> None:
        return None

    truth = anomaly = applied = update = nothing


def recorded(*estimates: tuple[float, float, bool]) -> Timeline:
    """Sample a row after each estimate: stamp [s], value, whether it is marked."""
    arm = Arm()
    timeline = Timeline(arm, "tip", 2, 0, ())  # type: ignore[arg-type]
    timeline._sample()  # nothing has come yet
    for estimate in estimates:
        arm.publish(*estimate)
        timeline._sample()
    return timeline


def test_a_late_row_counts_by_the_stamp_of_its_estimate() -> None:
    timeline = recorded((9.9, 1.0, False), (10.0, 1.0, True), (10.5, 1.0, True), (11.0, 1.0, False))
    assert timeline.marked(10.0, 11.0) == 1.0


def test_one_value_without_a_mark_is_seen() -> None:
    timeline = recorded((10.0, 1.0, True), (10.5, 1.0, False), (10.6, 1.0, True), (10.7, 1.0, True))
    assert timeline.marked(10.0, 11.0) == 0.75


def test_nothing_is_marked_where_no_value_was_made() -> None:
    timeline = recorded((9.0, 1.0, True), (10.5, float("nan"), True), (12.0, 1.0, True))
    assert timeline.marked(10.0, 11.0) == 0.0


class LateArm:
    """Client of an arm at rest whose model is far off, and promises little error, while an encoder is late."""

    def __init__(self, late: int) -> None:
        self.late = late

    def estimate(self, hide: Any) -> Any:
        assert hide == ["tip"]
        self.late -= 1
        is_late = self.late >= 0
        return SimpleNamespace(
            values={"tip": np.array([2.0, 0.5] if is_late else [1.1, 0.5]), "joints": np.array([0.0, 1.0])},
            estimated={"tip": np.array([True, True]), "joints": np.array([False, is_late])},
        )

    def truth(self) -> Any:
        return SimpleNamespace(values={"tip": np.array([1.0, 0.5])})


def test_an_estimate_from_what_is_left_of_late_sensors_does_not_judge_the_model() -> None:
    arm: Any = LateArm(late=1)
    assert np.isnan(hidden_error(arm, "tip", ["tip"])).all()
    assert hidden_error(arm, "tip", ["tip"]) == pytest.approx([0.1, 0.0])
