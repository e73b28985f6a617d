"""`gemuco query ROBOT move SIGNAL V1 V2 ...`: move a robot once, with a lease for the time of it."""

import time
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import typer

from services.client import Client
from services.errors import BadArguments, NoAnswer, ServiceError, TargetRefused
from services.learning.motion import minimum_jerk
from services.verbs.answers import LIVE, fault_text, wait_for_mode
from services.wire.messages import Sample

SHARE = 0.5
"""A move has at most this share of the limits' rate."""
SLOWEST = 0.5
"""A move without a rate in the limits has this speed [unit/s]."""
SETTLE = 0.5
"""The goal is commanded for this time [s] after the move."""
LONGEST = 60.0
"""The controller of a model reaches its target within this time [s]."""
CLOSE = 0.02
"""The controller has arrived when the signal moves by less than this [unit] in half a second."""


def move(client: Client, signal: str, values: Sequence[float]) -> int:
    """Move a signal to values [its unit] and print where it is then; return the exit code.

    The commanded signal is moved without a model. The signal of the model's controller is moved by the controller.

    Raises:
        BadArguments: The signal cannot be moved, or does not have this number of elements.
        TargetRefused: A value is outside of the limits.
        CommandHeld, LeaseLost: Another client commands the robot.
        ServiceError: The drives were not enabled, or the robot stopped on the way.
    """
    hal = client.describe("hal")
    commanded = str(hal["command"]["signal"])
    controls = "" if signal == commanded else _controls(client)
    if signal not in (commanded, controls):
        known = " or ".join(dict.fromkeys(name for name in (commanded, controls) if name))
        hint = "" if controls else f" With a model, `gemuco serve {client.robot}`, its target can be moved too."
        raise BadArguments(f"'{signal}' cannot be moved; {known} can.{hint}")
    section, goal = hal["signals"][signal], np.asarray(values, float)
    if goal.shape != (len(section["elements"]),):
        raise BadArguments(f"'{signal}' has {len(section['elements'])} elements: {', '.join(section['elements'])}.")
    with client.lease():
        try:
            if signal == commanded:
                _check_limits(hal, signal, goal)
                _stream(client, hal, signal, goal)
            else:
                _control(client, signal, goal)
            _report(client, signal, section, goal)
        finally:
            client.stop()
    hold = hal["command"]["hold"]
    typer.echo(f"The lease has ended: the drives hold for {hold:g} s at most and stop as the robot file says.")
    return 0


def _controls(client: Client) -> str:
    """Return the signal of the model's controller; empty without one."""
    try:
        return str(client.describe("model", timeout=1.0)["controls"])
    except NoAnswer:
        return ""


def _check_limits(hal: Mapping[str, Any], signal: str, goal: np.ndarray) -> None:
    limits, section = hal["limits"].get(signal, {}), hal["signals"][signal]
    low, high = (np.broadcast_to(limits.get(end, out), goal.shape) for end, out in (("low", -np.inf), ("high", np.inf)))
    for element, value, least, most in zip(section["elements"], goal, low, high, strict=True):
        if not least <= value <= most:
            raise TargetRefused(
                f"{signal}.{element} of {value:g} {section['unit']} is outside of its limits, {least:g} to {most:g}."
            )


def _stream(client: Client, hal: Mapping[str, Any], signal: str, goal: np.ndarray) -> None:
    """Enable the drives and command a smooth move from the present position."""
    _wait_for_stop(client)
    client.enable()
    if (mode := wait_for_mode(client, (*LIVE, "fault"))) not in LIVE:
        raise ServiceError(f"The drives were not enabled: the mode is '{mode}'. {fault_text(client)}".strip())
    sample = _next(client)
    rate = hal["limits"].get(signal, {}).get("rate")
    speed = SLOWEST if rate is None else SHARE * float(np.min(rate))
    period = 1.0 / float(hal["rates"]["hal"])
    points = minimum_jerk(sample.values[signal].copy(), goal, speed, period)
    began = time.monotonic()
    while (index := int((time.monotonic() - began) / period)) < len(points) + round(SETTLE / period):
        client.command(signal, points[min(index, len(points) - 1)], sample)
        sample = _next(client)
        _check_mode(client)


def _wait_for_stop(client: Client) -> None:
    """Wait until the drives are off, for 5 s at most, unless a controller moves them.

    After the move before, or after `enable`, they hold for a time without commands, and then stop.
    This would end the move that has just begun.
    """
    wait_for_mode(client, ("off", "follow", "fault"))


def _next(client: Client) -> Sample:
    sample = client.next_sample()
    if sample is None:
        raise ServiceError("No sample comes from the HAL any more. Is `gemuco hal` running?")
    return sample


def _check_mode(client: Client) -> None:
    applied = client.applied(timeout=0.5)
    if applied is None or applied.mode not in LIVE:
        mode = "unknown" if applied is None else applied.mode
        raise ServiceError(f"The robot stopped on the way, its mode is '{mode}'. {fault_text(client)}".strip())


def _control(client: Client, signal: str, goal: np.ndarray) -> None:
    """Let the model's controller move, and wait until the signal has come to rest."""
    _wait_for_stop(client)
    client.engage()
    if (mode := wait_for_mode(client, (*LIVE, "fault"))) not in LIVE:
        raise ServiceError(f"The drives were not enabled: the mode is '{mode}'. {fault_text(client)}".strip())
    client.ask("model", "target", {"signal": signal, "values": goal.tolist()})
    deadline, before = time.monotonic() + LONGEST, _value(client, signal)
    while time.monotonic() < deadline:
        time.sleep(0.5)
        _check_mode(client)
        now = _value(client, signal)
        if np.abs(now - before).max() < CLOSE and _reference_has_arrived(client, goal):
            break
        before = now
    client.disengage()


def _reference_has_arrived(client: Client, goal: np.ndarray) -> bool:
    status = client.status("model", timeout=1.5)
    facts = {} if status is None else status.facts.get("control", {})
    return isinstance(facts, dict) and np.allclose(facts.get("reference", []), goal, atol=1e-6)


def _value(client: Client, signal: str) -> np.ndarray:
    """Return the newest value of a signal: the estimate of the model, or the measurement without a model."""
    estimate = client.estimate(timeout=0.5)
    sample = estimate if estimate is not None and signal in estimate.values else client.sample(timeout=1.0)
    if sample is None or signal not in sample.values:
        raise ServiceError(f"No value of '{signal}' arrives any more.")
    return np.asarray(sample.values[signal], float)


def _report(client: Client, signal: str, section: Mapping[str, Any], goal: np.ndarray) -> None:
    value = _value(client, signal)
    parts = "  ".join(f"{name} {number:+.4g}" for name, number in zip(section["elements"], value, strict=True))
    away = float(np.abs(value - goal).max())
    typer.echo(f"{signal} is at {parts} {section['unit']}, at most {away:.3g} {section['unit']} away from its goal.")
