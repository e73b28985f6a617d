"""`gemuco query` and `gemuco estop`: one request to a running robot, with a reply as text."""

import json
import time
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import typer

from services.client import SLOW_TIMEOUT, Client, emergency_stop
from services.errors import BadArguments, NoAnswer, RemoteError
from services.verbs.answers import sentence
from services.verbs.move import move
from services.wire import keys

WITHOUT_WORDS = {
    "enable": "hal",
    "disable": "hal",
    "stop": "hal",
    "reset": "hal",
    "engage": "model",
    "disengage": "model",
    "rollback": "model",
    "normal": "model",
}
"""These verbs take no arguments; the value is their service."""
VERBS = (
    "estimate",
    "anomaly",
    "control",
    "simulate",
    "target",
    "move",
    "adapt",
    "describe",
    "fault",
    "home",
    "tare",
    "trust",
    "distrust",
    "holder",
    *WITHOUT_WORDS,
)
WATCH_PERIOD = 1.0
"""`query --watch` prints an estimate once per period [s]."""
CONNECTS_WITHIN = 0.5
"""A new client connects to running services within this time [s]."""


def ask_robot(
    robot: str, verb: str, words: Sequence[str], hide: Sequence[str], watch: bool, connect: Iterable[str]
) -> int:
    """Send a request, print the reply, return the exit code.

    Raises:
        BadArguments: The verb is unknown, or does not take these words.
        NoAnswer: No permitted service answers in time.
    """
    if verb not in VERBS:
        raise BadArguments(f"'{verb}' is not a verb of query. Known: {', '.join(VERBS)}.")
    with Client(robot, connect) as client:
        if verb == "estimate":
            signal = _one(verb, words, "a signal, such as joint_position")
            if watch:
                return _watch(client, signal, hide)
            typer.echo(estimate_line(_estimate(client, signal, hide)))
            return 0
        if verb == "move":
            return move(client, *_target(verb, words))
        reply = _answer(client, verb, words, hide)
        if text := sentence(client, verb, words, reply):
            typer.echo(text)
            return 0
        for key, value in reply.items():
            typer.echo(f"{key}: {value if isinstance(value, str) else json.dumps(value)}")
    return 0


def estimate_line(reply: dict[str, Any]) -> str:
    """Format an estimate as one line: elements with values, and their source."""
    start, std = f"{reply['signal']} [{reply['unit']}]", np.asarray(reply["std"], float)
    values = "  ".join(
        f"{name} {value:+.3f}{'*' if estimated else ''}"
        for name, value, estimated in zip(reply["elements"], reply["values"], reply["estimated"], strict=True)
    )
    if reply["method"] == "measured":
        return f"{start}  {values}  measured"
    if reply["method"] == "none":
        return f"{start}  {values}  neither measured nor estimable"
    spread = float(np.sqrt(np.mean(std[np.asarray(reply["estimated"], bool)] ** 2)))
    source = reply["mask"].replace("+", ", ") or "single elements"
    error = f"{spread:.3f} {reply['unit']}" if np.isfinite(spread) else "unknown"
    state = f"; {reply['state']}: {reply['reason']}" if reply.get("reason") else ""
    reasons = [reply.get("distrusted", {}).get(f"{reply['signal']}.{name}") for name in reply["elements"]]
    causes = "".join(f"; {name} {why}" for name, why in zip(reply["elements"], reasons, strict=True) if why)
    return f"{start}  {values}  * estimated from {source}, expected error {error}{causes}{state}"


def _estimate(client: Client, signal: str, hide: Sequence[str]) -> dict[str, Any]:
    return client.ask("model", "estimate", {"signal": signal, "hide": list(hide)})


def _watch(client: Client, signal: str, hide: Sequence[str]) -> int:
    """Print an estimate each second until Ctrl-C, also across restarts of the service."""
    while True:
        try:
            typer.echo(estimate_line(_estimate(client, signal, hide)))
        except NoAnswer as error:
            typer.echo(str(error))
        time.sleep(WATCH_PERIOD)


