"""The buttons of the page: one verb each, refused where the page is read only."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from gemuco.errors import SchemaError
from hal.errors import HalError
from services.client import Client
from services.errors import NotAllowed, ServiceError
from services.wire.member import Member
from services.wire.session import is_loopback

Ask = Callable[[Client], dict[str, Any]]

VERBS: dict[str, Ask] = {
    "engage": lambda client: client.engage(),
    "disengage": lambda client: client.disengage(),
    "stop": lambda client: client.stop(),
    "reset": lambda client: client.reset(),
    "estop": lambda client: client.estop("The emergency stop button of the page was pressed."),
}


@dataclass(frozen=True, slots=True)
class Outcome:
    """Result of the last press.

    Attributes:
        at: Time of the press [wall clock s].
        is_done: Whether the service did it.
        text: Result in one sentence.
    """

    at: float
    is_done: bool
    text: str


class Controls:
    """Sender of the requests of the buttons, for any thread.

    Args:
        client: Function that returns the open client, or None.
        read_only: Reason why the page may request nothing; empty if it may.
    """

    def __init__(self, client: Callable[[], Client | None], read_only: str) -> None:
        self.read_only = read_only
        self.last: Outcome | None = None
        self._client = client

    def press(self, verb: str) -> Outcome:
        """Do the verb of a button; an error is the text of the outcome, never raised."""
        try:
            self.last = Outcome(time.time(), True, _in_words(verb, self._ask(verb)))
        except (ServiceError, HalError, SchemaError) as error:
            self.last = Outcome(time.time(), False, f"{verb}: {error}")
        return self.last

    def replay(self, verb: str, **arguments: Any) -> Outcome:
        """Do a verb of a replay, such as `pause`; an error is the text of the outcome, never raised."""
        try:
            answer = self.open_client().ask("hal", verb, arguments)
            self.last = Outcome(time.time(), True, f"{verb}: at {answer['position']:.2f} s")
        except (ServiceError, HalError, SchemaError) as error:
            self.last = Outcome(time.time(), False, f"{verb}: {error}")
        return self.last

    def open_client(self) -> Client:
        """Return the client, for requests that may move the robot.

        Raises:
            NotAllowed: This page is read only.
            ServiceError: There is no connection.
        """
        if self.read_only:
            raise NotAllowed(self.read_only)
        client = self._client()
        if client is None:
            raise ServiceError("There is no connection to the robot.")
        return client

    def _ask(self, verb: str) -> dict[str, Any]:
        if verb not in VERBS:
            raise ServiceError(f"There is no button '{verb}'. Buttons: {', '.join(VERBS)}.")
        return VERBS[verb](self.open_client())


def _in_words(verb: str, answer: dict[str, Any]) -> str:
    if verb == "estop" and not answer.get("complete", True):
        late = [device["device"] for device in answer.get("devices", ()) if not device["stopped"]]
        return f"estop: NOT COMPLETE: {', '.join(late)} did not stop. CUT THE POWER."
    mode = answer.get("mode")
    return f"{verb}: done{f', motors {mode}' if mode else ''}"


def why_read_only(member: Member, robot: str, host: str) -> str:
    """Return the reason why the page has no buttons, in one sentence; empty if it has buttons.

    Only an operator has buttons, and only where no other person can reach the page.
    """
    if not member.is_for(robot):
        return f"Read only: the role file is for {', '.join(member.robots) or 'no robot'}, not for '{robot}'."
    if not member.may_publish(robot, "hal/command") or not member.may_ask(robot, "hal", "enable"):
        return f"Read only: the role is {member.role}, not operator."
    if not is_loopback(host):
        return f"Read only: the page is served on {host} to everyone; there are buttons on 127.0.0.1 only."
    return ""
