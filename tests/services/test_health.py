import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from services import health
from services.errors import ServiceError
from services.process import heartbeat
from services.process.heartbeat import Heartbeat
from services.process.loop import Loop
from services.process.supervisor import gemuco_command
from services.wire import probe


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """A folder of one's own, and a second that takes a tenth."""
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.setattr(heartbeat, "EVERY", 0.05)
    monkeypatch.setattr(health, "STUCK", 0.5)


def eventually(happened: Callable[[], bool], within: float = 20.0) -> None:
    deadline = time.monotonic() + within
    while not happened():
        assert time.monotonic() < deadline, health.check("hal", "arm")
        time.sleep(0.01)


@pytest.fixture
def held() -> Iterator[threading.Event]:
    """Set it and ticks go on."""
    event = threading.Event()
    yield event
    event.set()


def run(*ticks: Callable[[], None]) -> list[Loop]:
    loops = [Loop(f"loop{number}", 100.0, tick) for number, tick in enumerate(ticks)]
    for loop in loops:
        loop.start()
    return loops


def test_who_never_started_is_not_healthy() -> None:
    is_healthy, text = health.check("hal", "arm")
    assert not is_healthy
    assert "still starting" in text


def test_loops_that_go_on_are_healthy_and_the_file_goes_with_them() -> None:
    loops = run(lambda: None, lambda: None)
    with Heartbeat("hal", "arm", loops):
        eventually(lambda: loops[0].done > 60)
        is_healthy, text = health.check("hal", "arm")
        assert is_healthy, text
        assert f"Process {os.getpid()} is healthy" in text
    assert not health.check("hal", "arm")[0]
    for loop in loops:
        loop.stop()


def test_a_tick_that_never_returns_is_found_by_name_and_found_again_when_it_does(held: threading.Event) -> None:
    loops = run(lambda: None, lambda: held.wait() and None)
    with Heartbeat("hal", "arm", loops):
        eventually(lambda: not health.check("hal", "arm")[0])
        assert "Loop 'loop1'" in health.check("hal", "arm")[1]
        held.set()
        eventually(lambda: health.check("hal", "arm")[0])
    for loop in loops:
        loop.stop()


def test_a_loop_whose_every_tick_fails_is_not_healthy_and_tells_why() -> None:
    def broken() -> None:
        raise RuntimeError("no such muscle")

    loops = run(broken)
    with Heartbeat("hal", "arm", loops):
        eventually(lambda: not health.check("hal", "arm")[0])
        assert "no such muscle" in health.check("hal", "arm")[1]
    loops[0].stop()


def written(**changed: object) -> None:
    """What a live process wrote, with something changed."""
    loops = run(lambda: None)
    with Heartbeat("hal", "arm", loops):
        content = json.loads(health.heartbeat_path("hal", "arm").read_text())
    loops[0].stop()
    health.heartbeat_path("hal", "arm").write_text(json.dumps(content | changed))


@pytest.mark.parametrize(
    ("changed", "report"),
    [
        ({}, "is healthy"),
        ({"boot": "another"}, "before this machine started"),
        ({"started": "1"}, "was killed or has crashed"),
        ({"pid": 2**22 + 1}, "was killed or has crashed"),
        ({"stamp": 0.0}, "frozen"),
        ({"loops": None}, "cannot be read"),
    ],
)
def test_what_an_earlier_life_wrote_counts_for_nothing(changed: dict[str, object], report: str) -> None:
    written(**changed)
    is_healthy, text = health.check("hal", "arm")
    assert report in text
    assert is_healthy == (changed == {})


def test_another_pid_namespace_is_judged_by_the_stamp_alone() -> None:
    written(space="pid:[1]", pid=2**22 + 1)
    assert health.check("hal", "arm")[0]


@pytest.mark.parametrize("content", ["", "{", "[]", "null", '{"boot": 1}'])
def test_half_a_file_is_not_healthy(content: str) -> None:
    health.heartbeat_path("hal", "arm").write_text(content)
    assert not health.check("hal", "arm")[0]


def test_a_full_disk_is_logged_once_and_stops_nothing(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    loops = run(lambda: None)
    monkeypatch.setattr(heartbeat, "heartbeat_path", lambda *_: Path("/proc/no/such.heartbeat"))
    with Heartbeat("hal", "arm", loops):
        eventually(lambda: loops[0].done > 30)
    loops[0].stop()
    assert len(caplog.records) == 1
    assert "No heartbeat in" in caplog.text


@pytest.mark.long
def test_systemd_hears_of_the_start_of_life_and_of_nothing_while_stuck(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, held: threading.Event
) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(str(tmp_path / "notify"))
        manager.settimeout(5.0)
        monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
        holding = threading.Event()
        loops = run(lambda: held.wait() and None if holding.is_set() else None)
        with Heartbeat("hal", "arm", loops):
            assert manager.recv(64) == b"READY=1"
            assert manager.recv(64) == b"WATCHDOG=1"
            holding.set()
            eventually(lambda: not health.check("hal", "arm")[0])
            manager.settimeout(0.0)
            with pytest.raises(BlockingIOError):
                while True:
                    assert manager.recv(64) == b"WATCHDOG=1"
            manager.settimeout(0.3)
            with pytest.raises(TimeoutError):
                manager.recv(64)
            held.set()
            manager.settimeout(5.0)
            assert manager.recv(64) == b"WATCHDOG=1"
        while (word := manager.recv(64)) == b"WATCHDOG=1":
            pass
        assert word == b"STOPPING=1"
    loops[0].stop()


def asked(*arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "services.health", *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as found:
        return int(found.getsockname()[1])


@pytest.mark.slow
def test_a_router_that_lives_is_frozen_and_dies() -> None:
    command = gemuco_command("router", "--listen", f"tcp/127.0.0.1:{free_port()}")
    with subprocess.Popen(command, stdout=subprocess.DEVNULL) as router:
        try:
            eventually(lambda: health.check("router", "")[0])
            assert asked("router").returncode == 0
            router.send_signal(signal.SIGSTOP)
            eventually(lambda: "frozen" in health.check("router", "")[1])
            router.send_signal(signal.SIGCONT)
            eventually(lambda: health.check("router", "")[0])
        finally:
            router.kill()
    found = asked("router")
    assert found.returncode == 1
    assert "was killed or has crashed" in found.stdout


def test_the_check_loads_nothing_that_takes_long() -> None:
    code = "import sys, services.health; sys.exit(bool({'numpy', 'zenoh', 'typer', 'logging'} & set(sys.modules)))"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert found.returncode == 0, found.stderr
    assert asked().returncode == 2


def test_a_door_behind_which_nobody_reads_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(probe, "PATIENCE", 0.2)
    with socket.create_server(("127.0.0.1", 0)) as deaf, pytest.raises(ServiceError, match="No answer at"):
        probe.check_answers([f"tcp/127.0.0.1:{deaf.getsockname()[1]}"])
    with pytest.raises(ServiceError, match="No answer at"):
        probe.check_answers([f"quic/127.0.0.1:{free_port()}"])
    probe.check_answers(["unixsock-stream//tmp/no", "serial//dev/no"])
