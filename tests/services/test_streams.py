import threading
import time

import numpy as np
import pytest
import zenoh

from hal.clock import ManualClock
from services.client import Client
from services.errors import AlreadyRunning, ServiceUnavailable
from services.process.lock import ServiceLock
from services.process.service import Service
from services.wire import keys, messages
from services.wire.messages import Status, Target, Update
from services.wire.session import close_session, open_session
from services.wire.streams import Publisher, Reader, Transit


def _update(version: int) -> Update:
    return Update(active=True, model_version=version, window=0, dropped=0, loss=0.0)


def _read(newest: Reader[Update], version: int) -> Update:
    deadline = time.monotonic() + 10.0
    while time.monotonic() < deadline:
        message = newest.get(float("inf"))
        if message is not None and message.model_version == version:
            return message
        time.sleep(0.002)
    raise AssertionError(f"update {version} did not arrive")


def test_newest_is_handed_out_only_while_it_is_fresh(robot: str) -> None:
    session, clock = open_session(robot, "client"), ManualClock()
    newest = Reader(session, keys.update(robot), Update, clock)
    publisher = Publisher(session, keys.update(robot), Update, boot=5)
    assert newest.get(1e9) is None
    assert newest.last() is None
    for version in range(3):
        publisher.put(_update(version))
    message = _read(newest, 2)
    assert (message.seq, message.boot) == (2, 5)
    clock.advance(0.2)
    assert newest.get(0.25) == message
    clock.advance(0.1)
    assert newest.get(0.25) is None
    last = newest.last()
    assert last is not None
    assert clock.monotonic() - last.received == pytest.approx(0.3)
    close_session(session)


def test_a_message_that_was_held_up_is_as_old_as_it_is() -> None:
    """The sender's clock is an hour ahead, and the way takes 1 ms, but once 0.4 s."""
    transit, ahead = Transit(), 3600.0

    def arrives(at: float, way: float) -> float:
        return transit.delay(round((at - way + ahead) * 1e9), at)

    assert [arrives(at, 0.001) for at in (1.0, 1.1, 1.2)] == pytest.approx([0.0] * 3, abs=1e-6)
    assert arrives(1.6, 0.401) == pytest.approx(0.4, abs=1e-3)
    assert arrives(1.7, 0.001) == pytest.approx(0.0, abs=1e-6)
    for tenth in range(20, 200):
        assert arrives(tenth / 10, 0.001) == pytest.approx(0.0, abs=1e-6)
    assert arrives(60.0, 30.0) == pytest.approx(30.0, abs=0.1), "held up in a silence of 40 s"


def test_a_link_that_becomes_slower_for_good_does_not_make_old_messages_fresh() -> None:
    transit = Transit()
    transit.delay(round(1e9), 1.001)
    delays = [transit.delay(round((at - 0.2) * 1e9), at) for at in np.arange(2.0, 60.0, 0.1)]
    assert min(delays) > 0.13
    assert transit.delay(round(60e9), 60.001) == 0.0, "fast again: believed at once"


def test_wall_clocks_that_drift_apart_make_nothing_late() -> None:
    transit = Transit()
    delays = [transit.delay(round(at * (1 - 5e-4) * 1e9), at) for at in np.arange(1.0, 600.0, 0.1)]
    assert max(delays) < 1e-6


@pytest.mark.parametrize("step", [-3600.0, -0.3, 0.3, 3600.0])
def test_a_wall_clock_that_is_set_is_believed_at_once(step: float) -> None:
    transit = Transit()
    delays = [
        transit.delay(round((5000.0 + at + (step if at > 20.0 else 0.0)) * 1e9), at) for at in np.arange(1.0, 40.0, 0.1)
    ]
    assert max(delays) < 1e-6


def test_a_message_without_a_stamp_counts_from_its_arrival() -> None:
    assert Transit().delay(0, 5.0) == 0.0


