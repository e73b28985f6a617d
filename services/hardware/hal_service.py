"""The process that owns a robot's hardware: cycles it, publishes what was measured and applied, takes commands.

Safety lives in `hal.robot`; here is only what travels.
"""

import logging
import math
import threading
import time
from collections.abc import Iterable
from typing import Any

from hal.calibration import store
from hal.config import RobotConfig
from hal.errors import CommandRefused
from hal.robot import Robot, open_robot
from services.command.intake import Commands, Intake
from services.command.lateness import Cycles
from services.command.lease import Lease
from services.errors import BadArguments
from services.process import realtime
from services.process.loop import Loop
from services.process.service import Service, until_told
from services.wire import keys, messages
from services.wire.caller import ASKING, Caller
from services.wire.messages import Status
from services.wire.plain_text import plain

log = logging.getLogger(__name__)

CYCLE_PRIORITY = 50
RECEIVE_PRIORITY = 51
"""Above the cycle, which waits for what the receive threads bring."""
NETWORK_PRIORITY = 45
TOLD_TO_END = "The HAL was told to end."
HOLDER_EVERY = 1.0
TAKES_COMMANDS = ("hold", "follow")
"""Modes in which somebody commands who has no more than a stream of commands."""
STUCK_AFTER = 2.0
"""A cycle that did not end for so long [s] will not end any more; the HAL goes without it."""
AT_REST_WITHIN = 60.0
"""How long [s] the robot may take to come to rest when the HAL is told to end; parking takes longest."""


class HalService:
    """A robot between its buses and zenoh.

    Args:
        config: The robot file.
        robot: Not opened yet.
        service: The process's session.
    """

    def __init__(self, config: RobotConfig, robot: Robot, service: Service) -> None:
        self._robot = robot
        self._service = service
        self._samples = service.publisher(keys.sample(config.robot), messages.Sample)
        self._applied = service.publisher(keys.applied(config.robot), messages.Applied)
        self._holder = service.publisher(keys.holder(config.robot), messages.Holder)
        self._lease = Lease(robot.clock)
        self._cycles = Cycles(config.rates.hal, service.boot, robot.clock)
        self._commands = Commands(robot, config.command.signal, service.boot, self._lease)
        self._intake = Intake(service.session, keys.command(config.robot), messages.Command, self._commands.follow)
        self._told_holder: tuple[int, int, int] | None = None
        self._holder_due = -math.inf
        self._loop = Loop("hal", config.rates.hal, self.tick, robot.clock, CYCLE_PRIORITY)
        service.watch(self._loop)
        self._is_open = False
        self._has_camera = bool(config.seen)
        self._uncalibrated = store.uncalibrated(config, store.load(config))
        self._serve()

    def _serve(self) -> None:
        """What stops is for everybody, whatever comes with the question; the rest for who commands, and at once."""
        robot, verb = self._robot, self._service.verb
        verb("enable", lambda _: self._enable(), self._may_move)
        verb("reset", lambda _: self._do(robot.reset), self._may_move)
        verb("home", lambda given: self._do(lambda: robot.home(_named("home", given))), self._may_move)
        verb("tare", lambda given: self._do(lambda: robot.tare(_named("tare", given))), self._may_move)
        verb("disable", lambda _: self._do(robot.disable), self._lease.check)
        verb("stop", lambda _: self._do(lambda: robot.stop("A client asked to stop.")), always=True)
        verb("estop", self._estop, always=True)
        verb("lease", self._take_lease, self._cycles.check)
        verb("release", lambda _: self._lease.give_back(ASKING.get()))

    def run(self, stop: threading.Event) -> None:
        """Cycle the robot until `stop` is set, then let the drives go; commissioning comes first."""
        self._service.publish_status(self.status)
        try:
            self._robot.open()
            self._is_open = True
            realtime.promote("bus ", RECEIVE_PRIORITY)
            realtime.freeze()
            self._loop.start()
            realtime.promote_rest(NETWORK_PRIORITY)
            self._service.run(self.status, stop)
            self._come_to_rest()
        finally:
            self._loop.stop(STUCK_AFTER)
            self._robot.close()

    def _come_to_rest(self) -> None:
        """Stop as the robot file says, and go on cycling meanwhile; a fault or `AT_REST_WITHIN` ends it too."""
        try:
            self._robot.stop(TOLD_TO_END)
        except CommandRefused:  # a stuck cycle; whoever told us to end may have to kill us
            self._robot.estop(TOLD_TO_END)
        deadline = time.monotonic() + AT_REST_WITHIN
        while self._robot.mode not in ("off", "fault") and time.monotonic() < deadline:
            time.sleep(0.01)

    def tick(self) -> None:
        """Take the commands that came, turn the robot once, publish."""
        began = self._robot.clock.monotonic()
        self._intake.take()
        self._tell_holder(began)
        sample, applied = self._robot.cycle()
        self._cycles.note(sample.cycle, began)
        if applied.mode not in TAKES_COMMANDS:
            self._lease.end_stream()
        self._samples.put(messages.Sample.of(sample, elements=sample.values.elements))
        sender = self._commands.sender if applied.mode == "follow" else 0
        self._applied.put(messages.Applied.of(applied, sender=sender))

    def status(self) -> Status:
        """Health of the robot and of the loop."""
        health = self._robot.health()
        loops = {"hal": self._loop.statistics()}
        problem = _problem(health) or self._loop.trouble
        state = "starting" if not self._is_open else "degraded" if problem else "running"
        if health["mode"] == "fault":
            state = "fault"
        # A receive thread is a new one after its bus was closed and opened again.
        realtime.promote("bus ", RECEIVE_PRIORITY)
        return Status(
            stamp_ns=time.time_ns(),
            service=self._service.name,
            state=state,
            text=problem or self._intake.news(),
            loops=loops,
            facts={
                **health,
                "camera": self._has_camera,
                "uncalibrated": self._uncalibrated,
                "commands": {**self._intake.facts(), "sender": self._commands.sender},
                "holder": "" if (held := self._lease.tenure) is None else str(held.caller),
                "scheduling": self._loop.scheduling,
            },
        )

    def _may_move(self, caller: Caller) -> None:
        """Raise unless the caller commands, or nobody does, and it asks now."""
        self._lease.check(caller)
        self._cycles.check(caller)

    def _enable(self) -> dict[str, str]:
        """Enable; what asks on behalf of who commands may then command for it."""
        answer, caller = self._do(self._robot.enable), ASKING.get()
        if caller.through:
            self._lease.delegate(caller)
        return answer

    def _take_lease(self, given: dict[str, Any]) -> dict[str, Any]:
        """Let the caller command, and nobody else, or go on with it."""
        if not {"seconds"} <= set(given) <= {"seconds", "number"}:
            raise BadArguments("lease takes {seconds}, and to renew it {seconds, number}, the number that it answered.")
        caller = ASKING.get()
        if "number" in given:
            held = self._lease.renew(caller, given["seconds"], given["number"])
        else:
            held = self._lease.take(caller, given["seconds"])
        return {"name": str(held.caller), "holder": held.caller.boot, "number": held.number, "left": self._lease.left()}

    def _tell_holder(self, now: float) -> None:
        """Publish who commands when that has changed, and once a second."""
        held = self._lease.tenure
        told = (0, 0, 0) if held is None else (held.caller.boot, held.through, held.number)
        if told == self._told_holder and now < self._holder_due:
            return
        self._told_holder, self._holder_due = told, now + HOLDER_EVERY
        name, left = ("", 0.0) if held is None else (str(held.caller), self._lease.left())
        self._holder.put(
            messages.Holder(stamp_ns=time.time_ns(), name=name, holder=told[0], through=told[1], left=left)
        )

    def _estop(self, given: dict[str, Any]) -> dict[str, Any]:
        """Stop everything; what every drive did, in the order of the robot file."""
        found = self._robot.estop(plain(str(given.get("reason", ""))) or "A client asked for it.")
        devices = [{"device": one.device, "stopped": one.has_stopped, "text": one.text} for one in found.devices]
        return {"complete": found.is_complete, "devices": devices, "text": found.text, "mode": self._robot.mode}

    def _do(self, act: Any) -> dict[str, str]:
        """Ask the robot; the answer tells where it stands, which may be on the way."""
        act()
        return {"mode": self._robot.mode, "fault": self._robot.fault_text}


