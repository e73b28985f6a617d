"""The verbs of the model service."""

from collections.abc import Mapping
from functools import wraps
from typing import Any

import numpy as np

from gemuco.anomaly.score import score
from gemuco.estimation import fill
from gemuco.masks import label
from gemuco.schema import BodySchema
from services.errors import BadArguments, NotEngaged
from services.model.control_config import controller_of, simulator_of
from services.model.control_loop import Control
from services.model.estimation import widened
from services.model.gemuco_service import PRIORITIES, GemucoService
from services.model.ways import Ways
from services.process.realtime import at_most
from services.process.service import Service
from services.wire.caller import Caller
from services.wire.messages import Target
from services.wire.plain_text import shown
from services.wire.query import Guard, Handler

MOST_STEPS = 200
"""A query may simulate at most this many commands; a step takes about 10 ms."""


def below_loops(handler: Handler) -> Handler:
    """Return a handler of a verb that computes for long, at the lowest priority of a loop.

    Queries arrive in threads of the network, whose priority is above that of the loops: computing there would delay
    every estimate.
    """

    @wraps(handler)
    def answer(arguments: dict[str, Any]) -> Any:
        with at_most(min(PRIORITIES.values())):
            return handler(arguments)

    return answer


class ModelVerbs:
    """The handlers of `gemuco/<robot>/model/do/...`; each takes and returns a map."""

    def __init__(self, service: GemucoService) -> None:
        self._service = service

    def handlers(self) -> dict[str, Handler]:
        """Return verb -> handler; `describe` comes with every service."""
        return {
            "estimate": self.estimate,
            "control": below_loops(self.solve),
            "simulate": below_loops(self.simulate),
            "anomaly": self.anomaly,
            "history": self.history,
            "engage": self.engage,
            "disengage": self.disengage,
            "target": self.target,
            "adapt": self.adapt,
            "rollback": self.rollback,
            "normal": below_loops(self.normal),
            "trust": self.trust,
            "distrust": self.distrust,
        }

    def serve(self, service: Service) -> None:
        """Answer all verbs. A verb that changes the motion needs permission; `disengage` is open to every client."""
        permission = self._service.permission
        guards: dict[str, Guard] = dict.fromkeys(("adapt", "rollback", "normal", "trust", "distrust"), self._may_change)
        guards |= {"engage": permission.may_move, "target": permission.may_move}
        for name, handler in self.handlers().items():
            service.verb(name, handler, guards.get(name), always=name == "disengage")
        service.describe = self.describe

    def _may_change(self, caller: Caller) -> None:
        """Raise unless the caller may change the model; while engaged, a new model moves the robot."""
        control, permission = self._service.control, self._service.permission
        (permission.may_move if control is not None and control.engaged else permission.check)(caller)

    def describe(self) -> dict[str, Any]:
        """Return the model's signals, conditions, masks, rates and version."""
        schema, robot, control = self._service.living.schema, self._service.robot, self._service.config.control
        return {
            "signals": {s.name: {"unit": s.unit, "elements": list(s.elements)} for s in schema.layout.signals},
            "x_in": list(schema.x_in),
            "x_out": list(schema.x_out),
            "conditions": list(schema.biases),
            "biases": {name: np.asarray(bias, float) for name, bias in schema.biases.items()},
            "masks": [label(mask, schema.layout.names) for mask in schema.masks],
            "rates": robot.rates.model_dump(),
            "controls": control.target if control and self._service.control else "",
            "model_version": self._service.living.version,
            "manifest": dict(schema.manifest),
        }

    def estimate(self, arguments: Mapping[str, Any]) -> dict[str, Any]:
        """Estimate one signal or all from the newest sample or from given values, without the hidden signals."""
        _only(arguments, "signal", "values", "hide")
        schema = self._service.living.schema
        if not isinstance(arguments.get("signal", ""), str):
            raise BadArguments(f"'signal' must be a name. Known signals: {', '.join(schema.layout.names)}.")
        values, cycle = self._values(arguments)
        reasons = {} if arguments.get("values") is not None else dict(self._service.freshness.distrust.reasons)
        facts = {"cycle": cycle, "model_version": self._service.living.version, "distrusted": reasons}
        factor, ways = self._service.hindsight.factor, self._service.estimation.ways
        if "signal" in arguments:
            signal = schema.layout.signal(arguments["signal"])
            return _estimates(schema, ways, values, factor)[signal.name] | facts
        return {"signals": _estimates(schema, ways, values, factor)} | facts

    def solve(self, arguments: Mapping[str, Any]) -> dict[str, Any]:
        """Return the command for a target by the robot file's loss; the robot does not move."""
        _only(arguments, "target", "values")
        service, schema = self._service, self._service.living.schema
        if service.config.control is None:
            raise NotEngaged(service.no_control)
        target = _signals(arguments.get("target"), "target")
        now, cycle = self._values({"values": arguments.get("values")})
        solution = controller_of(schema, service.robot, service.config.control).solve(target, now)
        signal = schema.layout.signal(service.robot.command.signal)
        return {
            "signal": signal.name,
            "unit": signal.unit,
            "elements": list(signal.elements),
            "values": solution.command,
            "predicted": solution.predicted,
            "loss": solution.loss,
            "residual": solution.residual,
            "route": solution.route,
            "mask": label(solution.mask, schema.layout.names),
            "cycle": cycle,
            "model_version": service.living.version,
        }

    def simulate(self, arguments: Mapping[str, Any]) -> dict[str, Any]:
        """Return the states that successive commands lead to, under the robot file's constraints."""
        _only(arguments, "commands", "given", "values")
        service, schema = self._service, self._service.living.schema
        commands = arguments.get("commands")
        if not isinstance(commands, list) or not 1 <= len(commands) <= MOST_STEPS:
            signal = service.robot.command.signal
            raise BadArguments(f"'commands' must be a list of 1 to {MOST_STEPS} commands of '{signal}'.")
        given = _signals(arguments.get("given") or {}, "given")
        now, _ = self._values({"values": arguments.get("values")})
        simulator = simulator_of(schema, service.robot, service.config.simulation)
        steps = list(simulator.run([_numbers(command, "commands") for command in commands], given, now))
        return {
            "states": {name: np.stack([step.values[name] for step in steps]) for name in steps[0].values},
            "loss": [step.loss for step in steps],
            "residual": [step.residual for step in steps],
            "route": steps[0].route,
            "mask": label(steps[0].mask, schema.layout.names),
            "model_version": service.living.version,
        }

    def anomaly(self, arguments: Mapping[str, Any]) -> dict[str, Any]:
        """Score the newest sample or given values, without the hidden signals."""
        _only(arguments, "values", "hide")
        values, cycle = self._values(arguments)
        anomaly = score(self._service.living.schema, values)
        return {
            "score": anomaly.score,
            "threshold": anomaly.threshold,
            "is_anomaly": anomaly.is_anomaly,
            "blamed": anomaly.blamed,
            "contribution": anomaly.contribution,
            "cycle": cycle,
            "model_version": self._service.living.version,
        }

    def history(self, arguments: Mapping[str, Any]) -> dict[str, Any]:
        """Return a page of the estimates of the last seconds."""
        _only(arguments, "seconds", "signals", "begin", "end")
        service = self._service
        return service.history.answer(arguments, service.service.boot, service.clock.monotonic())

    def engage(self, arguments: Mapping[str, Any]) -> dict[str, Any]:
        """Engage the controller at the present posture, and ask the HAL to enable."""
        _only(arguments)
        control = self._control()
        if refusal := self._service.trust.refusal():
            raise NotEngaged(f"{refusal} Repair it, or run `gemuco query ROBOT trust ELEMENT`.")
        control.engage(self._service.enable_hal)
        return control.facts()

    def disengage(self, arguments: Mapping[str, Any]) -> dict[str, Any]:
        """Stop commanding; the HAL then holds, and disables."""
        control = self._control()
        control.disengage()
        return control.facts()

    def target(self, arguments: Mapping[str, Any]) -> dict[str, Any]:
        """Set a target; a refusal is the reply."""
        _only(arguments, "signal", "values")
        control = self._control()
        values = _numbers(arguments.get("values"), "values")
        control.set_target(Target(signal=str(arguments.get("signal", "")), values=values))
        return control.facts()

    def adapt(self, arguments: Mapping[str, Any]) -> dict[str, Any]:
        """Start or stop the online update of W."""
        _only(arguments, "active")
        if not isinstance(arguments.get("active"), bool):
            raise BadArguments("'adapt' needs active: true or false.")
        self._service.update.adapt(arguments["active"])
        return {"active": self._service.update.is_active, "model_version": self._service.living.version}

    def rollback(self, arguments: Mapping[str, Any]) -> dict[str, Any]:
        """Stop the update and restore the model before it began."""
        _only(arguments)
        return {"active": False, "model_version": self._service.update.rollback()}

    def normal(self, arguments: Mapping[str, Any]) -> dict[str, Any]:
        """Learn what is normal from the samples since the model last changed."""
        _only(arguments)
        samples = self._service.update.learn_normal()
        normal = self._service.living.schema.normal
        if normal is None:
            return {"samples": samples, "threshold": None}
        facts = {"threshold": normal.threshold, "false_alarm": normal.false_alarm, "at_most": normal.bound}
        return {"samples": samples, **facts, "text": normal.trust}

    def trust(self, arguments: Mapping[str, Any]) -> dict[str, Any]:
        """Use an element as measured again; it is not hidden again before it has agreed with the others once."""
        _only(arguments, "element")
        self._service.trust.trust(str(arguments.get("element", "")))
        return self._service.trust.facts()

    def distrust(self, arguments: Mapping[str, Any]) -> dict[str, Any]:
        """Hide a measured element, which is then estimated, until `trust`."""
        _only(arguments, "element")
        self._service.trust.distrust(str(arguments.get("element", "")))
        return self._service.trust.facts()

    def _control(self) -> Control:
        if self._service.control is None:
            raise NotEngaged(self._service.no_control)
        return self._service.control

    def _values(self, arguments: Mapping[str, Any]) -> tuple[dict[str, np.ndarray], int]:
        """Return the values without the hidden ones, and their cycle; -1 if they were given or nothing is fresh."""
        given, cycle = arguments.get("values"), -1
        if given is None:
            fresh, newest = self._service.freshness.take()
            values, cycle = dict(newest), -1 if fresh is None else fresh.message.cycle
        else:
            values = _signals(given, "values")
        hidden = arguments.get("hide") or []
        if not isinstance(hidden, list) or not all(isinstance(name, str) for name in hidden):
            raise BadArguments("'hide' must be a list of names of signals.")
        for name in hidden:
            self._service.living.schema.layout.slice(name)
            values.pop(name, None)
        return values, cycle


