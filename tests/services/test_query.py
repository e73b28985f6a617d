import threading
import time
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import msgpack
import numpy as np
import pytest
import zenoh

from hal.errors import CommandRefused
from services.errors import RemoteError, ServiceUnavailable, TooSlow
from services.wire import keys, query
from services.wire.messages import MAX_BYTES, MessageError
from services.wire.session import close_session, open_session


class Pair:
    """A service's session and a client's."""

    def __init__(self, robot: str) -> None:
        self.robot = robot
        self.near = open_session(robot, "client")
        self.far = open_session(robot, "hal")

    def serve(self, name: str, handler: query.Handler) -> str:
        key = keys.verb(self.robot, "hal", name)
        query.serve_verb(self.far, key, handler)
        return key

    def ask(self, key: str, arguments: dict[str, Any] | None = None, timeout: float = 5.0) -> dict[str, Any]:
        return query.ask(self.near, key, arguments, timeout)


@pytest.fixture
def pair(robot: str) -> Iterator[Pair]:
    sessions = Pair(robot)
    yield sessions
    close_session(sessions.near)
    close_session(sessions.far)


def test_arguments_and_answer_arrive(pair: Pair) -> None:
    key = pair.serve("echo", lambda arguments: arguments | {"array": np.arange(2.0), "names": {"b", "a"}})
    assert pair.ask(key, {"x": np.array([1.5]), "n": np.int64(2)}) == {
        "x": [1.5], "n": 2, "array": [0.0, 1.0], "names": ["a", "b"],
    }  # fmt: skip


def test_an_answer_that_is_no_map_arrives_as_value(pair: Pair) -> None:
    assert pair.ask(pair.serve("word", lambda _: "yes")) == {"value": "yes"}
    assert pair.ask(pair.serve("nothing", lambda _: None)) == {}


def _raise(error: Exception) -> Any:
    raise error


def test_an_exception_comes_back_as_what_it_was(pair: Pair) -> None:
    key = pair.serve("refuse", lambda _: _raise(CommandRefused("The robot is off.")))
    with pytest.raises(CommandRefused, match=r"^The robot is off\.$"):
        pair.ask(key)


def test_an_exception_that_is_not_known_here_names_its_class(pair: Pair) -> None:
    key = pair.serve("broken", lambda _: _raise(ZeroDivisionError("by zero")))
    with pytest.raises(RemoteError, match=r"The verb failed: by zero \(ZeroDivisionError of hal\)"):
        pair.ask(key)


@pytest.mark.parametrize("payload", [b"\xc1", msgpack.packb([1]), b"\x00" * (MAX_BYTES + 1)])
def test_malformed_arguments_are_refused_and_the_verb_lives_on(pair: Pair, payload: bytes) -> None:
    calls: list[dict[str, Any]] = []
    key = pair.serve("do", calls.append)
    assert pair.ask(key) == {}
    replies = [reply.ok for reply in pair.near.get(key, payload=payload, timeout=5.0)]
    assert len(replies) == 1
    assert replies[0] is not None
    with pytest.raises(MessageError):
        query._result(key, replies[0])
    assert pair.ask(key) == {}
    assert calls == [{}, {}]


def test_nobody_there_says_what_to_start(pair: Pair) -> None:
    says = rf"No 'model' service of robot '{pair.robot}' answered within 0.2 s. Is `gemuco serve` running\?"
    with pytest.raises(ServiceUnavailable, match=says):
        pair.ask(keys.verb(pair.robot, "model", "engage"), timeout=0.2)


def test_a_verb_that_a_service_lacks_is_told(pair: Pair) -> None:
    token = pair.far.liveliness().declare_token(keys.alive(pair.robot, "hal"))
    pair.ask(pair.serve("known", lambda _: None))
    with pytest.raises(ServiceUnavailable, match="runs, but has no verb 'dance'"):
        pair.ask(keys.verb(pair.robot, "hal", "dance"), timeout=0.3)
    token.undeclare()


def test_a_verb_that_takes_too_long_is_told(pair: Pair) -> None:
    token = pair.far.liveliness().declare_token(keys.alive(pair.robot, "hal"))
    key = pair.serve("slow", lambda _: time.sleep(0.6))
    with pytest.raises(TooSlow, match=r"did not answer 'slow' within 0.2 s. Is it busy\?"):
        pair.ask(key, timeout=0.2)
    token.undeclare()


def test_a_query_whose_connection_is_lost_is_asked_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """The service took the query and was connected anew; a busy machine may need seconds for that."""
    monkeypatch.setattr(query, "APPEAR", 0.2)
    answer = SimpleNamespace(ok=SimpleNamespace(attachment=None, payload=zenoh.ZBytes(query._pack({"ok": {"n": 1}}))))
    replies = iter([[], [], [answer]])

    class Losing:
        def get(self, key: str, **_: object) -> list[Any]:
            if (reply := next(replies)) == [] and not asked:
                time.sleep(0.3)
            asked.append(key)
            return reply

    asked: list[str] = []
    assert query.ask(Losing(), keys.verb("arm", "model", "normal"), timeout=5.0) == {"n": 1}  # type: ignore[arg-type]
    assert len(asked) == 3


def test_a_service_that_is_not_there_is_not_called_busy(pair: Pair) -> None:
    """Zenoh waits also for a queryable whose program does not answer any more, which is no service then."""
    key = pair.serve("slow", lambda _: time.sleep(0.6))
    with pytest.raises(ServiceUnavailable, match=r"answered within 0.2 s. Is `gemuco hal` running\?"):
        pair.ask(key, timeout=0.2)


def test_asking_before_the_service_exists_is_answered_when_it_does(robot: str) -> None:
    near = open_session(robot, "client")
    far: list[zenoh.Session] = []

    def come_up() -> None:
        far.append(open_session(robot, "hal"))
        query.serve_verb(far[0], keys.verb(robot, "hal", "late"), lambda _: {"here": True})

    timer = threading.Timer(0.3, come_up)
    timer.start()
    assert query.ask(near, keys.verb(robot, "hal", "late"), timeout=10.0) == {"here": True}
    timer.join()
    close_session(near)
    close_session(far[0])
