"""What a client hears: the newest and never a backlog, and an error that says which of all things is wrong."""

import itertools
import json
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import msgpack
import pytest
import zenoh

from services.client import Client
from services.client.live import Live
from services.errors import NotAllowed, ServiceError, ServiceUnavailable, TooSlow, WrongVersion
from services.process.service import Service
from services.wire import keys, messages
from services.wire.messages import Anomaly, Status
from services.wire.session import close_session, open_session


def eventually(happened: Callable[[], bool], within: float = 20.0) -> None:
    deadline = time.monotonic() + within
    while not happened():
        assert time.monotonic() < deadline, "it did not happen"
        time.sleep(0.002)


def anomaly(number: int) -> Anomaly:
    """A message that can be told from others by its cycle."""
    return Anomaly(
        stamp_ns=time.time_ns(), cycle=number, score=0.0, threshold=1.0, is_anomaly=False, blamed="", contribution={}
    )


class Model:
    """The model service of a robot: alive, and publishing numbered anomalies as fast as it is told."""

    def __init__(self, robot: str, pause: float = 0.002) -> None:
        self.last = -1
        self.service = Service(robot, "model")
        self._robot, self._pause = robot, pause
        self._done = threading.Event()
        self._thread = threading.Thread(target=self._publish)

    def __enter__(self) -> "Model":
        self.service.__enter__()
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.silence()
        self.service.__exit__(None, None, None)

    def silence(self) -> None:
        """Publish no more, and stay alive."""
        self._done.set()
        self._thread.join()

    def _publish(self) -> None:
        publisher = self.service.publisher(keys.anomaly(self._robot), Anomaly)
        for number in itertools.count():
            if self._done.wait(self._pause):
                return
            publisher.put(anomaly(number))
            self.last = number


@pytest.fixture
def client(robot: str) -> Iterator[Client]:
    with Client(robot) as far:
        yield far


def test_a_slow_consumer_skips_to_the_newest(client: Client, robot: str) -> None:
    with Model(robot) as model:
        seen = []
        for message in client.anomalies(deadline=20.0):
            seen.append(message.cycle)
            if len(seen) == 5:
                break
            asked = model.last
            eventually(lambda asked=asked: model.last >= asked + 30)  # work that takes 30 messages
        assert (min(after - before for before, after in itertools.pairwise(seen))) >= 25


@pytest.mark.long
def test_a_fast_consumer_gets_each_message_once(client: Client, robot: str) -> None:
    with Model(robot, 0.02) as model:
        live = client.anomalies(deadline=20.0)
        seen = [next(live).cycle for _ in range(20)]
        model.silence()
        assert seen == sorted(set(seen))
        with pytest.raises(TooSlow, match=rf"'model' service of robot '{robot}' is alive, but no 'anomaly' came"):
            list(client.anomalies(deadline=0.5))


def test_what_is_old_is_not_given(client: Client, robot: str) -> None:
    with Model(robot):
        assert next(iter(client.anomalies(deadline=20.0)))
        reader = client.reader(keys.anomaly(robot), Anomaly)
        with pytest.raises(LookupError, match="nothing for"):
            next(Live(reader, 0.1, -1.0, lambda waited: LookupError(f"nothing for {waited:.1f} s")))


def test_nobody_there_is_told_and_the_same_iterator_goes_on(client: Client, robot: str) -> None:
    live = client.anomalies(deadline=0.2)
    says = rf"No 'anomaly' of the 'model' service of robot '{robot}' came within 0\.2 s\. Is `gemuco serve` running\?"
    with pytest.raises(ServiceUnavailable, match=says):
        next(live)
    live = client.anomalies(deadline=20.0)
    boots = set()
    for _ in range(2):  # gone, and back with another boot
        with Model(robot) as model:
            eventually(lambda model=model: next(live).boot == model.service.boot)
            boots.add(model.service.boot)
    assert len(boots) == 2


