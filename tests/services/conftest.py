"""Robot names of their own for tests, so that no two of them share a port, a lock or a key."""

import os
import re

import pytest


@pytest.fixture
def robot(request: pytest.FixtureRequest) -> str:
    name = re.sub(r"\W+", "_", request.node.name).lower()
    return f"{name}_{os.getpid()}"
