"""A service that ends answers what it was asked before."""

import threading
import time

from services.client import Client
from services.process.service import Service


def test_a_question_under_way_is_answered_before_the_session_closes(robot: str) -> None:
    ending = threading.Event()

    def last(_: dict[str, object]) -> dict[str, object]:
        ending.set()
        time.sleep(0.2)
        return {"here": True}

    with Client(robot) as client:
        service = Service(robot, "hal", (), dict)
        service.__enter__()
        service.verb("last", last)
        closing = threading.Thread(target=lambda: (ending.wait(10.0), service.__exit__(None, None, None)))
        closing.start()
        assert client.ask("hal", "last", timeout=5.0) == {"here": True}
        closing.join()
