"""What the buttons do: a verb each, asked again and again only by a person, refused where the page is read only."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from gemuco.errors import SchemaError
from hal.errors import HalError
from services.client import Client
from services.errors import NotAllowed, ServiceError

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
    """What came of the last press: when [wall clock s], whether it was done, and a sentence."""

    at: float
    is_done: bool
    text: str


class Controls:
    """Asks the robot on behalf of whoever presses; any thread may.

    Args:
        client: Gives the open client, or None.
        read_only: Why nothing may be asked; empty if it may.
    """

    def __init__(self, client: Callable[[], Client | None], read_only: str) -> None:
        self.read_only = read_only
        self.last: Outcome | None = None
        self._client = client

    def press(self, verb: str) -> Outcome:
        """Do what a button says; what is wrong is the outcome's sentence, never raised."""
        try:
            told = self._told(verb, self._ask(verb))
            self.last = Outcome(time.time(), True, told)
        except (ServiceError, HalError, SchemaError) as error:
            self.last = Outcome(time.time(), False, f"{verb}: {error}")
        return self.last

    def open_client(self) -> Client:
        """The client, for whoever may command.

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

    @staticmethod
    def _told(verb: str, answer: dict[str, Any]) -> str:
        if verb == "estop" and not answer.get("complete", True):
            late = [one["device"] for one in answer.get("devices", ()) if not one["stopped"]]
            return f"estop: NOT COMPLETE: {', '.join(late)} did not stop. CUT THE POWER."
        mode = answer.get("mode")
        return f"{verb}: done{f', motors {mode}' if mode else ''}"
