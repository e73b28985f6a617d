"""The rules between loops: learning gives way to those that keep time, and estimation keeps in step with the HAL."""

import pytest
from arm_model import arm, small_model

from services.model.gemuco_service import GemucoService
from services.process.service import Service


@pytest.mark.parametrize("slow", ["estimation", "control", "anomaly", "update", "verdict"])
def test_learning_waits_for_each_of_the_other_loops(robot: str, slow: str) -> None:
    with Service(robot, "model", (), dict) as service:
        made = GemucoService(arm().model_copy(update={"robot": robot}), small_model(), service)
        loops = {loop.name: loop for loop in made.loops}
        assert made.update._may_learn()
        loops[slow]._slow = "Keeps 3 of 50 Hz"
        assert made.update._may_learn() == (slow in ("update", "verdict"))
        loops[slow]._slow = ""
        assert made.update._may_learn()


@pytest.mark.parametrize(
    ("rate", "follows"), [(200.0, True), (400.0, True), (100.0, True), (500.0, False), (300.0, False)]
)
def test_estimation_keeps_in_step_only_with_samples_of_a_rate_that_divides(
    robot: str, rate: float, follows: bool
) -> None:
    body = arm()
    rates = body.rates.model_copy(update={"estimation": rate, "hal": 200.0})
    with Service(robot, "model", (), dict) as service:
        made = GemucoService(body.model_copy(update={"robot": robot, "rates": rates}), small_model(), service)
        assert (made.loops[0]._waited is not None) == follows
