"""Two thousand bad messages on every key of a running robot; `make fuzz` sends a hundred thousand."""

import os
from pathlib import Path

import pytest
from fuzz_messages import Stage, campaign

COUNT = 2000
PACE = 0.0005


@pytest.mark.long
def test_bad_messages_end_nothing_move_nothing_and_are_counted(tmp_path: Path) -> None:
    with Stage(tmp_path, f"fuzz_{os.getpid()}") as stage:
        found = campaign(stage, COUNT, PACE)
    assert found["set_points_while_held"] > 0
    assert found["commands"]["malformed"] > 0
    assert found["model_rejected"] > 0
    assert found["top_rejected"] > 0
    assert found["readers_rejected"] > 0
