"""Many robots on one network: kept apart, all seen, and two of one name noticed."""

import json
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from rich.console import Console

from services.errors import AlreadyRunning
from services.process.router import run_router
from services.process.service import Service
from services.runtime import own_line, runtime_folder, services_here
from services.verbs import fleet_top
from services.watch.fleet_watch import FleetWatch, RobotRecord, ServiceRecord
from services.watch.service_rows import Level
from services.watch.snapshot import Newest, RobotSnapshot
from services.wire import keys
from services.wire.messages import Holder, Status
from services.wire.session import CLIENT, close_session, open_session


def eventually(happened: Callable[[], bool], within: float = 20.0) -> None:
    deadline = time.monotonic() + within
    while not happened():
        assert time.monotonic() < deadline, "it did not happen"
        time.sleep(0.02)


def status(service: str, state: str = "running", boot: int = 1, **facts: object) -> Status:
    return Status(service=service, state=state, boot=boot, facts=facts, loops={service: {"late_max": 0.004}})


def robot_with(now: float, **services: ServiceRecord) -> RobotRecord:
    robot = RobotRecord("arm", now)
    robot.services.update(services)
    return robot


def record(newest: Status, now: float) -> ServiceRecord:
    service = ServiceRecord(is_alive=True)
    service.add(newest, now)
    return service


def printed(snapshots: list[RobotSnapshot]) -> str:
    console = Console(width=200)
    with console.capture() as shown:
        console.print(fleet_top.table(fleet_top.ranked(snapshots)))
    return shown.get()


def test_a_row_of_the_table_has_motors_signals_anomaly_and_lateness() -> None:
    good = {"signals": {"measured": 3, "estimated": 1, "none": 0}, "anomaly": {"verdict": "normal"}}
    hal, model = record(status("hal", mode="follow"), 9.0), record(status("model", **good), 9.9)
    text = printed([robot_with(9.9, hal=hal, model=model).snapshot(10.0)])
    for part in ("follow", "3/1/0", "normal", "4.0 hal", "good"):
        assert part in text


@pytest.mark.parametrize("facts", [{"mode": ["x"]}, {"signals": 3}, {"signals": {"measured": "x"}}, {"anomaly": [1]}])
def test_facts_may_hold_anything(facts: dict[str, object]) -> None:
    both = {name: record(status(name, **facts), 9.5) for name in ("hal", "model")}
    assert "arm" in printed([robot_with(9.5, **both).snapshot(10.0)])


def test_a_restart_is_no_twin_and_two_in_turns_are() -> None:
    found = ServiceRecord()
    for number, boot in enumerate((1, 1, 2, 2)):
        found.add(status("hal", boot=boot), float(number))
    assert found.twin_until < 4.0
    found.add(status("hal", boot=1), 4.0)
    assert found.twin_until > 4.0
    found.is_alive = True
    assert robot_with(4.0, hal=found).snapshot(4.5).twins == ("hal",)


@pytest.mark.parametrize("width", [80, 120])
def test_a_narrow_terminal_has_room_for_what_is_wrong(width: int) -> None:
    good = {"signals": {"measured": 3, "estimated": 1, "none": 0}, "anomaly": {"verdict": "normal"}}
    text = "Drive 'elbow_drive' (node 5 on can0) is in its state 'fault'."
    hal, model = record(status("hal", mode="follow"), 9.9), record(status("model", **good), 9.9)
    bad = record(Status(service="hal", state="fault", boot=1, text=text), 9.9)
    snapshots = [
        robot_with(9.9, hal=hal, model=model).snapshot(10.0),
        replace(robot_with(9.9, hal=bad, model=model).snapshot(10.0), robot="a_robot_with_a_long_name"),
    ]
    console = Console(width=width)
    with console.capture() as shown:
        console.print(fleet_top.table(fleet_top.ranked(snapshots), width))
    lines = shown.get().splitlines()
    assert max(len(line.rstrip()) for line in lines) <= width
    assert len(lines) < 14
    words = " ".join(" ".join(lines).split())
    for part in ("HAL fault", "elbow_drive", "3 measured, 1 estimated", "late 4.0 ms hal", "heard 0.1 s ago", "follow"):
        assert part in words


