"""Anybody says anything, on every key of a running robot: nothing ends, nothing moves, everything is counted.

    python tests/system/fuzz_messages.py --count 100000

Router, HAL, model, recorder, clients and both kinds of `top` run in threads of this process, so that a dying thread, an
exception that nobody catches and memory that is kept are seen. Half of the messages come while the motors are off,
half while a client with the lease holds them at a place.
"""

import argparse
import contextlib
import gc
import logging
import os
import random
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import msgpack
import numpy as np
import zenoh
from mutator import Mutator
from rich.console import Console

ROOT = Path(__file__).resolve().parents[2]
sys.path.append(str(ROOT))
from gemuco.errors import SchemaError  # noqa: E402
from hal.config import load_robot  # noqa: E402
from hal.errors import HalError  # noqa: E402
from hal.robot import Robot  # noqa: E402
from services.client import Client  # noqa: E402
from services.errors import ServiceError, WrongVersion  # noqa: E402
from services.hardware.hal_service import HalService  # noqa: E402
from services.model import serve  # noqa: E402
from services.process.router import run_router  # noqa: E402
from services.process.service import Service  # noqa: E402
from services.recording.recorder import run_recorder  # noqa: E402
from services.verbs import fleet_top, top  # noqa: E402
from services.watch.fleet_watch import FleetWatch  # noqa: E402
from services.watch.robot_watch import snapshot_of  # noqa: E402
from services.wire import keys, messages  # noqa: E402
from services.wire.session import CLIENT, close_session, new_boot, open_session  # noqa: E402
from studies.stack import light_model, light_robot  # noqa: E402
from studies.stack.in_process import LiveDevice  # noqa: E402
from studies.stack.soak.robot import free_port  # noqa: E402

RATE = 50.0
PATIENCE = 100.0
HERE = np.array([0.2, -0.3])
"""Where the holder of the lease keeps the motors [rad]."""
STREAMS = {
    "hal/sample": "sample", "vision/sample": "sample", "simulator/truth": "sample", "hal/applied": "applied",
    "hal/command": "command", "hal/holder": "holder", "model/estimate": "estimates", "model/anomaly": "anomaly",
    "model/update": "update", "model/target": "target",
    **{f"{service}/status": "status" for service in keys.SERVICES},
}  # fmt: skip
STOPPING = ("stop", "estop")
"""Done whoever asks however badly, and so asked only while the motors are off."""
VERBS = {
    "hal": ("enable", "disable", "reset", "home", "tare", "lease", "release", "describe", *STOPPING),
    "model": ("estimate", "control", "simulate", "anomaly", "engage", "disengage", "target", "adapt", "rollback",
              "normal", "history", "describe"),
    "recorder": ("describe",),
    "simulator": ("fault", "describe"),
    "vision": ("fault", "describe"),
}  # fmt: skip
STRANGE = (
    "**",
    "*/status",
    "hal/*",
    "hal/sample/more",
    "hal",
    "nobody/status",
    "hal/do/nothing",
    "*/do/*",
    "hal/alive",
)
"""What is no key of ours, or many at once."""


class Watched(LiveDevice):
    """The light robot, which notes what its drives are really told."""

    def __init__(self, config: Any, world: light_robot.LightWorld) -> None:
        super().__init__(config, world)
        self.applied: list[np.ndarray] = []
        self.enabled = 0

    def enable(self) -> None:
        self.enabled += 1
        super().enable()

    def apply(self, values: np.ndarray) -> None:
        self.applied.append(values.copy())
        super().apply(values)


