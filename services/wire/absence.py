"""Nobody answers: who is there instead, so that an error can tell which of all things is missing."""

import zenoh

from services.wire import keys

LOOK_WITHIN = 0.5
"""How long [s] to wait for the answer of who is alive."""
STARTED_BY = {
    "simulator": "gemuco simulate",
    "hal": "gemuco hal",
    "vision": "gemuco vision",
    "model": "gemuco serve",
    "recorder": "gemuco record",
}


def who_is_there(session: zenoh.Session, robot: str = "*", timeout: float = LOOK_WITHIN) -> dict[str, set[str]]:
    """Robot -> names of its services that this session can see now."""
    found: dict[str, set[str]] = {}
    for reply in session.liveliness().get(keys.alive(robot, "*"), timeout=timeout):
        if reply.ok is not None:
            name, service, _ = keys.parse(str(reply.ok.key_expr))
            found.setdefault(name, set()).add(service)
    return found


def starter(service: str) -> str:
    """What starts a service."""
    return f"`{STARTED_BY[service]}`" if service in STARTED_BY else f"the '{service}' service"


def instead(session: zenoh.Session, robot: str) -> str:
    """A sentence with a space before it: what else is there; empty if there is nothing to tell."""
    if not session.info.transports():
        return " At the moment this program is linked with nobody: no router, and no service of the robot."
    there = who_is_there(session, robot)  # a role may not see other robots
    if robot in there:
        return f" Of this robot there is: {', '.join(sorted(there[robot]))}."
    if others := sorted(who_is_there(session)):
        return f" There is no robot '{robot}'; there is: {', '.join(others)}."
    return " The router is there, and no robot."
