"""Checks of a robot's buses and devices: one finding per check, with a remedy.

No drive is enabled: the devices are opened, cycled for a second with their motors off, read back, and closed.
"""

import os
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

from hal import registry
from hal.calibration import store
from hal.calibration.line import Calibration
from hal.clock import SystemClock
from hal.config import BusConfig, RobotConfig
from hal.device import Device
from hal.drivers.bus_device import BusDevice
from hal.errors import ConfigError, HalError
from hal.finding import link
from hal.finding.plausible import drive_questions, position_questions
from hal.fleet import build
from hal.wire import budget
from hal.wire.contract import Wire
from hal.wire.pulse import pulse
from hal.wire.state import BusState


class Severity(StrEnum):
    """Result of a check, worst last."""

    OK = "ok"
    WARNING = "warning"
    BAD = "bad"


@dataclass(frozen=True, slots=True)
class Finding:
    """One check and its result.

    Attributes:
        what: Subject of the check, as in `interface can0`.
        verdict: Result.
        text: Result in words, and the remedy if it is not good.
    """

    what: str
    verdict: Severity
    text: str


def ok(what: str, text: str) -> Finding:
    """Return a finding without a problem."""
    return Finding(what, Severity.OK, text)


def warning(what: str, text: str) -> Finding:
    """Return a finding of a possible problem."""
    return Finding(what, Severity.WARNING, text)


def bad(what: str, text: str) -> Finding:
    """Return a finding of a failure."""
    return Finding(what, Severity.BAD, text)


DURATION = 1.0
"""The devices are cycled for this time [s]."""
SETTLE = 10
"""This number of first cycles is not counted."""
COMPLETE = 0.98
"""Every device should answer in this share of the cycles."""
MUTE = 0.5
"""A device that misses a larger share of the cycles gets a finding of its own."""


def check_file(config: RobotConfig) -> Iterator[Finding]:
    """Check the robot file, the budget of its buses, and its calibrations; nothing is opened."""
    try:
        _, devices = build(config, SystemClock(), _calibrations(config))
    except ConfigError as error:
        yield bad("robot file", str(error))
        return
    counts = f"{len(config.buses)} buses, {len(config.devices)} devices, {len(config.signals)} signals"
    yield ok("robot file", f"'{config.robot}': {counts}.")
    for bus_budget in budget.budgets(config):
        yield ok(f"budget {bus_budget.bus}", f"{bus_budget}.")
    yield from check_limits(config, devices)
    yield check_calibration(config)


def check_limits(config: RobotConfig, devices: Iterable[Device]) -> Iterator[Finding]:
    """Ask about limits that no robot of this kind is likely to have, or that a drive cannot reach."""
    questions = list(position_questions(config))
    yield from (warning("limits", text) for text in questions)
    too_fast = list(drive_questions(config, devices))
    yield from (warning(f"rate {name}", text) for name, text in too_fast)
    if config.limits and not questions and not too_fast:
        yield ok("limits", f"Likely for {', '.join(config.limits)}.")


def _calibrations(config: RobotConfig) -> dict[str, Calibration]:
    """Return the stored calibrations; none if one is refused, which `check_calibration` reports."""
    try:
        return store.load(config)
    except ConfigError:
        return {}


def check_calibration(config: RobotConfig) -> Finding:
    """Check that the calibrations are valid and complete."""
    try:
        stored = store.load(config)
        dates = [record.date[:10] for record in store.records(config) if record.device in stored]
    except ConfigError as error:
        return bad("calibration", str(error))
    has = f"{len(stored)} devices, the oldest of {min(dates)}" if stored else "None"
    nameless = [name for name, one in stored.items() if not one.identity]
    if nameless:
        return warning(
            "calibration",
            f"{has}. {_listed(nameless)} have no identity: when you replace one, calibrate it again.",
        )
    missing = store.uncalibrated(config, stored)
    if missing:
        return warning(
            "calibration",
            f"{has}; zero and scale of {_listed(missing)} are those of the robot file. If these are "
            "not measured, use `gemuco calibrate`.",
        )
    return ok("calibration", f"{has}; all other devices use the robot file.")