class Stage:
    """One robot with all that listens to it, and somebody who says anything."""

    def __init__(self, folder: Path, robot: str, seed: int = 0) -> None:
        file = light_robot.write(folder, robot, RATE, False)
        self.robot, self._config, self._folder = robot, load_robot(file), folder
        self._model = folder / "model"
        light_model.make(file, self._model)
        self.device = Watched(self._config, light_robot.LightWorld(0))
        self.report = threading.Event()
        self.died: list[str] = []
        self.logged: list[str] = []
        self.jobs: dict[str, threading.Thread] = {}
        self._seed = seed
        self._stack = contextlib.ExitStack()

    def __enter__(self) -> Self:
        with self._stack as stack:
            stack.enter_context(self._watching())
            where = (f"tcp/127.0.0.1:{free_port()}",)
            stack.callback(self._end)
            self._start("router", lambda: run_router(where, (), self.report))
            eventually(lambda: is_served(where[0]))
            robot = Robot(self._config, [self.device], source="simulated")
            self.hal = HalService(self._config, robot, stack.enter_context(Service(self.robot, "hal", where)))
            stack.callback(self._end)  # before the HAL's session is closed
            self._start("hal", lambda: self.hal.run(self.report))
            self._start("model", lambda: serve.serve(self._config, self._model, where, self.report))
            self._start("recorder", lambda: run_recorder(self.robot, self._folder / "fuzz.mcap", where, self.report))
            self.client = stack.enter_context(Client(self.robot, where, name="who looks on"))
            self.holder = stack.enter_context(Client(self.robot, where, name="who holds"))
            eventually(lambda: self.client.alive() >= {"hal", "model", "recorder"})
            eventually(lambda: self.client.estimate() is not None)
            self.fleet = stack.enter_context(FleetWatch(where))
            self.session = open_session(self.robot, CLIENT, where)
            stack.callback(close_session, self.session)
            self.liars = [self.session.declare_queryable(keys.verb(self.robot, "simulator", "fault"), self._lie)]
            self.look()
            self.mutator = Mutator(self._seed, self._templates())
            self.threads = {one.name for one in threading.enumerate() if one.name.startswith(("job", "loop", "newest"))}
            self._stack = stack.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.close()

    def _start(self, name: str, job: Callable[[], object]) -> None:
        self.jobs[name] = threading.Thread(target=job, name=f"job {name}")
        self.jobs[name].start()

    def look(self) -> None:
        """What both kinds of `top` show, and everything a client can read."""
        console = Console(file=open(os.devnull, "w"), width=200)  # noqa: SIM115, PTH123
        with console.file:
            console.print(top.view(snapshot_of(self.client, self.client.alive())))
            console.print(fleet_top.view(fleet_top.ranked(self.fleet.snapshots()), self.fleet, ["the router"]))
        for read in (self.client.truth, self.client.vision, self.client.applied, self.client.update):
            with contextlib.suppress(WrongVersion):
                read()

    def say(self, count: int, may_stop: bool, pace: float) -> None:
        """So many messages, one key after the other, `pace` [s] apart."""
        draw, mutator = self.mutator.draw, self.mutator
        streams = list(STREAMS.items())
        for number in range(count):
            if pace:
                time.sleep(pace)
            kind = number % 8
            if kind < 5:
                noun, record = streams[number // 8 % len(streams)]
                key = keys.robot_key(self.robot, noun)
                self.session.put(key, mutator.message(record), attachment=self._attachment(draw, mutator))
            elif kind < 7:
                self._ask(may_stop)
            else:
                self._strange()
            if number % 500 == 499:
                self.look()

    def _ask(self, may_stop: bool) -> None:
        draw = self.mutator.draw
        service = draw.choice(list(VERBS))
        verb = draw.choice(VERBS[service])
        if verb in STOPPING and not may_stop:
            verb = "describe"
        key = keys.verb(self.robot, service, verb)
        payload = None if draw.random() < 0.2 else self.mutator.arguments()
        for reply in self.session.get(
            key, payload=payload, attachment=self._attachment(draw, self.mutator), timeout=2.0
        ):
            if reply.ok is not None and service != "simulator":  # which is a liar
                msgpack.unpackb(reply.ok.payload.to_bytes())

    def _attachment(self, draw: random.Random, mutator: Mutator) -> bytes | None:
        """Who asks, told badly; or not at all."""
        report = {"v": 2, "name": "fuzz", "boot": 7}
        chance = draw.random()
        if chance < 0.3:
            return None
        if chance < 0.5:
            return mutator.message("target")
        return msgpack.packb(
            report | {draw.choice(("v", "name", "boot", "through", "hal_boot", "cycle")): mutator.value()}
        )

    def _strange(self) -> None:
        draw = self.mutator.draw
        noun, payload = draw.choice(STRANGE), self.mutator.message("status")
        key, act = keys.robot_key(self.robot, noun), draw.randrange(5)
        if act == 0:
            self.session.delete(keys.robot_key(self.robot, draw.choice(list(STREAMS))))
        elif act == 1:
            service = draw.choice((*keys.SERVICES, "nobody"))
            token = self.session.liveliness().declare_token(keys.alive(self.robot, service))
            token.undeclare()
        elif act == 2:
            list(self.session.get(keys.robot_key(self.robot, draw.choice(list(STREAMS))), payload=payload, timeout=0.2))
        elif act == 3 and "do" in noun:
            list(self.session.get(key, payload=payload, timeout=0.5))
        else:
            self.session.put(key, payload)

    def _lie(self, query: zenoh.Query) -> None:
        """Answer a verb with anything."""
        with query:
            query.reply(query.key_expr, self.mutator.message("status"), attachment=self.mutator.message("target"))

    def listen_to_lies(self, times: int) -> int:
        """Ask the liar; how many answers were refused, each as an error of ours."""
        refused = 0
        for _ in range(times):
            try:
                self.client.ask("simulator", "fault", timeout=0.5)
            except (ServiceError, HalError, SchemaError):
                refused += 1
        return refused

    @contextlib.contextmanager
    def held(self) -> Iterator[None]:
        """Motors enabled, and kept at `HERE` by the holder of the lease; ends with the motors off.

        If the machine stood still for longer than the watchdog of the cycle allows, a fault has ended it before.
        """
        stop = threading.Event()

        def stream() -> None:
            while not stop.wait(0.04):
                if (sample := self.holder.sample(max_age=1.0)) is not None:
                    self.holder.command(light_robot.MOTOR, HERE, sample)

        with self.holder.lease(5.0):
            self.holder.enable()
            thread = threading.Thread(target=stream, name="job holder")
            thread.start()
            try:
                eventually(lambda: bool(self.device.applied) and np.allclose(self.device.applied[-1], HERE, atol=1e-6))
                yield
            finally:
                stop.set()
                thread.join()
                self.holder.disable()
        eventually(
            lambda: self.mode() == "off" or (self.mode() == "fault" and "Was the HAL frozen?" in self.fault()),
            report=lambda: f"mode '{self.mode()}', {self.fault()}",
        )

    def mode(self) -> str:
        return str(self.hal.status().facts["mode"])

    def fault(self) -> str:
        return str(self.hal.status().facts["fault"])

    def facts(self, service: str) -> dict[str, Any]:
        """What a service counts, newer than this call; forged ones with other boots are passed by."""
        deadline = time.monotonic() + PATIENCE
        reader = self.client.reader(keys.status(self.robot, service), messages.Status)
        while time.monotonic() < deadline:
            status = reader.wait(2.0)
            if status is not None and (service != "hal" or "commands" in status.facts):
                return dict(status.facts)
        raise AssertionError(f"no status of {service}")

    def check(self) -> None:
        """Everything runs, answers and is fresh; nobody died and nothing was logged as an error."""
        assert not self.died, self.died
        running = {one.name for one in threading.enumerate()}
        assert self.threads <= running, self.threads - running
        assert all(job.is_alive() for job in self.jobs.values())
        for service in ("hal", "model", "recorder"):
            assert self.client.describe(service, timeout=PATIENCE)["service"] == service
        time.sleep(3.0)  # until what was of another version is forgotten
        eventually(lambda: self.client.estimate() is not None and self.client.sample() is not None)
        loops = {**self.client.status("hal", timeout=5.0).loops, **self.client.status("model", timeout=5.0).loops}
        assert not [name for name, loop in loops.items() if loop["failed"]], loops
        errors = [line for line in self.logged if "ERROR" in line]
        assert not errors, errors[:5]

    def _templates(self) -> dict[str, dict[str, Any]]:
        """A well-formed message of each type: those that were heard, and those that nobody here says."""
        found = {}
        for message in (
            self.client.sample(timeout=5.0), self.client.applied(timeout=5.0), self.client.estimate(timeout=5.0),
            self.client.anomaly(timeout=5.0), self.client.update(max_age=5.0, timeout=5.0),
            self.client.status("hal", timeout=5.0), messages.Holder(name="fuzz", holder=7),
            messages.Command(signal=light_robot.MOTOR, values=np.ones(2), cycle=1, hal_boot=1, boot=7),
            messages.Target(signal=light_robot.JOINT, values=np.ones(2), boot=7),
        ):  # fmt: skip
            assert message is not None
            found[message.TYPE] = msgpack.unpackb(messages.encode(message, boot=new_boot(), stamp_ns=time.time_ns()))
        return found

    @contextlib.contextmanager
    def _watching(self) -> Iterator[None]:
        """Notice threads that die, errors that nobody catches, and what is logged."""
        hooks = threading.excepthook, sys.unraisablehook
        threading.excepthook = lambda info: self.died.append(f"{info.thread}: {info.exc_value!r}")
        sys.unraisablehook = lambda info: self.died.append(f"{info.object}: {info.exc_value!r}")
        handler = logging.Handler(logging.WARNING)
        handler.emit = lambda record: self.logged.append(f"{record.levelname} {record.getMessage()[:300]}")  # type: ignore[method-assign]
        logging.getLogger().addHandler(handler)
        try:
            yield
        finally:
            threading.excepthook, sys.unraisablehook = hooks
            logging.getLogger().removeHandler(handler)

    def _end(self) -> None:
        self.report.set()
        for job in self.jobs.values():
            job.join(PATIENCE)


def is_served(where: str) -> bool:
    """Whether somebody listens at a loopback endpoint."""
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", int(where.rpartition(":")[2]))) == 0


def eventually(happened: Callable[[], bool], report: Callable[[], str] = str) -> None:
    deadline = time.monotonic() + PATIENCE
    while not happened():
        assert time.monotonic() < deadline, f"it did not happen in time; {report()}"
        time.sleep(0.01)


def memory() -> float:
    """Resident memory of this process [MB]."""
    gc.collect()
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


def campaign(stage: Stage, count: int, pace: float) -> dict[str, Any]:
    """Off, then held: so many messages in all; what was counted."""
    begun, sizes, before = time.monotonic(), [memory()], stage.device.enabled
    chunk = max(1, count // 20)
    for _ in range(10):
        stage.say(chunk, True, pace)
        sizes.append(memory())
    assert stage.device.enabled == before, "somebody enabled the motors"
    assert not stage.device.applied, "the drives were told to move"
    stage.check()
    with contextlib.suppress(ServiceError, HalError):
        stage.holder.reset()  # a stop or emergency stop may have been among them
    with stage.held():
        stage.device.applied.clear()
        for _ in range(10):
            stage.say(chunk, False, pace)
            sizes.append(memory())
        moved = max(float(np.abs(values - HERE).max()) for values in stage.device.applied)
        held = len(stage.device.applied)
    assert moved < 1e-6, f"the set-points moved by {moved} rad"
    lies = max(5, chunk // 50)
    assert stage.listen_to_lies(lies) >= 0.5 * lies
    stage.check()
    return {
        "messages": 20 * chunk,
        "seconds": round(time.monotonic() - begun, 1),
        "memory": [round(size, 1) for size in sizes],
        "set_points_while_held": held,
        "commands": stage.facts("hal")["commands"],
        "model_rejected": stage.facts("model").get("rejected"),
        "top_rejected": stage.fleet.rejected,
        "top_strange": stage.fleet.strange,
        "readers_rejected": sum(reader.rejected for reader in stage.client._link._readers.values()),
        "warnings": len(stage.logged),
    }


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=100_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--pace", type=float, default=0.0005, help="pause [s] after each, so that all are read")
    options = parser.parse_args()
    place = Path("runs/fuzz")
    place.mkdir(parents=True, exist_ok=True)
    logging.basicConfig(level=logging.ERROR)
    with Stage(place, f"fuzz_{os.getpid()}", options.seed) as everybody:
        for what, number in campaign(everybody, options.count, options.pace).items():
            print(f"{what}: {number}")
    print("NOTHING ENDED, NOTHING MOVED")
