"""The fixture of other authors' programs."""

import sys
from pathlib import Path

import pytest

sys.path += [str(Path(__file__).parent), str(Path(__file__).parents[1] / "services")]

from others import OTHERS, OtherHands


@pytest.fixture
def other_hands() -> OtherHands:
    if not (OTHERS / "bin" / "zenoh-ros2").exists():
        pytest.skip(f"no programs of other authors in {OTHERS}: `make test-ros2` installs them")
    return OtherHands()
