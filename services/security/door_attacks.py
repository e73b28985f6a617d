"""Attacks on the doors of the router: too many sessions, foreign doors, and a service that stands for the router."""

import time
from collections.abc import Iterator
from typing import Any

from services.security.attacks import FORGED, REPEATS, Attempt, allowed, refused
from services.security.check_sessions import PAUSE, PAYLOAD, CheckSessions, Listener, answer, answered, until
from services.security.role_files import PERSON_SESSIONS
from services.wire.connect import merge
from services.wire.member import EMERGENCY
from services.wire.roles import ESTOP, ROUTER
from services.wire.session import common_settings

MORE = 8
"""The attack opens this number of sessions more than are allowed."""


def at_the_doors(sessions: CheckSessions, operator: str, viewer: str) -> Iterator[Attempt]:
    """Fill the door of a viewer, and try the doors of others meanwhile."""
    opened = 0
    while opened < PERSON_SESSIONS + MORE and sessions.enters(sessions.outside(viewer)):
        opened += 1
    text = f"{opened} opened" if opened else "its door is full"
    yield refused(f"viewer opens {PERSON_SESSIONS + MORE} sessions", opened <= PERSON_SESSIONS, text)
    yield allowed("operator connects meanwhile", sessions.enters(sessions.outside(operator)))
    for name, door in ((operator, "the operator's port"), (EMERGENCY, "the port for emergency stops")):
        outside = sessions.outside(viewer, sessions.door_of(name))
        yield refused(f"viewer at {door}", not sessions.enters(outside))
    if sessions.is_running:
        yield Attempt("operator stops the robot meanwhile", "not tried", "it would stop the running robot")
        return
    key = sessions.key(ESTOP[0], "do", ESTOP[1])
    stopping = answer(sessions.hal_session, key, b"stopped")
    stopper = sessions.member(operator, sessions.door_of(EMERGENCY))
    works = until(lambda: answered(stopper, key, b"stopped"))
    yield allowed("operator stops the robot meanwhile, at the port for emergency stops", works)
    stopping.undeclare()
    heard = Listener(sessions.hal_session, sessions.key("hal", "command"))
    honest = sessions.member(operator)
    for _ in range(REPEATS):
        stopper.put(sessions.key("hal", "command"), FORGED)
        time.sleep(PAUSE)
    works = until(lambda: honest.put(sessions.key("hal", "command"), PAYLOAD) is None and heard.count(PAYLOAD))
    yield allowed("operator commands at the own port", works)
    yield refused("operator commands at the port for emergency stops", not heard.count(FORGED))


def in_the_routers_place(sessions: CheckSessions, operator: str) -> Iterator[Attempt]:
    """Stand for the router with the certificate of a service, which may name the same address."""
    where = sessions.another_endpoint()
    service = sessions.of(f"hal.{sessions.robot}")
    fake = merge(common_settings(), {"mode": ROUTER, "listen": {"endpoints": [where]}})
    # A router that admits everyone: it is given the password, because zenoh's router refuses an unknown one.
    login = sessions.of(operator)["transport"]["auth"]["usrpwd"]
    auth = {"usrpwd": {"dictionary": {login["user"]: login["password"]}}}
    fake = merge(fake, {"transport": {"link": service["transport"]["link"], "auth": auth}})
    impostor = sessions.open(fake)
    spy = Listener(impostor, sessions.key("**"))
    person = sessions.weakened(operator, "person")
    person["connect"] |= {"endpoints": [where], "timeout_ms": 2000, "exit_on_failure": True}
    if not sessions.enters(person):
        yield refused("a service in the router's place", True, "the connection was refused")
        return
    victim = sessions.last
    listener = Listener(victim, sessions.key("hal", "status"))
    exchanged = until(lambda: _exchanges(sessions, victim, impostor, spy, listener), 1.0)
    yield refused("a service in the router's place", not exchanged)


def _exchanges(sessions: CheckSessions, victim: Any, impostor: Any, spy: Listener, listener: Listener) -> bool:
    """Whether a message passes between a person and the router's impostor."""
    victim.put(sessions.key("hal", "command"), PAYLOAD)
    impostor.put(sessions.key("hal", "status"), FORGED)
    return bool(spy.count(PAYLOAD) or listener.count(FORGED))