def test_trouble_is_on_top_and_no_text_steers_the_terminal() -> None:
    bad = Status(service="hal", state="fault", text="\x1b[2J[red]oh[/]")
    holder = Newest(Holder(name="[bold]anna", holder=1), 0.1)
    running = {name: Newest(status(name), 0.1) for name in ("hal", "model")}
    both = frozenset({"hal", "model"})
    text = printed([
        RobotSnapshot(robot="a_arm", has_streams=False, alive=both, statuses=running),
        RobotSnapshot(robot="b_arm", has_streams=False, alive=both, statuses=running | {"hal": Newest(bad, 0.1)},
                 holder=holder),
    ])  # fmt: skip
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


def run(service: Service, report: threading.Event) -> threading.Thread:
    thread = threading.Thread(target=service.run, args=(lambda: status(service.name, boot=service.boot), report))
    thread.start()
    return thread


@pytest.mark.slow
def test_all_robots_of_a_router_are_seen_and_one_that_vanishes_stays_listed(robot: str, router: str) -> None:
    names = [f"{robot}_a", f"{robot}_b"]
    with (
        FleetWatch([router]) as fleet,
        Service(names[0], "hal", [router]) as one,
        Service(names[0], "model", [router]) as its_model,
        Service(names[1], "hal", [router]) as two,
        Service(names[1], "model", [router]) as other_model,
    ):

        def levels(*speaking: Service) -> dict[str, Level]:
            for service in speaking:
                service.publish_status(lambda name=service.name: status(name))
            return {snapshot.robot: worst.level for snapshot, worst in fleet_top.ranked(fleet.snapshots())}

        eventually(lambda: levels(one, its_model, two, other_model) == dict.fromkeys(names, Level.GOOD))
        eventually(fleet.is_complete)
        for service in (one, its_model):
            close_session(service.session)  # as after a crash: without a last status
        eventually(lambda: levels(two, other_model) == {names[0]: Level.GONE, names[1]: Level.GOOD})
        assert fleet_top.ranked(fleet.snapshots())[0][0].robot == names[0]
        assert fleet.has_router


def test_without_a_router_the_robots_of_this_machine_are_found(robot: str) -> None:
    report = threading.Event()
    with Service(robot, "hal") as service:
        assert (robot, "hal") in services_here()
        thread = run(service, report)
        with FleetWatch() as fleet:
            eventually(lambda: any(one.robot == robot and one.alive == {"hal"} for one in fleet.snapshots()))
        report.set()
        thread.join()


def test_a_process_that_got_the_pid_of_a_service_that_ended_is_not_that_service(robot: str) -> None:
    lock = runtime_folder() / f"{robot}.hal.lock"
    lock.write_text(own_line())
    assert (robot, "hal") in services_here()
    pid, started = own_line().split()
    for line in (f"{pid} {int(started) - 1}", pid, ""):
        lock.write_text(line)
        assert (robot, "hal") not in services_here()
    lock.unlink()


@pytest.mark.slow
def test_printed_once_the_exit_code_tells(robot: str, router: str) -> None:
    report = threading.Event()
    console = Console(width=160)
    with console.capture() as shown:
        assert fleet_top.watch_fleet(True, [router], console) == 1
    assert "No robot is seen" in shown.get()
    with Service(robot, "hal", [router]) as hal, Service(robot, "model", [router]) as model:
        threads = [run(service, report) for service in (hal, model)]
        try:
            with console.capture() as shown:
                assert fleet_top.watch_fleet(True, [router], console) == 0
            assert robot in shown.get()
        finally:
            report.set()
            for thread in threads:
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
