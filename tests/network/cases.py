"""The faults of the campaign: what is broken, and how it is mended."""

import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from link import inside
from stack import HERE, ROUTER, VIEWERS, Stack

AGAIN = 30.0
"""How long [s] a killed process may take to come up on a loaded machine."""
HOUR = 3600.0


@dataclass(slots=True)
class Times:
    """When what was done [monotonic s]; infinite where it was not."""

    broken: float
    mended: float


@dataclass(frozen=True, slots=True)
class Case:
    """One fault.

    Attributes:
        name: For the table.
        do: Breaks and mends.
        gone: Service that must be told as gone, and as there again.
        is_untouched: Whether the robot must go on following throughout.
        is_killed: Whether a process starts anew, which takes seconds.
        viewers: Whether viewers lose their link, and must have it back.
    """

    name: str
    do: Callable[[Stack], Times]
    gone: str = ""
    is_untouched: bool = False
    is_killed: bool = False
    viewers: bool = False


def cut(seconds: float, down: bool = True, up: bool = True) -> Callable[[Stack], Times]:
    def do(stack: Stack) -> Times:
        broken = stack.link.set({"cut": down}, {"cut": up})
        time.sleep(seconds)
        return Times(broken, stack.link.heal())

    return do


def bad(seconds: float, **wanted: float) -> Callable[[Stack], Times]:
    def do(stack: Stack) -> Times:
        broken = stack.link.both(**wanted)
        time.sleep(seconds)
        return Times(broken, stack.link.heal())

    return do


def frozen(name: str, seconds: float) -> Callable[[Stack], Times]:
    def do(stack: Stack) -> Times:
        broken = stack.signal(name, signal.SIGSTOP)
        time.sleep(seconds)
        return Times(broken, stack.signal(name, signal.SIGCONT))

    return do


def killed(name: str) -> Callable[[Stack], Times]:
    """Killed, and started again after 2 s; mended is when it came up: the first cycle, tick or open port."""

    def do(stack: Stack) -> Times:
        broken = stack.kill(name)
        time.sleep(2.0)
        begun = time.monotonic()
        stack.start(name)
        if name == "router":
            stack.until(lambda: listens(stack), "the router listens", AGAIN)
            return Times(broken, time.monotonic())
        stack.until(lambda: stack.records[name].read(begun), f"'{name}' comes up", AGAIN)
        return Times(broken, stack.records[name].rows[0][0])

    return do


def listens(stack: Stack) -> bool:
    """Whether the router has its port."""
    pid = stack.supervisor.children["router"].process.pid
    wanted = f":{int(ROUTER.rpartition(':')[2]):04X}"
    for kind, state in (("udp", "07"), ("tcp", "0A")):
        try:
            lines = Path(f"/proc/{pid}/net/{kind}").read_text().splitlines()[1:]
        except OSError:
            return False
        if any(line.split()[1].endswith(wanted) and line.split()[3] == state for line in lines):
            return Path(f"/proc/{pid}/ns/net").readlink() != Path("/proc/self/ns/net").readlink()
    return False


def replayed(seconds: float) -> Callable[[Stack], Times]:
    """All that was heard comes again, at once and `seconds` later, for 4 s; from the side of the HAL."""

    def do(stack: Stack) -> Times:
        command = inside(
            stack.link.first, sys.executable, str(HERE / "replayer.py"), stack.robot, str(stack.roles["operator"]),
            str(seconds),
        )  # fmt: skip
        process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=stack.env, start_new_session=True
        )
        assert process.stdout is not None
        try:
            if process.stdout.readline().strip() != "ready":
                raise RuntimeError("The replayer did not start.")
            broken = time.monotonic()
            time.sleep(4.0)
            played, _ = process.communicate(timeout=10.0)
        finally:
            process.kill()
        if int(played) < 100:
            raise RuntimeError(f"Only {played.strip()} messages were played again.")
        return Times(broken, time.monotonic())

    return do


def watched(how_many: int, slow: float = 0.0, is_stopped: bool = False) -> Callable[[Stack], Times]:
    """Viewers beside the router for 4 s."""

    def do(stack: Stack) -> Times:
        command = inside(
            stack.link.first, sys.executable, str(HERE / "viewers.py"), stack.robot,
            ",".join(str(stack.roles[name]) for name in VIEWERS), str(how_many), str(slow),
        )  # fmt: skip
        process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=stack.env, start_new_session=True
        )
        assert process.stdout is not None
        try:
            if process.stdout.readline().strip() != "ready":
                raise RuntimeError("The viewers did not start.")
            broken = time.monotonic()
            if is_stopped:
                process.send_signal(signal.SIGSTOP)
            time.sleep(4.0)
        finally:
            process.kill()
            process.communicate()
        return Times(broken, time.monotonic())

    return do


def stepped(name: str) -> Callable[[Stack], Times]:
    """The wall clock an hour ahead for 3 s, and then back."""

    def do(stack: Stack) -> Times:
        broken = time.monotonic()
        stack.clocks[name].write_text(str(HOUR))
        time.sleep(3.0)
        stack.clocks[name].unlink()
        return Times(broken, time.monotonic())

    return do


CASES = (
    Case("nothing, 4 s", bad(4.0, loss=0.0), is_untouched=True),
    Case("link cut for 0.2 s", cut(0.2)),
    Case("link cut for 1 s", cut(1.0)),
    Case("link cut for 3 s", cut(3.0), gone="model"),
    Case("link cut for 8 s", cut(8.0), gone="model"),
    Case("cut from HAL to model for 3 s", cut(3.0, up=False), gone="model"),
    Case("cut from model to HAL for 3 s", cut(3.0, down=False), gone="model"),
    Case("50 ms each way, 20 ms jitter, 4 s", bad(4.0, delay=0.05, jitter=0.02)),
    Case("200 ms each way, 50 ms jitter, 4 s", bad(4.0, delay=0.2, jitter=0.05)),
    Case("1 % of packets lost, 4 s", bad(4.0, loss=0.01)),
    Case("5 % of packets lost, 4 s", bad(4.0, loss=0.05)),
    Case("20 % of packets lost, 4 s", bad(4.0, loss=0.2)),
    Case("20 % of packets twice, 4 s", bad(4.0, twice=0.2), is_untouched=True),
    Case("20 % of packets up to 30 ms out of order, 4 s", bad(4.0, swapped=0.2)),
    Case("all messages again, at once and 2 s later, 4 s", replayed(2.0), is_untouched=True),
    Case("model frozen for 3 s", frozen("model", 3.0), gone="model"),
    Case("HAL frozen for 3 s", frozen("hal", 3.0), gone="hal"),
    Case("router killed and back", killed("router"), is_untouched=True, viewers=True),
    Case("a viewer that takes 0.2 s over each message", watched(1, slow=0.2), is_untouched=True),
    Case("a viewer that never reads (SIGSTOP)", watched(1, is_stopped=True), is_untouched=True),
    Case("50 viewers", watched(50), is_untouched=True),
    Case("HAL's wall clock an hour ahead, and back", stepped("hal"), is_untouched=True),
    Case("model's wall clock an hour ahead, and back", stepped("model"), is_untouched=True),
    Case("model killed", killed("model"), gone="model", is_killed=True),
    Case("HAL killed", killed("hal"), gone="hal", is_killed=True),
)