@pytest.mark.long
def test_messages_of_another_version_are_an_error_and_not_silence(client: Client, robot: str) -> None:
    body = {**msgpack.unpackb(messages.encode(anomaly(1))), "v": 3}
    with Service(robot, "model") as service:
        reader = client.reader(keys.anomaly(robot), Anomaly)

        def came() -> bool:
            service.session.put(keys.anomaly(robot), msgpack.packb(body))
            return reader.rejected > 0

        eventually(came)
        with pytest.raises(WrongVersion, match=r"has version 3; this program reads 2\. Update the older"):
            client.anomaly()
        live = client.anomalies(deadline=1.0)
        service.session.put(keys.anomaly(robot), msgpack.packb(body))
        with pytest.raises(WrongVersion, match="has version 3"):
            next(live)
        service.session.put(keys.anomaly(robot), messages.encode(anomaly(7)))
        assert next(client.anomalies(deadline=20.0)).cycle == 7


def test_an_iterator_without_a_deadline_ends_when_the_client_is_closed(robot: str) -> None:
    report: list[str] = []

    def listen(client: Client) -> None:
        try:
            next(client.anomalies(deadline=None))
        except ServiceUnavailable as error:
            report.append(str(error))

    with Client(robot) as client:
        thread = threading.Thread(target=listen, args=(client,))
        thread.start()
        eventually(lambda: any(one.name == f"newest {keys.anomaly(robot)}" for one in threading.enumerate()))
    thread.join(20.0)
    assert report == [f"The client of robot '{robot}' was closed."]


def _status(text: str) -> Status:
    return Status(service="model", state="running", text=text)


def test_health_tells_who_comes_and_goes_and_what_each_says(client: Client, robot: str) -> None:
    live = client.health(deadline=20.0)
    with Service(robot, "model") as service:
        assert next(live).alive == {"model"}
        service.publish_status(lambda: _status("one"))
        assert next(live).statuses["model"].text == "one"
        service.publish_status(lambda: _status("two"))
        assert next(live).statuses["model"].text == "two"
        with Service(robot, "hal"):
            assert next(live).alive == {"hal", "model"}
        assert next(live).alive == {"model"}
    assert next(live).alive == frozenset()
    with pytest.raises(ServiceUnavailable, match=rf"No message of robot '{robot}' arrived for 0\.2 s"):
        list(client.health(deadline=0.2))


def test_no_thread_is_left_after_close(robot: str) -> None:
    before = {thread.ident for thread in threading.enumerate()}
    client = Client(robot)
    with client:
        client.sensors(), client.estimates(), client.anomalies(), client.health(), client.sample(), client.holder
    left = [one for one in threading.enumerate() if one.ident not in before]
    for thread in left:  # zenoh's own thread of a callback ends a moment after its session
        thread.join(2.0)
    assert [one.name for one in left if one.is_alive()] == []
    client.close()
    with pytest.raises(ServiceError, match=r"is not open: use it in `with Client"):
        client.sample()


class Router:
    """A router of its own, that can be taken away and put back."""

    def __init__(self, endpoint: str) -> None:
        self.endpoint = endpoint
        self.open()

    def open(self) -> None:
        settings = {
            "mode": "router",
            "listen": {"endpoints": [self.endpoint]},
            "scouting": {"delay": 0, "multicast": {"enabled": False}, "gossip": {"enabled": False}},
        }
        self._session = zenoh.open(zenoh.Config.from_json5(json.dumps(settings)))

    def close(self) -> None:
        close_session(self._session)


@pytest.fixture
def router(tmp_path: Path) -> Iterator[Router]:
    found = Router(f"unixsock-stream/{tmp_path}/router")
    yield found
    found.close()