def _answer(client: Client, verb: str, words: Sequence[str], hide: Sequence[str]) -> dict[str, Any]:
    if verb in ("target", "control"):
        signal, values = _target(verb, words)
        if verb == "control":
            return client.control({signal: values})
        return client.ask("model", "target", {"signal": signal, "values": values})
    if verb == "simulate":
        if not words:
            raise BadArguments("'simulate' needs a command: one value per element of the commanded signal.")
        return client.simulate([_numbers(verb, words, "only")])
    if verb == "adapt":
        switch = _one(verb, words, "on or off")
        if switch not in ("on", "off"):
            raise BadArguments(f"'adapt' takes on or off, not '{switch}'.")
        return client.adapt(switch == "on")
    if verb == "fault":
        if not words:
            raise BadArguments("'fault' needs a fault of the simulator: fault muscle_cut biceps")
        return _fault(client, " ".join(words))
    if verb == "home":
        return client.home(_one(verb, words, "the name of a drive"))
    if verb == "tare":
        return client.tare(_one(verb, words, "the name of a sensor"))
    if verb in ("trust", "distrust"):
        element = _one(verb, words, "an element, such as joint_position.elbow_pitch")
        return client.trust(element) if verb == "trust" else client.distrust(element)
    if verb == "describe":
        service = words[0] if words else ""
        if service not in ("", *keys.SERVICES):
            raise BadArguments(f"'{service}' is not a service. Known services: {', '.join(keys.SERVICES)}.")
        return client.describe(service)
    if words:
        raise BadArguments(f"'{verb}' takes no further words, but got '{' '.join(words)}'.")
    if verb == "holder":
        holder = client.holder()
        return {"holder": holder.name or "none", "left": round(holder.left, 1)}
    if verb == "anomaly":
        return _anomaly(client, hide)
    if verb in ("normal", "rollback"):
        return client.learn_normal() if verb == "normal" else client.rollback()
    return client.ask(WITHOUT_WORDS[verb], verb)


def _anomaly(client: Client, hide: Sequence[str]) -> dict[str, Any]:
    """Return the published judgement with its verdict; with hidden signals, or before the first, a single score."""
    now = None if hide else client.anomaly(timeout=CONNECTS_WITHIN)
    if now is None:
        return client.ask("model", "anomaly", {"hide": list(hide)}, SLOW_TIMEOUT)
    return {
        "verdict": now.verdict,
        "is_anomaly": now.is_anomaly,
        "blamed": now.blamed,
        "score": now.score,
        "threshold": now.threshold,
        "contribution": {name: values.tolist() for name, values in now.contribution.items()},
        "cycle": now.cycle,
    }


def _target(verb: str, words: Sequence[str]) -> tuple[str, list[float]]:
    """Return the signal and the values that follow a verb."""
    if len(words) < 2:
        raise BadArguments(f"'{verb}' needs a signal and one value per element: {verb} joint_position 0 0 0 -0.6 0")
    return words[0], _numbers(verb, words[1:], "after the signal")


def _numbers(verb: str, words: Sequence[str], where: str) -> list[float]:
    try:
        return [float(word) for word in words]
    except ValueError:
        raise BadArguments(f"'{verb}' takes numbers {where}, not '{' '.join(words)}'.") from None


def _fault(client: Client, text: str) -> dict[str, Any]:
    """Send a fault to the camera's process if it runs and knows the fault; otherwise to the simulator."""
    refusal = ""
    if _is_alive(client, "vision"):
        try:
            return client.fault(text, "vision")
        except (RemoteError, NoAnswer) as error:
            refusal = str(error)
    try:
        return client.fault(text)
    except RemoteError as error:
        raise RemoteError(f"{error} {refusal}".rstrip()) from None


def _is_alive(client: Client, service: str) -> bool:
    """Whether a service runs; wait until a new client has connected."""
    deadline = time.monotonic() + CONNECTS_WITHIN
    while service not in client.alive():
        if time.monotonic() > deadline:
            return False
        time.sleep(0.02)
    return True


def _one(verb: str, words: Sequence[str], what: str) -> str:
    if len(words) != 1:
        raise BadArguments(f"'{verb}' needs {what}, and nothing else, but got {len(words)} words.")
    return words[0]


def estop_robot(robot: str, reason: str, connect: Iterable[str]) -> int:
    """Request the emergency stop and print one line per drive; return 0 only if every drive stopped."""
    try:
        reply = emergency_stop(robot, reason, connect)
    except Exception as error:  # any failure must be loud
        typer.echo(f"gemuco: {error}", err=True)
        return _alarm(f"NO ANSWER of '{robot}': drives may still move. CUT THE POWER.")
    for drive in reply["devices"]:
        typer.echo(f"{drive['device']}: {drive['text']}", err=not drive["stopped"])
    if reply["text"]:
        typer.echo(f"gemuco: {reply['text']}", err=True)
    if not reply["complete"]:
        failed = ", ".join(drive["device"] for drive in reply["devices"] if not drive["stopped"])
        return _alarm(f"NOT STOPPED: {failed}. CUT THE POWER.")
    typer.echo(f"All {len(reply['devices'])} drives stopped. To end the fault: `gemuco query {robot} reset`.")
    return 0


def _alarm(text: str) -> int:
    typer.secho(f"\a*** {text} ***", err=True, fg=typer.colors.WHITE, bg=typer.colors.RED, bold=True)
    return 1