def _estimates(
    schema: BodySchema, ways: Ways, values: Mapping[str, np.ndarray], factor: np.ndarray
) -> dict[str, dict[str, Any]]:
    joined = schema.layout.join_one(values)
    joined.setflags(write=False)
    recipe = ways.best(schema, np.isfinite(joined))
    completion, expected, residual, sureness, _ = fill(schema, joined, recipe)
    expected, sureness = expected * factor, widened(schema, sureness, recipe.estimated, factor)
    value, std, estimated = completion.tolist(), expected.tolist(), recipe.estimated.tolist()
    return {
        signal.name: {
            "signal": signal.name,
            "unit": signal.unit,
            "elements": list(signal.elements),
            "values": value[span],
            "std": std[span],
            "estimated": estimated[span],
            "method": recipe.method[signal.name],
            "mask": recipe.label[signal.name],
            "residual": residual[signal.name],
            "state": sureness[signal.name].state,
            "reason": sureness[signal.name].reason,
        }
        for signal, span in zip(schema.layout.signals, schema.layout.slices.values(), strict=True)
    }


def _only(arguments: Mapping[str, Any], *known: str) -> None:
    for name in sorted(set(arguments) - set(known)):
        raise BadArguments(f"Unknown argument {shown(name)}. Known arguments: {', '.join(known) or 'none'}.")


def _numbers(value: Any, name: str) -> np.ndarray:
    try:
        array = np.asarray(value, float)
    except (TypeError, ValueError, OverflowError, RecursionError):
        array = np.zeros((0, 0))
    if array.ndim != 1:
        raise BadArguments(f"'{name}' must be a list of numbers.")
    return array


def _signals(value: Any, name: str) -> dict[str, np.ndarray]:
    if not isinstance(value, dict) or not all(isinstance(signal, str) for signal in value):
        raise BadArguments(f"'{name}' must be a map from signal to a list of numbers.")
    return {signal: _numbers(numbers, signal) for signal, numbers in value.items()}
