"""Many robots on one network: kept apart, all seen, and two of one name noticed."""

import json
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from rich.console import Console

from services.errors import AlreadyRunning
from services.process.router import run_router
from services.process.service import Service
from services.runtime import services_here
from services.verbs import fleet_top
from services.verbs.fleet_watch import FleetWatch, Glance, Level, RobotNews, Voice
from services.wire import keys
from services.wire.messages import Status
from services.wire.session import CLIENT, close_session, open_session


def eventually(happened: Callable[[], bool], within: float = 20.0) -> None:
    deadline = time.monotonic() + within
    while not happened():
        assert time.monotonic() < deadline, "it did not happen"
        time.sleep(0.02)


def status(service: str, state: str = "running", boot: int = 1, **facts: object) -> Status:
    return Status(service=service, state=state, boot=boot, facts=facts, loops={service: {"late_max": 0.004}})


def robot_with(now: float, **voices: Voice) -> RobotNews:
    news = RobotNews("arm", now)
    news.voices.update(voices)
    return news


def voice(of: Status, heard: float, is_alive: bool = True) -> Voice:
    found = Voice(is_alive=is_alive)
    found.hear(of, heard)
    return found


GOOD = {"signals": {"measured": 3, "estimated": 0, "none": 0}, "anomaly": {"verdict": "normal", "is_anomaly": False}}
SICK = {"anomaly": {"verdict": "anomaly", "is_anomaly": True, "blamed": "load.elbow"}}


@pytest.mark.parametrize(
    ("hal", "model", "level", "says"),
    [
        (voice(status("hal", mode="off"), 9.5), voice(status("model", **GOOD), 9.5), Level.GOOD, ""),
        (voice(status("hal"), 9.5), voice(status("model", "degraded"), 9.5), Level.DEGRADED, "model: degraded"),
        (voice(status("hal"), 9.5), voice(status("model", **SICK), 9.5), Level.ANOMALY, "anomaly in load.elbow"),
        (voice(status("hal", "fault"), 9.5), voice(status("model"), 9.5), Level.TROUBLE, "hal: fault"),
        (voice(status("hal"), 5.0), voice(status("model"), 9.5), Level.TROUBLE, "'hal' is alive and says nothing"),
        (voice(status("hal"), 9.5, False), voice(status("model"), 9.5), Level.TROUBLE, "'hal' is gone"),
    ],
)
def test_what_is_worst_is_told(hal: Voice, model: Voice, level: Level, says: str) -> None:
    found = robot_with(9.5, hal=hal, model=model).glance(10.0)
    assert found.level == level
    assert says in found.text


def test_a_robot_that_has_gone_and_one_that_was_told_to_end() -> None:
    gone = robot_with(1.0, hal=voice(status("hal"), 1.0, False)).glance(10.0)
    ended = robot_with(1.0, hal=voice(status("hal", "stopping"), 1.0, False)).glance(10.0)
    assert (gone.level, ended.level) == (Level.GONE, Level.GONE)
    assert "Nothing is heard" in gone.text
    assert "told to end" in ended.text
    assert gone.age == 9.0


def test_a_glance_tells_motors_signals_anomaly_and_lateness() -> None:
    hal, model = voice(status("hal", mode="follow"), 9.0), voice(status("model", **GOOD), 9.9)
    found = robot_with(9.9, hal=hal, model=model).glance(10.0)
    assert (found.motors, found.measured, found.anomaly) == ("follow", (3, 0, 0), "normal")
    assert found.late == (0.004, "model")


@pytest.mark.parametrize("facts", [{"mode": ["x"]}, {"signals": 3}, {"signals": {"measured": "x"}}, {"anomaly": [1]}])
def test_facts_may_hold_anything(facts: dict[str, object]) -> None:
    one = voice(status("hal", **facts), 9.5), voice(status("model", **facts), 9.5)
    fleet_top.table([robot_with(9.5, hal=one[0], model=one[1]).glance(10.0)])


def test_a_restart_is_no_twin_and_two_in_turns_are() -> None:
    found = Voice()
    for number, boot in enumerate((1, 1, 2, 2)):
        found.hear(status("hal", boot=boot), float(number))
    assert found.twin_until < 4.0
    found.hear(status("hal", boot=1), 4.0)
    assert found.twin_until > 4.0
    found.is_alive = True
    text = robot_with(4.0, hal=found).glance(4.5)
    assert text.level == Level.TROUBLE
    assert "Two 'hal' services" in text.text


