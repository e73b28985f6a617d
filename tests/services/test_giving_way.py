"""The rule by which the model service degrades: learning gives way to every loop that keeps time, and only to them."""

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
