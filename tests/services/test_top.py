import numpy as np
import pytest
from rich.console import Console

from services.verbs.top import _signals
from services.wire.messages import Sample


@pytest.fixture
def sample():
    return Sample(
        stamp_ns=0,
        cycle=1,
        source="can",
        complete=True,
        values={"joint_position": np.array([0.25, np.nan])},
        age={"joint_position": np.array([0.001, 0.5])},
        valid={"joint_position": np.array([True, False])},
    )


def test_without_a_model_what_is_measured_is_shown(sample):
    console = Console(width=120)
    with console.capture() as shown:
        console.print(_signals([sample], None))
    row = next(line for line in shown.get().splitlines() if "joint_position" in line)
    assert "1/2" in row
    assert "0.250 nan" in row