def _named(verb: str, given: dict[str, Any]) -> str:
    if set(given) != {"device"}:
        raise BadArguments(f"{verb} takes {{device: name}}, not {{{', '.join(given)}}}.")
    return str(given["device"])


def _problem(health: dict[str, Any]) -> str:
    """The most important thing that is wrong, in one sentence; empty when nothing is."""
    if health["fault"]:
        return str(health["fault"])
    for name, bus in health["buses"].items():
        if bus["state"] != "ok":
            return f"Bus '{name}' is {bus['state']}. {bus['text']}".strip()
    ill = [(name, device) for name, device in health["devices"].items() if device["text"]]
    if ill:
        name, device = ill[0]
        more = f" (and {len(ill) - 1} more devices)" if len(ill) > 1 else ""
        return f"{name}: {device['text']}{more}"
    return str(health["limits"])


def _describe(config: RobotConfig) -> dict[str, Any]:
    """What a client must know of the robot: signals with units and elements, command, limits, rates, devices."""
    signals = {
        name: {"unit": signal.unit, "elements": list(signal.elements), "source": signal.source}
        for name, signal in config.signals.items()
    }
    return {
        "description": config.description,
        "signals": signals,
        "command": config.command.model_dump(),
        "conditions": list(config.conditions),
        "limits": {name: limit.model_dump(exclude_none=True) for name, limit in config.limits.items()},
        "rates": config.rates.model_dump(),
        "devices": {name: {"kind": one.kind, "elements": list(one.served)} for name, one in config.devices.items()},
    }


def run_hal(config: RobotConfig, connect: Iterable[str] = (), stop: threading.Event | None = None) -> int:
    """Run the hardware service of a robot until SIGTERM, SIGINT or `stop`.

    Args:
        config: The robot file.
        connect: Endpoints, such as a router's, and role files.
        stop: Ends the service in place of the signals.

    Returns:
        The process's exit code.

    Raises:
        ConfigError: The robot file names what is not there.
        AlreadyRunning: The robot has this service already.
        ServiceError: No session.
    """
    realtime.prepare_process()
    robot = open_robot(config)
    with until_told(stop) as told, Service(config.robot, "hal", connect, lambda: _describe(config)) as service:
        log.info("HAL of robot '%s' runs (boot %d)", config.robot, service.boot)
        HalService(config, robot, service).run(told)
    return 0
