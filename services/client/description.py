"""What a robot is, in one answer, put together from what its services tell of themselves."""

import time
from typing import Any

from services.client.link import Link
from services.errors import NotAllowed, ServiceError, ServiceUnavailable
from services.wire.absence import instead, starter
from services.wire.messages import VERSION

TELLERS = ("hal", "model")
"""Who knows what: the HAL the hardware and its limits, the model what can be inferred from what."""
CONNECTS_WITHIN = 0.5
"""Time [s] that connections to running services take at most."""
OF_HAL = ("description", "command", "limits", "devices")
OF_MODEL = ("x_in", "x_out", "masks", "controls")


def of(link: Link, timeout: float) -> dict[str, Any]:
    """Ask every service that is alive, and join what they tell; `missing` says what could not be told and why.

    Raises:
        ServiceUnavailable: No service of this robot is there.
        NotAllowed: This client's role may not ask.
    """
    begun = time.monotonic()
    while not {*TELLERS} <= (alive := link.alive()) and time.monotonic() - begun < min(timeout, CONNECTS_WITHIN):
        time.sleep(0.02)
    if not alive:
        raise ServiceUnavailable(f"Robot '{link.robot}' has no service now.{instead(link.session, link.robot)}")
    told: dict[str, dict[str, Any]] = {}
    missing = {name: f"there is no '{name}' service. Is {starter(name)} running?" for name in TELLERS}
    for service in sorted(alive):
        try:
            told[service] = link.ask(service, "describe", timeout=max(0.1, begun + timeout - time.monotonic()))
            missing.pop(service, None)
        except NotAllowed:
            raise
        except ServiceError as error:
            missing[service] = str(error)
    return _joined(link.robot, told, missing)


def _joined(robot: str, told: dict[str, dict[str, Any]], missing: dict[str, str]) -> dict[str, Any]:
    hal, model = told.get("hal", {}), told.get("model", {})
    found: dict[str, Any] = {"robot": robot}
    found |= {name: hal[name] for name in OF_HAL if name in hal}
    found["signals"] = _signals(hal.get("signals", {}), model.get("signals", {}))
    found |= {name: model[name] for name in OF_MODEL if name in model}
    found["conditions"] = model.get("conditions", hal.get("conditions", []))
    found["rates"] = hal.get("rates", model.get("rates", {}))
    found["versions"] = {
        "wire": VERSION,
        "package": {service: one["package"] for service, one in told.items() if "package" in one},
        "model": model.get("model_version"),
    }
    found["services"] = {
        service: {name: one[name] for name in ("host", "pid", "boot") if name in one} for service, one in told.items()
    }
    found["missing"] = [f"Of '{service}' nothing is told: {text}" for service, text in sorted(missing.items())]
    return found


def _signals(of_hal: dict[str, Any], of_model: dict[str, Any]) -> dict[str, Any]:
    """Unit, elements and source of every signal, and whether the model knows it."""
    names = dict.fromkeys((*of_hal, *of_model))
    return {name: {**of_hal.get(name, {}), **of_model.get(name, {}), "is_in_model": name in of_model} for name in names}