def check_devices(config: RobotConfig, duration: float = DURATION) -> Iterator[Finding]:
    """Open buses and devices, cycle them with their motors off, and read back their configuration.

    Raises:
        ConfigError: The robot file cannot be built.
    """
    clock = SystemClock()
    buses, devices = build(config, clock, _calibrations(config))
    pool = ThreadPoolExecutor(max(1, len(devices)))
    for bus in buses:
        bus.open()
    try:
        opened = {bus.name for bus in buses if bus.counters["opened"]}
        reachable = [device for device in devices if config.devices[device.name].bus in opened]
        errors = dict(zip(reachable, pool.map(_open, reachable), strict=True))
        answering = [device for device, error in errors.items() if not error]
        share, missed = _cycle(config, buses, answering, clock, duration)
        yield from _buses(buses, opened, config)
        yield from _answers(devices, errors)
        if answering:
            yield from _complete(share, missed, answering, config.rates.hal)
        with pulse(buses):
            checks = dict(zip(answering, pool.map(_inspect, answering), strict=True))
        yield from _summary(checks)
        for name, text in drive_questions(config, answering):
            yield warning(f"rate {name}", text)
    finally:
        list(pool.map(lambda device: device.close(), devices))
        pool.shutdown()
        for bus in buses:
            bus.close()


def _open(device: Device) -> str:
    """Open a device and return the error; empty without one."""
    try:
        device.open()
    except HalError as error:
        return str(error)
    return ""


def _cycle(
    config: RobotConfig, buses: Sequence[Wire], devices: Iterable[Device], clock: SystemClock, duration: float
) -> tuple[float, dict[str, float]]:
    """Cycle with the motors off; return the share of complete cycles, and that of missed cycles per device."""
    period, devices = 1.0 / config.rates.hal, list(devices)
    cycles = max(10, round(duration * config.rates.hal))
    missed = dict.fromkeys((device.name for device in devices), 0)
    whole = 0
    due = clock.monotonic()
    for number in range(-SETTLE, cycles):
        for bus in buses:
            bus.begin()
        start = clock.monotonic()
        for device in devices:
            if device.commands:
                device.idle()
        for bus in buses:
            bus.sync(start)
        for bus in buses:
            bus.wait(start + 0.8 * period)
        if number >= 0:
            late = [device for device in devices if isinstance(device, BusDevice) and device.missed > device.patience]
            for device in late:
                missed[device.name] += 1
            whole += not late
        due = max(due + period, clock.monotonic())
        clock.sleep_until(due)
    return whole / cycles, {name: count / cycles for name, count in missed.items()}


def _buses(buses: Sequence[Wire], opened: set[str], config: RobotConfig) -> Iterator[Finding]:
    planned = {bus_budget.bus: bus_budget.load for bus_budget in budget.budgets(config)}
    for bus in buses:
        what, settings = f"bus {bus.name}", config.buses[bus.name]
        if bus.name not in opened:
            advice = (
                " Start `gemuco simulate`, or set real interfaces." if settings.interface in store.SIMULATED else ""
            )
            yield bad(what, f"It does not open: {bus.text}{advice}")
            continue
        health = bus.health()
        load = f"load {health['load']:.0%} of at most {settings.max_load:.0%}, {planned[bus.name]:.0%} computed"
        if bus.state is BusState.OK:
            over = health["load"] > settings.max_load
            yield (warning if over else ok)(what, f"{load}.")
        elif bus.state is BusState.WARNING:
            yield warning(what, f"{bus.text} ({load})")
        else:
            yield bad(what, f"It is {bus.state}. {bus.text}")
        if health["unknown"]:
            strangers = ", ".join(str(stranger) for stranger in health["unknown"])
            yield warning(
                f"strangers {bus.name}", f"Frames that are not in the robot file: {strangers}. See `gemuco scan`."
            )


