"""Robot names of their own for tests, so that no two of them share a port, a lock or a key."""

import os
import re
from collections.abc import Iterator

import pytest
import zenoh

from services.wire.session import close_session, open_session


@pytest.fixture
def robot(request: pytest.FixtureRequest) -> str:
    name = re.sub(r"\W+", "_", request.node.name).lower()
    return f"{name}_{os.getpid()}"


@pytest.fixture
def session(robot: str) -> Iterator[zenoh.Session]:
    opened = open_session(robot, "hal")
    yield opened
    close_session(opened)
