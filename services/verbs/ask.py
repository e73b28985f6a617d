"""`gemuco query`: one question to a running robot, answered as text."""

import json
import time
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import typer

from services.client import SLOW_TIMEOUT, Client
from services.errors import NoAnswer, RemoteError, ServiceError
from services.wire import keys

PLAIN = {
    "enable": "hal",
    "disable": "hal",
    "stop": "hal",
    "reset": "hal",
    "engage": "model",
    "disengage": "model",
    "rollback": "model",
    "normal": "model",
}
VERBS = (
    "estimate",
    "anomaly",
    "control",
    "simulate",
    "target",
    "adapt",
    "describe",
    "fault",
    "home",
    "tare",
    "holder",
    *PLAIN,
)
WATCH_EVERY = 1.0
CONNECTS_WITHIN = 0.5
"""Time [s] that connections to running services take at most."""


class BadQuestion(ServiceError):
    """The command line asks something that cannot be asked."""


def ask_robot(
    robot: str, verb: str, words: Sequence[str], hide: Sequence[str], watch: bool, connect: Iterable[str]
) -> int:
    """Ask, print the answer, return the exit code.

    Raises:
        BadQuestion: An unknown verb, or words that the verb does not take.
        NoAnswer: Nobody answers, or nobody who may, or not in time.
    """
    if verb not in VERBS:
        raise BadQuestion(f"'{verb}' is not something to ask. Known: {', '.join(VERBS)}.")
    with Client(robot, connect) as client:
        if verb == "estimate":
            signal = _one(verb, words, "a signal, such as joint_position")
            if watch:
                return _watch(client, signal, hide)
            typer.echo(line_of(_estimate(client, signal, hide)))
            return 0
        for key, value in _answer(client, verb, words, hide).items():
            typer.echo(f"{key}: {value if isinstance(value, str) else json.dumps(value)}")
    return 0


def line_of(answer: dict[str, Any]) -> str:
    """An estimate in one line: elements with values, and where they come from."""
    unit, std = answer["unit"], np.asarray(answer["std"], float)
    values = "  ".join(
        f"{name} {value:+.3f}{'*' if guessed else ''}"
        for name, value, guessed in zip(answer["elements"], answer["values"], answer["estimated"], strict=True)
    )
    if answer["method"] == "measured":
        return f"{answer['signal']} [{unit}]  {values}  measured"
    if answer["method"] == "none":
        return f"{answer['signal']} [{unit}]  {values}  neither measured nor estimable"
    spread = float(np.sqrt(np.mean(std[np.asarray(answer["estimated"], bool)] ** 2)))
    source = answer["mask"].replace("+", ", ") or "single elements"
    error = f"{spread:.3f} {unit}" if np.isfinite(spread) else "unknown"
    return f"{answer['signal']} [{unit}]  {values}  * estimated from {source}, expected error {error}"


def _estimate(client: Client, signal: str, hide: Sequence[str]) -> dict[str, Any]:
    return client.ask("model", "estimate", {"signal": signal, "hide": list(hide)})


def _watch(client: Client, signal: str, hide: Sequence[str]) -> int:
    """Print an estimate each second, through whatever happens to the service, until Ctrl-C."""
    while True:
        try:
            typer.echo(line_of(_estimate(client, signal, hide)))
        except NoAnswer as error:
            typer.echo(str(error))
        time.sleep(WATCH_EVERY)


def _answer(client: Client, verb: str, words: Sequence[str], hide: Sequence[str]) -> dict[str, Any]:
    if verb in ("target", "control"):
        if len(words) < 2:
            raise BadQuestion(f"'{verb}' needs a signal and a value per element: {verb} joint_position 0 0 0 -0.6 0")
        values = _numbers(verb, words[1:], "after the signal")
        if verb == "control":
            return client.control({words[0]: values})
        return client.ask("model", "target", {"signal": words[0], "values": values})
    if verb == "simulate":
        if not words:
            raise BadQuestion("'simulate' needs a command, a value per element of the commanded signal.")
        return client.simulate([_numbers(verb, words, "only")])
    if verb == "adapt":
        switch = _one(verb, words, "on or off")
        if switch not in ("on", "off"):
            raise BadQuestion(f"'adapt' takes on or off, not '{switch}'.")
        return client.adapt(switch == "on")
    if verb == "fault":
        if not words:
            raise BadQuestion("'fault' needs to be told what to break: fault muscle_cut biceps")
        return _fault(client, " ".join(words))
    if verb == "home":
        return client.home(_one(verb, words, "the name of a drive"))
    if verb == "tare":
        return client.tare(_one(verb, words, "the name of a sensor"))
    if verb == "describe":
        service = words[0] if words else ""
        if service not in ("", *keys.SERVICES):
            raise BadQuestion(f"'{service}' is not a service. Known services: {', '.join(keys.SERVICES)}.")
        return client.describe(service)
    if words:
        raise BadQuestion(f"'{verb}' takes nothing more, but got '{' '.join(words)}'.")
    if verb == "holder":
        held = client.holder()
        return {"holder": held.name or "nobody", "left": round(held.left, 1)}
    if verb == "anomaly":
        return client.ask("model", "anomaly", {"hide": list(hide)}, SLOW_TIMEOUT)
    return client.ask(PLAIN[verb], verb)


def _numbers(verb: str, words: Sequence[str], where: str) -> list[float]:
    try:
        return [float(word) for word in words]
    except ValueError:
        raise BadQuestion(f"'{verb}' takes numbers {where}, not '{' '.join(words)}'.") from None


def _fault(client: Client, text: str) -> dict[str, Any]:
    """Break what the camera's process plays, or else the simulator, which may know the same name and not be watched."""
    told = ""
    if _is_alive(client, "vision"):
        try:
            return client.fault(text, "vision")
        except (RemoteError, NoAnswer) as error:
            told = str(error)
    try:
        return client.fault(text)
    except RemoteError as error:
        raise RemoteError(f"{error} {told}".rstrip()) from None


def _is_alive(client: Client, service: str) -> bool:
    """Whether a service runs; a client that was just opened is not connected at once."""
    deadline = time.monotonic() + CONNECTS_WITHIN
    while service not in client.alive():
        if time.monotonic() > deadline:
            return False
        time.sleep(0.02)
    return True


def _one(verb: str, words: Sequence[str], what: str) -> str:
    if len(words) != 1:
        raise BadQuestion(f"'{verb}' needs {what}, and nothing else; it got {len(words)} words.")
    return words[0]