@pytest.mark.long
def test_iterators_go_on_when_the_router_was_away(robot: str, router: Router) -> None:
    with Service(robot, "model", [router.endpoint]) as service, Client(robot, router.endpoint) as far:
        publisher = service.publisher(keys.anomaly(robot), Anomaly)
        numbers, done = itertools.count(), threading.Event()

        def publish() -> None:
            while not done.wait(0.005):
                publisher.put(anomaly(next(numbers)))

        thread = threading.Thread(target=publish)
        thread.start()
        live, health = far.anomalies(deadline=20.0), far.health(deadline=20.0)
        assert next(live)
        eventually(lambda: next(health).alive == {"model"})
        router.close()
        eventually(lambda: next(health).alive == frozenset())
        with pytest.raises(ServiceUnavailable, match="has no connection"):
            list(far.anomalies(deadline=0.5))
        with pytest.raises(ServiceUnavailable, match="has no connection"):
            far.ask("model", "describe", timeout=0.3)
        router.open()
        before = next(numbers)
        assert next(live).cycle >= before
        eventually(lambda: next(health).alive == {"model"})
        done.set()
        thread.join()


@pytest.mark.long
def test_a_robot_that_is_not_there_is_told_with_those_that_are(robot: str, router: Router) -> None:
    with Client(f"{robot}_x", router.endpoint) as far:
        with pytest.raises(ServiceUnavailable, match="The router runs, but no robot is visible"):
            far.ask("hal", "describe", timeout=0.2)
        with Service(robot, "hal", [router.endpoint]), Client(robot, router.endpoint) as near:
            assert near.describe("hal")
            says = rf"There is no robot '{robot}_x'\. Visible robots: {robot}\."
            with pytest.raises(ServiceUnavailable, match=says):
                far.ask("hal", "describe", timeout=0.2)
            with pytest.raises(ServiceUnavailable, match=says):
                next(far.sensors(deadline=0.2))
            with pytest.raises(ServiceUnavailable, match="Running services of this robot: hal"):
                near.ask("model", "engage", timeout=0.2)


def test_a_wrong_name_without_a_router_is_answered_with_the_robots_of_this_machine(robot: str) -> None:
    says = rf"has no connection.* Robots on this machine: (.*, )?{robot}[,.]"
    with Service(robot, "hal"), Client(f"{robot}_x") as near, pytest.raises(ServiceUnavailable, match=says):
        near.ask("hal", "describe", timeout=0.2)


@pytest.mark.slow
def test_no_router_is_told_at_once(robot: str, tmp_path: Path) -> None:
    with pytest.raises(ServiceUnavailable, match="gemuco router"):
        Client(robot, f"unixsock-stream/{tmp_path}/nobody").__enter__()


def role_file(folder: Path, endpoint: str, role: str, robots: list[str]) -> str:
    path = folder / f"{role}.json"
    path.write_text(
        json.dumps({"metadata": {"gemuco": {"role": role, "robots": robots}}, "connect": {"endpoints": [endpoint]}})
    )
    path.chmod(0o600)
    return str(path)


def test_a_role_that_may_not_is_told_before_anybody_is_asked(robot: str, router: Router, tmp_path: Path) -> None:
    viewer = role_file(tmp_path, router.endpoint, "viewer", [robot])
    with Client(robot, viewer) as far:
        for refused in (
            far.enable,
            far.stop,
            lambda: far.adapt(True),
            lambda: far.control({"joint_position": [0.0]}),
            lambda: far.target("joint_position", [0.0]),
            lambda: far.reader(keys.command(robot), messages.Command),
        ):
            with pytest.raises(NotAllowed, match="The role 'viewer' may not"):
                refused()
        with Service(robot, "model", [router.endpoint]):
            assert far.describe("model")["service"] == "model"
    with pytest.raises(NotAllowed, match=f"for robot {robot}, not for 'another'"):
        Client("another", viewer).__enter__()


def test_a_service_that_speaks_another_version_says_so(client: Client, robot: str) -> None:
    session = open_session(robot, "hal")
    answer = msgpack.packb({"ok": {}})

    def speak(query: zenoh.Query) -> None:
        with query:
            query.reply(query.key_expr, answer, attachment=msgpack.packb({"v": 3}))

    session.declare_queryable(keys.verb(robot, "hal", "describe"), speak)
    with pytest.raises(WrongVersion, match="version 3 of the wire format; this program speaks 2"):
        client.ask("hal", "describe", timeout=10.0)
    close_session(session)
