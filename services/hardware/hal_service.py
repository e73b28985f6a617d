"""The process that owns a robot's hardware: it cycles the robot, publishes samples, takes commands.

Safety is in `hal.robot`.
"""

import logging
import math
import threading
import time
from collections.abc import Callable, Iterable
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
from services.process.service import Service, until_stopped
from services.wire import keys, messages
from services.wire.caller import CURRENT_CALLER, Caller
from services.wire.messages import Status
from services.wire.plain_text import plain

log = logging.getLogger(__name__)

CYCLE_PRIORITY = 50
RECEIVE_PRIORITY = 51
"""The receive threads run above the cycle, which waits for their frames."""
NETWORK_PRIORITY = 45
END_REASON = "The HAL ends."
HOLDER_EVERY = 1.0
"""The lease holder is published at least this often [s]."""
TAKES_COMMANDS = ("hold", "follow")
"""In these modes a client without a lease commands as long as it streams commands."""
STUCK_AFTER = 2.0
"""A cycle that has not ended after this time [s] is stuck, and the HAL ends without it."""
AT_REST_WITHIN = 60.0
"""When the HAL ends, the robot comes to rest within this time [s]; parking takes longest."""


class HalService:
    """A robot between its buses and zenoh.

    Args:
        config: The robot file.
        robot: A robot that is not open yet.
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
        self._published_holder: tuple[int, int, int] | None = None
        self._holder_due = -math.inf
        self._loop = Loop("hal", config.rates.hal, self.tick, robot.clock, CYCLE_PRIORITY)
        service.watch(self._loop)
        self._is_open = False
        self._has_camera = bool(config.seen)
        self._uncalibrated = store.uncalibrated(config, store.load(config))
        self._serve()

    def _serve(self) -> None:
        """Declare the verbs. Any client may stop the robot; a motion needs the lease and a recent cycle."""
        robot, verb = self._robot, self._service.verb
        verb("enable", lambda _: self._enable(), self._may_move)
        verb("reset", lambda _: self._do(robot.reset), self._may_move)
        verb("home", lambda arguments: self._do(lambda: robot.home(_device("home", arguments))), self._may_move)
        verb("tare", lambda arguments: self._do(lambda: robot.tare(_device("tare", arguments))), self._may_move)
        verb("disable", lambda _: self._do(robot.disable), self._lease.check)
        verb("stop", lambda _: self._do(lambda: robot.stop("A client asked to stop.")), always=True)
        verb("estop", self._estop, always=True)
        verb("lease", self._take_lease, self._cycles.check)
        verb("release", self._release)

    def run(self, stop: threading.Event) -> None:
        """Commission the devices, cycle the robot until `stop` is set, and release the drives."""
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
        """Stop as the robot file says, and cycle until the robot is off, has a fault, or `AT_REST_WITHIN` is over."""
        try:
            self._robot.stop(END_REASON)
        except CommandRefused:  # a stuck cycle: the process may have to be killed
            self._robot.estop(END_REASON)
        deadline = time.monotonic() + AT_REST_WITHIN
        while self._robot.mode not in ("off", "fault") and time.monotonic() < deadline:
            time.sleep(0.01)

    def tick(self) -> None:
        """Take new commands, cycle the robot once, publish."""
        start = self._robot.clock.monotonic()
        self._intake.take()
        self._publish_holder(start)
        sample, applied = self._robot.cycle()
        self._cycles.note(sample.cycle, start)
        if applied.mode not in TAKES_COMMANDS:
            self._lease.end_stream()
        self._samples.put(messages.Sample.of(sample, elements=sample.values.elements))
        sender = self._commands.sender if applied.mode == "follow" else 0
        self._applied.put(messages.Applied.of(applied, sender=sender))

    def status(self) -> Status:
        """Return the health of the robot and of the loop."""
        health = self._robot.health()
        loops = {"hal": self._loop.statistics()}
        problem = _problem(health) or self._loop.trouble
        state = "starting" if not self._is_open else "degraded" if problem else "running"
        if health["mode"] == "fault":
            state = "fault"
        # A bus that was closed and opened again has a new receive thread.
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
                "holder": "" if (tenure := self._lease.tenure) is None else str(tenure.caller),
                "scheduling": self._loop.scheduling,
            },
        )

    def _may_move(self, caller: Caller) -> None:
        """Raise unless the request is recent and its caller holds the lease, or no client does."""
        self._lease.check(caller)
        self._cycles.check(caller)

    def _enable(self) -> dict[str, str]:
        """Enable the robot. A service that asks on behalf of the lease holder may then command for it."""
        reply, caller = self._do(self._robot.enable), CURRENT_CALLER.get()
        if caller.through:
            self._lease.delegate(caller)
        return reply

    def _take_lease(self, arguments: dict[str, Any]) -> dict[str, Any]:
        """Give the caller the lease, or renew it."""
        if not {"seconds"} <= set(arguments) <= {"seconds", "number", "new"}:
            raise BadArguments(
                "lease takes {seconds}, or {seconds, number, new: true} with a random number; a renewal takes "
                "{seconds, number} with the number of the lease."
            )
        caller = CURRENT_CALLER.get()
        if arguments.get("new"):
            tenure = self._lease.take(caller, arguments["seconds"], arguments.get("number"))
        elif "number" in arguments:
            tenure = self._lease.renew(caller, arguments["seconds"], arguments["number"])
        else:
            tenure = self._lease.take(caller, arguments["seconds"])
        name, holder = str(tenure.caller), tenure.caller.boot
        return {"name": name, "holder": holder, "number": tenure.number, "left": self._lease.left()}

    def _release(self, arguments: dict[str, Any]) -> None:
        """End the caller's lease."""
        if set(arguments) != {"number"}:
            raise BadArguments("release takes {number}, the number of the lease, which only its holder knows.")
        self._lease.give_back(CURRENT_CALLER.get(), arguments["number"])

    def _publish_holder(self, now: float) -> None:
        """Publish the lease holder when it has changed, and once per `HOLDER_EVERY`."""
        tenure = self._lease.tenure
        holder = (0, 0, 0) if tenure is None else (tenure.caller.boot, tenure.through, tenure.number)
        if holder == self._published_holder and now < self._holder_due:
            return
        self._published_holder, self._holder_due = holder, now + HOLDER_EVERY
        name, left = ("", 0.0) if tenure is None else (str(tenure.caller), self._lease.left())
        self._holder.put(
            messages.Holder(stamp_ns=time.time_ns(), name=name, holder=holder[0], through=holder[1], left=left)
        )

    def _estop(self, arguments: dict[str, Any]) -> dict[str, Any]:
        """Stop all drives; return the result of each in the order of the robot file."""
        report = self._robot.estop(plain(str(arguments.get("reason", ""))) or "A client asked for it.")
        devices = [{"device": one.device, "stopped": one.has_stopped, "text": one.text} for one in report.devices]
        return {"complete": report.is_complete, "devices": devices, "text": report.text, "mode": self._robot.mode}

    def _do(self, action: Callable[[], object]) -> dict[str, str]:
        """Call a function of the robot, and return the mode and fault after it; the mode may still change."""
        action()
        return {"mode": self._robot.mode, "fault": self._robot.fault_text}