def test_trouble_is_on_top_and_nothing_that_came_steers_the_terminal() -> None:
    glances = [
        Glance("b_arm", Level.TROUBLE, "\x1b[2J[red]oh[/]", ("hal",), "off", "[bold]anna", None, "", None, 0.1),
        Glance("a_arm", Level.GOOD, "", ("hal",), "off", "", (1, 0, 0), "normal", (0.001, "hal"), 0.1),
    ]
    console = Console(width=160)
    with console.capture() as shown:
        console.print(fleet_top.table(glances))
    text = shown.get()
    assert text.index("b_arm") < text.index("a_arm")
    assert "[bold]anna" in text
    assert "\x1b" not in text
    assert "1 trouble, 1 good" in text


@pytest.fixture
def router() -> Iterator[str]:
    """A router's endpoint."""
    import socket

    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        where = f"tcp/127.0.0.1:{one.getsockname()[1]}"
    stop = threading.Event()
    thread = threading.Thread(target=run_router, args=((where,), (), stop))
    thread.start()

    def is_there() -> bool:
        with socket.socket() as probe:
            return probe.connect_ex(("127.0.0.1", int(where.rpartition(":")[2]))) == 0

    eventually(is_there)
    yield where
    stop.set()
    thread.join()


def run(service: Service, told: threading.Event) -> threading.Thread:
    thread = threading.Thread(target=service.run, args=(lambda: status(service.name, boot=service.boot), told))
    thread.start()
    return thread


@pytest.mark.long
def test_all_robots_of_a_router_are_seen_and_one_that_vanishes_stays_listed(robot: str, router: str) -> None:
    names = [f"{robot}_a", f"{robot}_b"]
    with (
        FleetWatch([router]) as fleet,
        Service(names[0], "hal", [router]) as one,
        Service(names[1], "hal", [router]) as two,
    ):

        def levels(*speaking: Service) -> dict[str, Level]:
            for service in speaking:
                service.publish_status(lambda: status("hal"))
            return {glance.robot: glance.level for glance in fleet.glances()}

        eventually(lambda: levels(one, two) == dict.fromkeys(names, Level.GOOD))
        eventually(fleet.is_told)
        close_session(one.session)  # as a crash would: no last word
        eventually(lambda: levels(two) == {names[0]: Level.GONE, names[1]: Level.GOOD})
        assert fleet.glances()[0].robot == names[0]
        assert fleet.has_router


def test_without_a_router_the_robots_of_this_machine_are_found(robot: str) -> None:
    told = threading.Event()
    with Service(robot, "hal") as service:
        assert (robot, "hal") in services_here()
        thread = run(service, told)
        with FleetWatch() as fleet:
            eventually(lambda: any(one.robot == robot and one.services == ("hal",) for one in fleet.glances()))
        told.set()
        thread.join()


@pytest.mark.long
def test_printed_once_the_exit_code_tells(robot: str, router: str) -> None:
    told = threading.Event()
    console = Console(width=160)
    with console.capture() as shown:
        assert fleet_top.watch_fleet(True, [router], console) == 1
    assert "No robot is seen" in shown.get()
    with Service(robot, "hal", [router]) as service:
        thread = run(service, told)
        with console.capture() as shown:
            assert fleet_top.watch_fleet(True, [router], console) == 0
        assert robot in shown.get()
        told.set()
        thread.join()


def test_the_same_robot_on_two_computers_of_one_router_is_refused(
    robot: str, router: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    elsewhere = tmp_path / "elsewhere.json"
    elsewhere.write_text(json.dumps({"listen": {"endpoints": ["tcp/127.0.0.1:0"]}, "connect": {"endpoints": [router]}}))
    with Service(robot, "hal", [router]):
        eyes = open_session(robot, CLIENT, [router])
        eventually(lambda: bool(list(eyes.liveliness().get(keys.alive(robot, "hal")))))
        close_session(eyes)
        monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))  # as on another machine
        with pytest.raises(AlreadyRunning, match=f"Robot '{robot}' already has a 'hal' service: process "):
            Service(robot, "hal", [str(elsewhere)]).__enter__()


def test_a_router_that_is_not_there_does_not_keep_a_service_from_starting(robot: str) -> None:
    begun = time.monotonic()
    with Service(robot, "hal", ["tcp/127.0.0.1:1"]):
        assert time.monotonic() - begun < 10.0