def _answers(devices: Sequence[Device], errors: dict[Device, str]) -> Iterator[Finding]:
    silent = [device.name for device in devices if device not in errors]
    for device, error in errors.items():
        if error:
            yield bad(f"node {device.name}", error)
    good = len([error for error in errors.values() if not error])
    if good == len(devices):
        yield ok("nodes", f"All {good} answer.")
    elif silent:
        yield bad("nodes", f"{good} of {len(devices)} answer; {_listed(silent)}: the bus does not open.")
    else:
        yield bad("nodes", f"{good} of {len(devices)} answer.")


def _complete(share: float, missed: dict[str, float], devices: Sequence[Device], rate: float) -> Iterator[Finding]:
    mute = [device for device in devices if missed[device.name] > MUTE]
    for device in mute:
        yield bad(
            f"node {device.name}",
            f"It answers requests, but sends no process data in {missed[device.name]:.0%} of the cycles. "
            f"{device.health().text}",
        )
    if share >= COMPLETE:
        yield ok("cycles", f"All of them answered in {share:.1%} of the cycles at {rate:g} Hz.")
    elif not mute:
        often = [name for name in sorted(missed, key=lambda name: -missed[name]) if missed[name] > 1 - COMPLETE]
        yield warning(
            "cycles",
            f"All of them answered in only {share:.1%} of the cycles at {rate:g} Hz; late: {_listed(often) or 'any'}. "
            "Is this machine busy, is rates.hal too much for the bus?",
        )


def _inspect(device: Device) -> tuple[tuple[str, bool, str], ...]:
    try:
        return tuple((check.what, check.is_good, check.text) for check in device.inspect())
    except HalError as error:
        return (("inspection", False, str(error)),)


def _summary(checks: dict[Device, tuple[tuple[str, bool, str], ...]]) -> Iterator[Finding]:
    """Yield one finding per kind of check that all devices pass, and one per device that fails."""
    results = [(what, device.name, good, text) for device, own in checks.items() for what, good, text in own]
    objects = [result for result in results if result[0].startswith("object")]
    for kind in dict.fromkeys(what for what, *_ in results if not what.startswith("object")):
        wrong = [(name, text) for what, name, is_good, text in results if what == kind and not is_good]
        for name, text in wrong:
            yield bad(f"{kind} {name}", text)
        if not wrong:
            count = len({name for what, name, _, _ in results if what == kind})
            yield ok(kind, f"Correct in {count} devices.")
    for what, name, is_good, text in objects:
        if not is_good:
            yield bad(f"{what} {name}", text)


def _listed(names: Sequence[str], most: int = 4) -> str:
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more


def check_interfaces(config: RobotConfig) -> Iterator[Finding]:
    """Check that the interfaces exist, are up, and have the settings of the robot file."""
    for name, bus in config.buses.items():
        what = f"interface {name}"
        if bus.interface == "socketcan":
            commands = sum(bool(_commanded(config, device)) for device, at in config.devices.items() if at.bus == name)
            yield from check_socketcan(what, bus, link.look_up(bus.channel), commands)
        elif bus.interface == "virtual":
            yield warning(
                what, "'virtual' works inside one process, for tests. For two processes use `interface: hub`."
            )
        elif bus.interface == "serial":
            yield from check_serial(what, bus)
        elif bus.interface == "pty":
            yield ok(what, f"pseudo-terminal '{bus.channel}', for simulated servos.")
        elif bus.interface == "hub":
            yield ok(what, f"hub '{bus.channel}', for simulated nodes: it has no bit rate and no errors of its own.")
        else:
            yield warning(what, f"{bus.interface} {bus.channel}: the settings of its adapter cannot be read here.")


