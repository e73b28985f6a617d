"""The emergency stop of a program that is not connected yet."""

import logging
from collections.abc import Iterable
from typing import Any

from services.client.client import SLOW_TIMEOUT, Client
from services.client.link import Link
from services.errors import ServiceError
from services.wire.member import emergency_endpoints
from services.wire.roles import ESTOP
from services.wire.session import CLIENT, settings

log = logging.getLogger(__name__)


def emergency_stop(robot: str, reason: str = "", connect: Iterable[str] = ()) -> dict[str, Any]:
    """Stop every drive of a robot, like `Client.estop`.

    With a role file the request goes to the router's port for emergency stops, at which no viewer and no other request
    is admitted; if that fails, the usual way follows.

    Raises:
        ServiceError: No way leads to the HAL, or it does not answer.
    """
    items = (connect,) if isinstance(connect, str) else tuple(connect)
    if emergency_endpoints(settings(robot, CLIENT, items)):
        link = Link(robot, items)
        try:
            link.open(is_emergency=True)
            return link.ask(*ESTOP, {"reason": reason}, SLOW_TIMEOUT)
        except ServiceError as error:
            log.warning("The port for emergency stops did not help, so the usual one is tried: %s", error)
        finally:
            link.close()
    with Client(robot, items) as client:
        return client.estop(reason)
