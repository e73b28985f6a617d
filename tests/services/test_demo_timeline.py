"""What the demo's record says of values that were to be marked as estimated."""

from types import SimpleNamespace
from typing import Any

import numpy as np

from services.demo.timeline import Timeline


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
