"""Answers of a robot to `gemuco query` as sentences: what happens now, or why nothing does."""

import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from services.client import Client

ENABLED_WITHIN = 5.0
"""The drives report that they are enabled, or their fault, within this time [s]."""
LIVE = ("hold", "follow")
"""In these modes the drives have power and hold or follow."""

Reply = Mapping[str, Any]


def sentence(client: Client, verb: str, words: Sequence[str], reply: Reply) -> str | None:
    """Return the answer to a verb as a sentence; None for an answer that is data."""
    make = SENTENCES.get(verb)
    return None if make is None else make(client, words, reply)


def _enable(client: Client, words: Sequence[str], reply: Reply) -> str:
    mode = wait_for_mode(client, (*LIVE, "fault"))
    if mode in LIVE:
        hold = client.describe("hal")["command"]["hold"]
        return (
            f"The drives are enabled and hold their position. They switch off after {hold:g} s, because no client "
            f"commands them: `gemuco query {client.robot} move SIGNAL V1 V2 ...` moves them, `engage` lets the model."
        )
    return (
        f"The drives are not enabled: the mode is '{mode}'. {fault_text(client) or str(reply.get('fault', ''))}".strip()
    )


def _engage(client: Client, words: Sequence[str], reply: Reply) -> str:
    target = client.describe("model")["controls"]
    mode = wait_for_mode(client, (*LIVE, "fault"))
    if mode not in LIVE:
        return (
            f"The controller is engaged, but nothing moves: the mode of the drives is '{mode}'. {fault_text(client)}"
        ).strip()
    return (
        f"The controller is engaged and holds {target}. `gemuco query {client.robot} target {target} V1 V2 ...` moves "
        "it, `disengage` ends it."
    )


def _disengage(client: Client, words: Sequence[str], reply: Reply) -> str:
    hold = client.describe("hal")["command"]["hold"]
    return f"The controller commands no more. The drives hold for {hold:g} s and then stop as the robot file says."


def _target(client: Client, words: Sequence[str], reply: Reply) -> str:
    if not reply.get("engaged"):
        return (
            f"Nothing moves: the controller is not engaged. Use `gemuco query {client.robot} engage`, and then set the "
            "target again."
        )
    mode = wait_for_mode(client, LIVE, timeout=0.5)
    if mode not in LIVE:
        return f"Nothing moves: the mode of the drives is '{mode}'. {fault_text(client)}".strip()
    return f"{words[0]} moves to {' '.join(words[1:])}."


def _mode_after(text: str) -> Callable[[Client, Sequence[str], Reply], str]:
    def make(client: Client, words: Sequence[str], reply: Reply) -> str:
        fault = str(reply.get("fault", ""))
        return f"{text} The mode is '{reply.get('mode', 'unknown')}'. {fault}".strip()

    return make


def _adapt(client: Client, words: Sequence[str], reply: Reply) -> str:
    state = "runs and learns while the robot moves" if reply.get("active") else "is stopped"
    return f"The online update {state}; the model has version {reply.get('model_version')}."


def _rollback(client: Client, words: Sequence[str], reply: Reply) -> str:
    return f"The model before the online update is in use again, as version {reply.get('model_version')}."


def _normal(client: Client, words: Sequence[str], reply: Reply) -> str:
    threshold = reply.get("threshold")
    if threshold is None:
        return f"{reply.get('samples', 0)} samples are too few to learn the statistics of normal errors."
    count, text = reply["samples"], reply["text"]
    return f"The statistics of normal errors are from {count} samples; threshold {threshold:.4g}. {text}"


def _fault(client: Client, words: Sequence[str], reply: Reply) -> str:
    return str(reply.get("text", ""))


def _holder(client: Client, words: Sequence[str], reply: Reply) -> str:
    if reply["holder"] == "none":
        return "No client commands this robot."
    return f"{reply['holder']} commands this robot for another {reply['left']} s, and longer if it continues."


SENTENCES: dict[str, Callable[[Client, Sequence[str], Reply], str]] = {
    "enable": _enable,
    "engage": _engage,
    "disengage": _disengage,
    "target": _target,
    "disable": _mode_after("The drives switch off."),
    "stop": _mode_after("The robot stops as its robot file says, and its drives then switch off."),
    "reset": _mode_after("The drives stay off until `enable`."),
    "home": _mode_after("The drive searches its zero."),
    "tare": _mode_after("The sensor takes its present value as zero; `gemuco top` shows the result."),
    "adapt": _adapt,
    "rollback": _rollback,
    "normal": _normal,
    "fault": _fault,
    "holder": _holder,
}


def wait_for_mode(client: Client, modes: Sequence[str], timeout: float = ENABLED_WITHIN) -> str:
    """Wait until the drives have one of these modes; return the last mode, `unknown` without an answer."""
    deadline = time.monotonic() + timeout
    while True:
        applied = client.applied(timeout=0.5)
        mode = "unknown" if applied is None else applied.mode
        if mode in modes or time.monotonic() > deadline:
            return mode
        time.sleep(0.02)


def fault_text(client: Client) -> str:
    """Return the fault that the HAL reports; empty without one."""
    status = client.status("hal", timeout=2.0)
    return "" if status is None else str(status.facts.get("fault") or status.text)