def check_serial(what: str, bus: BusConfig) -> Iterator[Finding]:
    """Check that the adapter of a serial line is there, and that this user may open it."""
    if not Path(bus.channel).exists():
        known = ", ".join(sorted(str(p) for kind in ("ttyACM*", "ttyUSB*") for p in Path("/dev").glob(kind))) or "none"
        yield bad(what, f"There is no '{bus.channel}'. Adapters here: {known}. Is it plugged in?")
    elif not os.access(bus.channel, os.R_OK | os.W_OK):
        yield bad(
            what,
            f"This user may not open '{bus.channel}': sudo usermod -aG dialout $USER, then log out and in again.",
        )
    else:
        yield ok(what, f"Adapter '{bus.channel}' at {bus.bitrate} bit/s.")


def check_socketcan(what: str, bus: BusConfig, state: link.Interface | None, commands: int) -> Iterator[Finding]:
    """Check a Linux CAN interface; `commands` frames are sent at once, in addition to the SYNC."""
    name = what.split()[-1]
    up = link.up_command(bus.channel, "can" if state is None else state.kind, bus.bitrate, bus.data_bitrate)
    if state is None:
        known = ", ".join(link.known_links()) or "none"
        yield bad(
            what, f"There is no interface '{bus.channel}'. CAN interfaces here: {known}. Is the adapter plugged in?"
        )
        return
    if not state.is_can:
        yield bad(
            what, f"'{bus.channel}' is not a CAN interface. Those here: {', '.join(link.known_links()) or 'none'}."
        )
        return
    if not state.is_up:
        yield bad(what, f"'{bus.channel}' is down. Set it up with `{up}`.")
        return
    if bus.is_fd and state.mtu is not None and state.mtu < link.FD_MTU:
        yield bad(what, f"'{bus.channel}' takes classic frames only. `sudo ip link set {bus.channel} down; {up}`")
        return
    yield ok(what, f"'{bus.channel}' ({state.kind or 'CAN'}) is up.")
    if state.kind == "can":
        yield from check_bit_rates(name, bus, state, up)
        yield from check_controller(name, state)
    if state.queue is not None and state.queue < commands + 2:
        more = f"sudo ip link set {bus.channel} txqueuelen {4 * (commands + 2)}"
        yield warning(f"queue {name}", f"{state.queue} frames, and {commands + 2} are sent at once. `{more}`")


def check_bit_rates(name: str, bus: BusConfig, state: link.Interface, up: str) -> Iterator[Finding]:
    """Check the bit rates of a controller; `up` is the command that sets them."""
    rates = [("bit rate", state.bitrate, bus.bitrate)]
    if bus.data_bitrate is not None:
        rates.append(("bit rate of data", state.data_bitrate, bus.data_bitrate))
    for what, own, stated in rates:
        if own == stated:
            yield ok(f"{what} {name}", f"{stated / 1e3:g} kbit/s.")
            continue
        yield bad(
            f"{what} {name}",
            f"{own} bit/s, and the robot file says {stated}. `sudo ip link set {bus.channel} down; {up}`",
        )


def check_controller(name: str, state: link.Interface) -> Iterator[Finding]:
    """Check the restart and the state of the controller of a CAN interface that is up."""
    if not state.restart:
        yield warning(
            f"restart {name}",
            "The controller stays off after bus-off. "
            f"`sudo ip link set {state.name} down; sudo ip link set {state.name} type can restart-ms 100`",
        )
    else:
        yield ok(f"restart {name}", f"{state.restart * 1e3:g} ms after bus-off.")
    if state.state not in ("ERROR-ACTIVE", ""):
        is_lost = state.state in ("BUS-OFF", "STOPPED")
        text = f"The controller is {state.state}. Check wiring, both 120 ohm terminations, and every node's bit rate."
        yield bad(f"controller {name}", text) if is_lost else warning(f"controller {name}", text)


def _commanded(config: RobotConfig, device: str) -> str | None:
    driver, settings = registry.equipment(config, device)
    quantity: str | None = driver.commanded(settings)
    return quantity
