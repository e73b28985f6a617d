"""Description of a robot in one answer, joined from the descriptions of its services."""

import time
from typing import Any

from services.client.link import Link
from services.errors import NotAllowed, ServiceError, ServiceUnavailable
from services.wire.messages import VERSION
from services.wire.query import describe_presence, starter

DESCRIBING = ("hal", "model")
"""These services describe the robot: the HAL its hardware and limits, the model its signals and masks."""
CONNECTS_WITHIN = 0.5
"""Connections to running services take at most this time [s]."""
OF_HAL = ("description", "command", "limits", "devices")
OF_MODEL = ("x_in", "x_out", "masks", "controls")


def of(link: Link, timeout: float) -> dict[str, Any]:
    """Query every live service and join the descriptions; `missing` names the absent ones and the reasons.

    Raises:
        ServiceUnavailable: No service of this robot runs.
        NotAllowed: This client's role may not query `describe`.
    """
    begun = time.monotonic()
    while not {*DESCRIBING} <= (alive := link.alive()) and time.monotonic() - begun < min(timeout, CONNECTS_WITHIN):
        time.sleep(0.02)
    if not alive:
        raise ServiceUnavailable(
            f"Robot '{link.robot}' has no service now.{describe_presence(link.session, link.robot)}"
        )
    described: dict[str, dict[str, Any]] = {}
    missing = {name: f"there is no '{name}' service. Is {starter(name)} running?" for name in DESCRIBING}
    for service in sorted(alive):
        try:
            described[service] = link.ask(service, "describe", timeout=max(0.1, begun + timeout - time.monotonic()))
            missing.pop(service, None)
        except NotAllowed:
            raise
        except ServiceError as error:
            missing[service] = str(error)
    return _joined(link.robot, described, missing)


def _joined(robot: str, described: dict[str, dict[str, Any]], missing: dict[str, str]) -> dict[str, Any]:
    hal, model = described.get("hal", {}), described.get("model", {})
    joined: dict[str, Any] = {"robot": robot}
    joined |= {name: hal[name] for name in OF_HAL if name in hal}
    joined["signals"] = _signals(hal.get("signals", {}), model.get("signals", {}))
    joined |= {name: model[name] for name in OF_MODEL if name in model}
    joined["conditions"] = model.get("conditions", hal.get("conditions", []))
    joined["rates"] = hal.get("rates", model.get("rates", {}))
    joined["versions"] = {
        "wire": VERSION,
        "package": {service: part["package"] for service, part in described.items() if "package" in part},
        "model": model.get("model_version"),
    }
    joined["services"] = {
        service: {name: part[name] for name in ("host", "pid", "boot") if name in part}
        for service, part in described.items()
    }
    joined["missing"] = [f"'{service}' gives no description: {text}" for service, text in sorted(missing.items())]
    return joined


def _signals(of_hal: dict[str, Any], of_model: dict[str, Any]) -> dict[str, Any]:
    """Return unit, elements and source of every signal, and whether the model has it."""
    names = dict.fromkeys((*of_hal, *of_model))
    return {name: {**of_hal.get(name, {}), **of_model.get(name, {}), "is_in_model": name in of_model} for name in names}
