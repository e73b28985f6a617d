"""The body schema as a service: estimation, control, anomaly, trust and update, loops on the newest sample."""

import logging
import threading
import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from msgspec.structs import replace

from gemuco.adaption import update as adapt
from gemuco.certainty import Certainty
from gemuco.errors import SchemaError
from gemuco.intervals.region import Region
from gemuco.intervals.sureness import Sureness
from gemuco.schema import BodySchema
from gemuco.search.descent import NewtonConfig
from hal.clock import Clock, SystemClock
from hal.config import RobotConfig
from hal.errors import HalError
from services.command.intake import NEWS_FOR, Intake
from services.command.permission import Permission
from services.errors import ServiceError
from services.model.acquaintance import Acquaintance
from services.model.anomaly_loop import VERDICT_RATE, AnomalyWatch
from services.model.control_config import ControlConfig, controller_of
from services.model.control_loop import LIVE_MODES, Control
from services.model.estimation import Estimation, Freshness
from services.model.fusion import Fusion
from services.model.hindsight import Hindsight
from services.model.living_model import LivingModel
from services.model.model_config import ModelConfig, model_config
from services.model.trust_loop import RATE as TRUST_RATE
from services.model.trust_loop import Trust
from services.model.update_loop import OnlineUpdate
from services.process.loop import Loop
from services.process.one_core import OneCore
from services.process.realtime import freeze, prepare_thread, promote_rest
from services.process.service import Service
from services.wire import keys, query
from services.wire.caller import CURRENT_CALLER
from services.wire.history import HistoryRing
from services.wire.messages import Anomaly, Applied, Command, Estimates, Holder, Sample, Status, Target, Update
from services.wire.streams import Reader

log = logging.getLogger(__name__)

SEARCH = NewtonConfig(iterations=12)
"""Few steps suffice, because each tick starts from the last solution."""
SHARE = 0.5
"""A solve may take this share of its period; then the best command so far is sent, and counted as late."""
SETTLED = 1e-3
"""A solve that moves the command by less than this share of its range (of 1 without a range) has converged. The command
then stays until the reference or the model changes."""
NETWORK_PRIORITY = 45
STATUS_PRIORITY = 10
"""The status is less urgent than any loop that keeps time: it takes 1 ms, once a second."""
PRIORITIES = {"estimation": 40, "control": 35, "anomaly": 30, "trust": 10, "update": 10, "verdict": 10}
"""These are SCHED_FIFO priorities, where the system allows it. What may compute for long has the lowest ones, below
simulated nodes, but not none: it would hold the interpreter lock while other processes run."""
OFFSETS = {
    "estimation": 0.8e-3, "anomaly": 1.4e-3, "control": 1.9e-3, "trust": 3.4e-3, "update": 7.4e-3, "verdict": 29.4e-3
}  # fmt: skip
"""Each loop begins this time [s] after the multiples of its period. At usual rates no two begin together, none begins
with the HAL, which begins at those multiples, and learning begins after a solve, which takes 1 to 2 ms."""


class ModelSolver:
    """The controller of the model in use."""

    def __init__(self, living: LivingModel, robot: RobotConfig, config: ControlConfig) -> None:
        """Prepare for the robot file's control section.

        Raises:
            SchemaError: This model cannot control; the text names what is missing.
        """
        schema = living.schema
        self._living = living
        self._controller = controller_of(schema, robot, config, SEARCH)
        middle = schema.layout.split(schema.scaler.mean)
        self._controller.solve({config.target: middle[config.target]}, {})
        self._controller.restart()
        self._reference = np.zeros(0)
        low, high = robot.bounds(robot.command.signal)
        self._range = np.where(np.isfinite(high - low), high - low, 1.0)
        self._has_converged = False
        self._command = np.full(len(low), np.nan)
        self._target = config.target
        self._region: tuple[np.ndarray, Certainty | None, Region] | None = None
        self._within = SHARE / robot.rates.control
        self.late = 0
        """This is the number of solves that ran out of time."""

    def judge(self, reference: np.ndarray) -> Sureness:
        """Return whether the body is known at a reference [unit of the target], shape (n,)."""
        schema, known = self._living.schema, self._region
        if known is None or known[0] is not schema.anchors or known[1] is not schema.certainty:
            known = self._region = schema.anchors, schema.certainty, Region(schema, self._target)
        return known[2].judge(reference)

    def __call__(self, target: Mapping[str, np.ndarray], now: Mapping[str, np.ndarray]) -> np.ndarray:
        """Return the command [its unit], shape (n,), that reaches a target."""
        schema, reference = self._living.schema, target[self._target]
        is_swapped = self._controller.schema is not schema
        if is_swapped:
            self._controller.swap(schema)
        if is_swapped or not np.array_equal(reference, self._reference):
            self._reference, self._has_converged, self._command = reference, False, np.full_like(self._command, np.nan)
        if not self._has_converged:
            solution = self._controller.solve(target, now, self._within)
            moved = np.abs(solution.command - self._command) / self._range
            self._has_converged = not solution.is_late and bool((moved < SETTLED).all())
            self._command = solution.command
            self.late += solution.is_late
        return self._command