def test_what_cannot_be_read_is_counted_and_does_not_replace_the_good(robot: str) -> None:
    session = open_session(robot, "client")
    newest = Reader(session, keys.update(robot), Update)
    session.put(keys.update(robot), messages.encode(_update(1)))
    good = _read(newest, 1)
    session.put(keys.update(robot), b"\xc1")
    while not newest.rejected:
        time.sleep(0.002)
    assert newest.get(10.0) == good
    assert "not msgpack" in newest.rejected_text
    close_session(session)


def test_wait_returns_the_next_message_or_none(robot: str) -> None:
    session = open_session(robot, "client")
    newest = Reader(session, keys.update(robot), Update)
    assert newest.wait(0.05) is None
    timer = threading.Timer(0.05, lambda: session.put(keys.update(robot), messages.encode(_update(7))))
    timer.start()
    message = newest.wait(10.0)
    assert message is not None
    assert message.model_version == 7
    assert newest.wait(0.05) is None
    timer.join()
    close_session(session)


def test_reader_threads_end_with_the_session(robot: str) -> None:
    session = open_session(robot, "client")
    Reader(session, keys.update(robot), Update)
    close_session(session)
    deadline = time.monotonic() + 10.0
    while any(thread.name == f"newest {keys.update(robot)}" for thread in threading.enumerate()):
        assert time.monotonic() < deadline
        time.sleep(0.005)


def _status() -> Status:
    return Status(service="model", state="running", facts={"n": 1})


def test_client_reads_and_asks_a_service(robot: str) -> None:
    engaged: list[dict[str, object]] = []
    with Client(robot) as client, Service(robot, "model", describe=lambda: {"more": 1}) as service:
        assert client.status("model") is None
        service.verb("engage", lambda arguments: engaged.append(arguments))
        assert client.engage() == {}
        assert engaged == [{}]
        stop = threading.Event()
        thread = threading.Thread(target=service.run, args=(_status, stop))
        thread.start()
        status = client.status("model", timeout=10.0)
        assert status is not None
        assert status.boot == service.boot
        stop.set()
        thread.join()
        who = client.describe("model")
        assert (who["robot"], who["service"], who["boot"], who["more"]) == (robot, "model", service.boot, 1)
        assert client.alive() == {"model"}


def test_a_target_waits_for_the_one_who_takes_it(robot: str) -> None:
    with Client(robot) as client:
        with pytest.raises(ServiceUnavailable, match=r"takes targets\. Is `gemuco serve` running"):
            client.target("joint_position", [0.0], timeout=0.1)
        with Service(robot, "model") as service:
            targets = service.newest(keys.target(robot), Target)
            client.target("joint_position", [0.5, -0.5], timeout=10.0)
            deadline = time.monotonic() + 10.0
            while (last := targets.last()) is None:
                assert time.monotonic() < deadline
                time.sleep(0.005)
            assert last.message.values.tolist() == [0.5, -0.5]


def test_a_second_service_is_refused_with_the_holders_pid(robot: str) -> None:
    with Service(robot, "hal") as service:
        says = rf"Robot '{robot}' already has a 'hal' service: process {service.identity()['pid']} on this machine"
        with pytest.raises(AlreadyRunning, match=says):
            Service(robot, "hal").__enter__()
        Service(f"{robot}_other", "hal").__enter__().__exit__(None, None, None)
    Service(robot, "hal").__enter__().__exit__(None, None, None)


def test_a_service_elsewhere_on_the_network_is_seen(robot: str) -> None:
    """Another session stands for the other machine: it holds no lock here."""
    with Service(robot, "hal") as service:
        session: zenoh.Session = open_session(robot, "model")
        lock = ServiceLock(robot, "hal")
        deadline = time.monotonic() + 10.0
        while True:
            try:
                lock.check_network(session)
            except AlreadyRunning as error:
                assert f"process {service.identity()['pid']} on {service.identity()['host']}" in str(error)
                break
            assert time.monotonic() < deadline
        close_session(session)
