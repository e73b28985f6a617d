import os
import signal
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import pytest

from services.process.supervisor import ChildDied, NotReady, Supervisor

SLEEPER = [sys.executable, "-c", "import time; time.sleep(60)"]
STUBBORN = [
    sys.executable,
    "-c",
    "import signal, time; signal.signal(signal.SIGTERM, signal.SIG_IGN); print('up', flush=True); time.sleep(60)",
]


def is_running(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except FileNotFoundError:
        return False


def wait_until(condition, timeout: float = 10.0) -> None:
    deadline = time.monotonic() + timeout
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.02)


def test_children_end_with_the_block(tmp_path: Path) -> None:
    with Supervisor(tmp_path) as supervisor:
        pids = [supervisor.start(name, SLEEPER).process.pid for name in ("one", "two")]
        assert all(map(is_running, pids))
    assert not any(map(is_running, pids))
    assert supervisor.children == {}


def test_a_stubborn_child_is_killed(tmp_path: Path) -> None:
    with Supervisor(tmp_path, grace=0.2) as supervisor:
        child = supervisor.start("stubborn", STUBBORN)
        supervisor.wait_ready("stubborn", lambda: "up" in child.log.read_text(), 10)
    assert child.process.returncode == -signal.SIGKILL


def test_the_last_words_of_a_dead_child_are_told(tmp_path: Path) -> None:
    with Supervisor(tmp_path) as supervisor:
        supervisor.start("brief", [sys.executable, "-c", "raise SystemExit('the bus is on fire')"])
        with pytest.raises(ChildDied, match=r"'brief' exited with 1\. Its last output: the bus is on fire"):
            supervisor.wait_ready("brief", lambda: False, 10)


def test_a_child_that_never_is_ready(tmp_path: Path) -> None:
    with Supervisor(tmp_path) as supervisor:
        supervisor.start("slow", SLEEPER)
        with pytest.raises(NotReady, match=r"'slow' was not ready within 0\.1 s"):
            supervisor.wait_ready("slow", lambda: False, 0.1)


@pytest.mark.long
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGKILL])
def test_no_child_survives_its_supervisor(tmp_path: Path, number: signal.Signals) -> None:
    program = textwrap.dedent(f"""
        import sys, time
        from pathlib import Path
        from services.process.supervisor import Supervisor
        with Supervisor(Path({str(tmp_path)!r})) as supervisor:
            print(supervisor.start("sleeper", {SLEEPER!r}).process.pid, flush=True)
            time.sleep(60)
    """)
    parent = subprocess.Popen(
        [sys.executable, "-c", program], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    )
    assert parent.stdout is not None
    with parent.stdout:
        pid = int(parent.stdout.readline())
    assert is_running(pid)
    os.kill(parent.pid, number)
    parent.wait(10)
    wait_until(lambda: not is_running(pid))


@pytest.mark.parametrize(
    ("number", "raised"),
    [(signal.SIGINT, KeyboardInterrupt), (signal.SIGTERM, SystemExit), (signal.SIGHUP, SystemExit)],
)
def test_a_signal_can_wait_for_a_good_moment(
    tmp_path: Path, number: signal.Signals, raised: type[BaseException]
) -> None:
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(raised), Supervisor(tmp_path, at_checks=True) as supervisor:
            child = supervisor.start("sleeper", SLEEPER)
            os.kill(os.getpid(), number)
            time.sleep(0.01)  # nothing is raised here
            assert child.process.poll() is None
            supervisor.check()
        assert not is_running(child.process.pid)
        with pytest.raises(raised), Supervisor(tmp_path, at_checks=True):
            os.kill(os.getpid(), number)  # nobody checks any more, and it is obeyed at the end
        with pytest.raises(raised), Supervisor(tmp_path, at_checks=True):
            os.kill(os.getpid(), number)
            os.kill(os.getpid(), number)
            pytest.fail("the second signal was not obeyed at once")
    finally:
        signal.signal(signal.SIGINT, before)