class GemucoService:
    """The four loops of one robot, bound to its session."""

    def __init__(self, robot: RobotConfig, schema: BodySchema, service: Service, clock: Clock | None = None) -> None:
        """Subscribe, publish and prepare; the loops do not run yet."""
        self.robot, self.config, self.service = robot, model_config(robot), service
        self.clock = clock or SystemClock()
        self.living = LivingModel(schema)
        self._samples = service.newest(keys.sample(robot.robot), Sample)
        self._seen = service.newest(keys.vision(robot.robot), Sample) if robot.seen else None
        self._applied = service.newest(keys.applied(robot.robot), Applied)
        self._targets = Intake(service.session, keys.target(robot.robot), Target, self._follow)
        self.permission = Permission(
            service.boot,
            self._samples.last,
            service.newest(keys.holder(robot.robot), Holder),
            robot.rates.hal,
            self.clock,
        )
        self.freshness = Freshness(
            robot, self._samples.last, self.clock, None if self._seen is None else self._seen.last, schema.layout.names
        )
        self.history = HistoryRing({s.name: s.size for s in schema.layout.signals}, robot.rates.estimation)
        self._estimates = service.publisher(keys.estimate(robot.robot), Estimates)
        self.hindsight = Hindsight(self.freshness, self._schema, self.clock)
        self.acquaintance = Acquaintance()
        self.estimation = Estimation(
            self.freshness, self._schema, self._publish, self.clock, lambda: self.hindsight.factor,
            Fusion(schema.layout.size) if self.config.fuse else None, self.acquaintance.is_known,
        )  # fmt: skip
        self.trust = self._make_trust()
        self.anomaly = AnomalyWatch(
            self.freshness,
            self._schema,
            self.config.anomaly.after,
            service.publisher(keys.anomaly(robot.robot), Anomaly).put,
            self.clock,
            self.acquaintance,
        )
        self.update = self._make_update()
        self._solver: ModelSolver | None = None
        self.control, self.no_control = self._make_control(self.config)
        self.loops = self._make_loops()
        self._core = OneCore()
        service.watch(*self.loops)

    def _make_update(self) -> OnlineUpdate:
        return OnlineUpdate(
            self.freshness,
            self.living,
            self.config.update,
            self._learner,
            lambda: self.control is not None and self.control.engaged,
            self.service.publisher(keys.update(self.robot.robot), Update).put,
            self.clock,
            self._others_keep_time,
            lambda: self.trust.doubts,
            self.acquaintance.learned,
            1.0 / self.robot.rates.update,
        )

    def _make_trust(self) -> Trust:
        settings = self.config.trust
        config = settings.config() if settings.active else None
        return Trust(
            self.robot,
            self.freshness,
            self._schema,
            config,
            self.clock,
            self._stop_for,
            self.acquaintance.is_known,
            self._forget,
            settings.stops,
            lambda: self.hindsight.factor,
        )

    def _make_loops(self) -> list[Loop]:
        rates, estimation, anomaly = self.robot.rates, self.estimation, self.anomaly
        times = max(rates.estimation, rates.hal) / min(rates.estimation, rates.hal)
        # If the rates do not divide each other, samples come at varying phases, and the loop cannot follow them.
        waited = estimation.waited if times.is_integer() else None

        def loop(name: str, rate: float, tick: Callable[[], None], **options: Any) -> Loop:
            return Loop(name, rate, tick, self.clock, PRIORITIES[name], OFFSETS[name], **options)

        return [
            loop("estimation", rates.estimation, estimation.tick, waited=waited),
            loop("control", rates.control, self._control_tick),
            loop("anomaly", rates.anomaly, anomaly.tick),
            loop("update", rates.update, self.update.tick),
            loop("trust", min(rates.hal, TRUST_RATE), self.trust.tick),
            loop("verdict", VERDICT_RATE, self._look_back),
        ]

    def enable_hal(self) -> dict[str, Any]:
        """Ask the HAL to enable the drives, on behalf of the caller."""
        caller = CURRENT_CALLER.get()
        key = keys.verb(self.robot.robot, "hal", "enable")
        answer = query.ask(self.service.session, key, caller=lambda: self.permission.on_behalf(caller))
        self.permission.begin(caller)
        return answer

    def _forget(self, since: float) -> None:
        """Neither learn what is normal from samples after a time [s], nor judge the body by them."""
        self.update.forget(since)
        self.anomaly.forget()

    def _stop_for(self, reason: str) -> None:
        """Stop the moving robot as its robot file says, because an element that motion needs is distrusted."""
        applied = self._newest_applied()
        if self.control is not None and self.control.engaged:
            self.control.disengage(f"Stopped: {reason}")
        if applied is None or applied.mode not in LIVE_MODES:
            return
        log.warning("The robot is stopped: %s", reason)
        try:
            query.ask(self.service.session, keys.verb(self.robot.robot, "hal", "stop"))
        except (ServiceError, HalError) as error:
            log.error("The HAL did not stop the robot: %s", error)

    def status(self) -> Status:
        """Return the state and the counters."""
        fresh, values = self.freshness.take()
        missing = [name for name, value in values.items() if not np.isfinite(value).all()]
        loops = {loop.name: loop.statistics() for loop in self.loops}
        failing = [f"{loop.name}: {loop.trouble}" for loop in self.loops if loop.trouble]
        text = ""
        if fresh is None:
            text = "No fresh sample comes from the HAL. Is `gemuco hal` running?"
        elif distrusted := self.trust.text():
            text = distrusted
        elif missing:
            text = f"Estimating {', '.join(missing)}: not measured at the moment.{self._blind()}"
        elif failing:
            text = failing[0]
        else:
            text = next(filter(None, (reader.disorder(NEWS_FOR) for reader in self._readers())), "")
        return Status(
            stamp_ns=time.time_ns(),
            service="model",
            state="degraded" if text else "running",
            text=text,
            loops=loops,
            facts={
                "model_version": self.living.version,
                "camera": bool(self.robot.seen),
                "adapting": self.update.is_active,
                "update_waited": self.update.waited,
                "control": self.no_control if self.control is None else self.control.facts(),
                "late_solves": 0 if self._solver is None else self._solver.late,
                "scheduling": {loop.name: loop.scheduling for loop in self.loops},
                "core": "any" if self._core.core is None else self._core.core,
                "rejected": self._targets.counters["malformed"] + sum(reader.rejected for reader in self._readers()),
                "disordered": self._disordered(),
                "signals": self.estimation.counts(),
                "anomaly": self.anomaly.summary(),
                "trust": self.trust.facts(),
                "failing": failing,
            },
        )

    def run(self, stop: threading.Event) -> None:
        """Run the loops until `stop` is set."""
        freeze()
        for loop in self.loops:
            loop.start()
        promote_rest(NETWORK_PRIORITY)
        prepare_thread(STATUS_PRIORITY)
        try:
            with self._core:
                self.service.run(self._each_second, stop)
        finally:
            for loop in self.loops:
                loop.stop()

    def _each_second(self) -> Status:
        """Return the status, and let `OneCore` choose the core."""
        status = self.status()
        self._core.look(any(loop.is_slow for loop in self.loops))
        return status

    def _blind(self) -> str:
        """Return a hint if no fresh sample comes from the camera's process, else an empty text."""
        seen = None if self._seen is None else self._seen.last()
        longest = max((self.robot.signals[name].stale_after for name in self.robot.seen), default=0.0)
        if not self.robot.seen or (seen is not None and self.clock.monotonic() - seen.received <= longest):
            return ""
        return " No camera publishes. Is `gemuco vision` running?"

    def _publish(self, estimates: Estimates) -> None:
        self._estimates.put(estimates)
        self.history.add(estimates, self.clock.monotonic())

    def _schema(self) -> BodySchema:
        return self.living.schema

    def _others_keep_time(self) -> bool:
        """Whether estimation, control and anomaly keep their rates; if not, the update does not learn.

        The trust loop may be slow while no sensor explains what is measured: learning mends that.
        """
        return not any(loop.is_slow for loop in self.loops if PRIORITIES[loop.name] > PRIORITIES["trust"])

    def _learner(self, schema: BodySchema) -> adapt.Updater:
        config = self.config.update
        return adapt.Updater(schema, adapt.UpdateConfig(**config.model_dump(exclude={"interval"})))

    def _make_control(self, config: ModelConfig) -> tuple[Control | None, str]:
        """Make the controller; without one, return the reason."""
        if config.control is None:
            return None, f"The robot file of '{self.robot.robot}' has no model.control section."
        try:
            solver = self._solver = ModelSolver(self.living, self.robot, config.control)
        except SchemaError as error:
            return None, f"This model cannot control: {error}"
        commands = self.service.publisher(keys.command(self.robot.robot), Command)
        return (
            Control(
                self.robot, config.control, self._samples.last, self._newest_applied, self.estimation, solver,
                lambda command: commands.put(replace(command, name=self.permission.name)), self.clock, solver.judge,
            ),
            "",
        )  # fmt: skip

    def _disordered(self) -> dict[str, int]:
        """Return the numbers of messages that came `repeated` or `late`, and were not used."""
        orders = [reader.order.counters for reader in self._readers()]
        return {name: sum(counters[name] for counters in orders) for name in ("repeated", "late")}

    def _look_back(self) -> None:
        """Judge the last samples, measure the errors of the model on them, and try ways to estimate what is missing."""
        self.anomaly.judge()
        self.hindsight.look()
        self.estimation.ways.prepare()

    def _readers(self) -> list[Reader[Any]]:
        readers: list[Reader[Any] | None] = [self._samples, self._seen, self._applied]
        return [reader for reader in readers if reader is not None]

    def _newest_applied(self) -> Applied | None:
        return self._applied.get(self.robot.command.time_to_live)

    def _control_tick(self) -> None:
        if self.control is None:
            return
        self._targets.take()
        if self.control.engaged and (reason := self.permission.ended()):
            self.control.disengage(reason)
        self.control.tick()

    def _follow(self, target: Target) -> None:
        """Follow a published target."""
        if self.control is not None:
            self.control.try_target(target, self.permission.may_set)
