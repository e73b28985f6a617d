"""What the model service can be asked for, by anybody on the network."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from gemuco.masks import label
from services.control_loop import Control
from services.errors import BadArguments, NotEngaged
from services.messages import Target
from services.query import Handler

if TYPE_CHECKING:
    from services.gemuco_service import GemucoService


class ModelVerbs:
    """Handlers of `gemuco/<robot>/model/do/...`; each takes and returns a map."""

    def __init__(self, service: "GemucoService") -> None:
        self._service = service

    def handlers(self) -> dict[str, Handler]:
        """Verb -> handler; `describe` comes with every service."""
        return {
            "estimate": self.estimate,
            "engage": self.engage,
            "disengage": self.disengage,
            "target": self.target,
            "adapt": self.adapt,
            "rollback": self.rollback,
            "normal": self.normal,
        }

    def describe(self) -> dict[str, Any]:
        """What the model is about."""
        schema, robot, control = self._service.living.schema, self._service.robot, self._service.config.control
        return {
            "signals": {s.name: {"unit": s.unit, "elements": list(s.elements)} for s in schema.layout.signals},
            "x_in": list(schema.x_in),
            "x_out": list(schema.x_out),
            "masks": [label(mask, schema.layout.names) for mask in schema.masks],
            "rates": robot.rates.model_dump(),
            "controls": control.target if control and self._service.control else "",
            "model_version": self._service.living.version,
            "manifest": dict(schema.manifest),
        }

    def estimate(self, arguments: Mapping[str, Any]) -> dict[str, Any]:
        """Estimate one signal, from the newest sample or from given values, some of them hidden."""
        _only(arguments, "signal", "values", "hide")
        schema = self._service.living.schema
        if not isinstance(arguments.get("signal"), str):
            raise BadArguments(f"'estimate' needs a signal. Known signals: {', '.join(schema.layout.names)}.")
        signal = schema.layout.signal(arguments["signal"])
        values, cycle = self._values(arguments.get("values"))
        for name in arguments.get("hide") or []:
            schema.layout.slice(name)
            values.pop(name, None)
        found = schema.estimate(values)[signal.name]
        return {
            "signal": signal.name,
            "unit": signal.unit,
            "elements": list(signal.elements),
            "values": found.value,
            "std": found.std,
            "estimated": found.estimated,
            "method": found.method,
            "mask": label(found.mask, schema.layout.names),
            "residual": found.residual,
            "cycle": cycle,
            "model_version": self._service.living.version,
        }

    def engage(self, arguments: Mapping[str, Any]) -> dict[str, Any]:
        """Take over from where the body is, and ask the HAL to enable."""
        _only(arguments)
        control = self._control()
        control.engage(self._service.enable_hal)
        return control.facts()

    def disengage(self, arguments: Mapping[str, Any]) -> dict[str, Any]:
        """Send nothing any more; the HAL then holds, and disables."""
        _only(arguments)
        control = self._control()
        control.disengage()
        return control.facts()

    def target(self, arguments: Mapping[str, Any]) -> dict[str, Any]:
        """Set a target, and hear of it if it is refused."""
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
        """Stop the update and go back to the model before it began."""
        _only(arguments)
        return {"active": False, "model_version": self._service.update.rollback()}

    def normal(self, arguments: Mapping[str, Any]) -> dict[str, Any]:
        """Learn anew what is normal, from the samples since the model last changed."""
        _only(arguments)
        samples = self._service.update.learn_normal()
        normal = self._service.living.schema.normal
        return {"samples": samples, "threshold": None if normal is None else normal.threshold}

    def _control(self) -> Control:
        if self._service.control is None:
            raise NotEngaged(self._service.no_control)
        return self._service.control

    def _values(self, given: Any) -> tuple[dict[str, np.ndarray], int]:
        """What to estimate from, and the cycle it is of; -1 when it was given or nothing is fresh."""
        if given is None:
            fresh, values = self._service.freshness.take()
            return values, -1 if fresh is None else fresh.sample.cycle
        if not isinstance(given, dict):
            raise BadArguments("'values' must be a map from signal to a list of numbers.")
        return {name: _numbers(value, name) for name, value in given.items()}, -1


def _only(arguments: Mapping[str, Any], *known: str) -> None:
    for name in sorted(set(arguments) - set(known)):
        raise BadArguments(f"Unknown argument '{name}'. Known arguments: {', '.join(known) or 'none'}.")


def _numbers(value: Any, name: str) -> np.ndarray:
    try:
        array = np.asarray(value, float)
    except (TypeError, ValueError):
        array = np.zeros((0, 0))
    if array.ndim != 1:
        raise BadArguments(f"'{name}' must be a list of numbers.")
    return array