def _device(verb: str, arguments: dict[str, Any]) -> str:
    if set(arguments) != {"device"}:
        raise BadArguments(f"{verb} takes {{device: name}}, not {{{', '.join(arguments)}}}.")
    return str(arguments["device"])


def _problem(health: dict[str, Any]) -> str:
    """Return the most important fault in one sentence; empty if there is none."""
    if health["fault"]:
        return str(health["fault"])
    for name, bus in health["buses"].items():
        if bus["state"] != "ok":
            return f"Bus '{name}' is {bus['state']}. {bus['text']}".strip()
    faulty = [(name, device) for name, device in health["devices"].items() if device["text"]]
    if faulty:
        name, device = faulty[0]
        more = f" (and {len(faulty) - 1} more devices)" if len(faulty) > 1 else ""
        return f"{name}: {device['text']}{more}"
    implausible = list(health["implausible"].values())
    if implausible:
        more = f" (and {len(implausible) - 1} more elements)" if len(implausible) > 1 else ""
        return f"{implausible[0]}{more} {health['limits']}".rstrip()
    return str(health["limits"])


def _describe(config: RobotConfig) -> dict[str, Any]:
    """Return the description for clients: signals with units and elements, command, limits, rates, devices."""
    signals = {
        name: {
            "unit": signal.unit,
            "elements": list(signal.elements),
            "source": "vision" if name in config.seen else signal.source,
        }
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


def run_hal(
    config: RobotConfig,
    connect: Iterable[str] = (),
    stop: threading.Event | None = None,
    make: Callable[[RobotConfig], Robot] = open_robot,
) -> int:
    """Run the hardware service of a robot until SIGTERM, SIGINT or `stop`.

    Args:
        config: The robot file.
        connect: Endpoints, such as a router's, and role files.
        stop: Ends the service in place of the signals.
        make: Makes the robot, not open yet, of the robot file.

    Returns:
        The process's exit code.

    Raises:
        ConfigError: The robot file names a driver, file or element that does not exist.
        AlreadyRunning: The robot has this service already.
        ServiceError: No session opens.
    """
    realtime.prepare_process()
    robot = make(config)
    with until_stopped(stop) as end, Service(config.robot, "hal", connect, lambda: _describe(config)) as service:
        log.info("HAL of robot '%s' runs (boot %d)", config.robot, service.boot)
        HalService(config, robot, service).run(end)
    return 0
