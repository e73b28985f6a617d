"""What is wrong with a robot's buses and devices, and what to do: one finding per thing that was looked at.

Nothing is enabled: the devices are opened, turned for a second with their motors off, read back, and let go.
"""

from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from enum import StrEnum

from hal import registry
from hal.calibration import store
from hal.calibration.line import Calibration
from hal.clock import SystemClock
from hal.config import BusConfig, RobotConfig
from hal.device import Device
from hal.drivers.can_device import CanDevice
from hal.errors import ConfigError, HalError
from hal.finding import link
from hal.fleet import build
from hal.wire import budget
from hal.wire.bus import Bus
from hal.wire.pulse import pulse
from hal.wire.state import BusState


class Verdict(StrEnum):
    """How it stands, worst last."""

    OK = "ok"
    WARNING = "warning"
    BAD = "bad"


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing that was looked at.

    Attributes:
        what: As in `interface can0`.
        verdict: How it stands.
        text: What was found, and if it is not good, what to do.
    """

    what: str
    verdict: Verdict
    text: str


def ok(what: str, text: str) -> Finding:
    """All is well."""
    return Finding(what, Verdict.OK, text)


def warning(what: str, text: str) -> Finding:
    """It works, but not for certain or not as well as it could."""
    return Finding(what, Verdict.WARNING, text)


def bad(what: str, text: str) -> Finding:
    """It does not work."""
    return Finding(what, Verdict.BAD, text)


DURATION = 1.0
"""How long [s] the devices are turned to see whether they answer every cycle."""
SETTLE = 10
"""Cycles before they are counted."""
COMPLETE = 0.98
"""Share of the cycles in which every device should answer."""
MUTE = 0.5
"""A device that misses more of the cycles is told by itself."""


def described(config: RobotConfig) -> Iterator[Finding]:
    """The robot file, the budget of its buses, and its calibrations: nothing is opened."""
    try:
        build(config, SystemClock(), _calibrations(config))
    except ConfigError as error:
        yield bad("robot file", str(error))
        return
    counts = f"{len(config.buses)} buses, {len(config.devices)} devices, {len(config.signals)} signals"
    yield ok("robot file", f"'{config.robot}': {counts}.")
    for found in budget.budgets(config):
        yield ok(f"budget {found.bus}", f"{found}.")
    yield calibrated(config)


def _calibrations(config: RobotConfig) -> dict[str, Calibration]:
    """Those that are stored; none if one is refused, which `calibrated` tells: the rest can be looked at even so."""
    try:
        return store.load(config)
    except ConfigError:
        return {}


def calibrated(config: RobotConfig) -> Finding:
    """Whether the calibrations hold, and which devices have none though their driver takes one."""
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
            f"{has}. {_listed(nameless)} cannot tell who they are: when you replace one, calibrate it again.",
        )
    missing = store.uncalibrated(config, stored)
    if missing:
        return warning(
            "calibration",
            f"{has}; zero and scale of {_listed(missing)} are the robot file's. If these are "
            "not measured, use `gemuco calibrate`.",
        )
    return ok("calibration", f"{has}; whatever else the robot has goes by the robot file.")


def examine(config: RobotConfig, duration: float = DURATION) -> Iterator[Finding]:
    """Open buses and devices, turn them with their motors off, and read back what they were told.

    Raises:
        ConfigError: The robot file cannot be built.
    """
    clock = SystemClock()
    buses, devices = build(config, clock, _calibrations(config))
    pool = ThreadPoolExecutor(max(1, len(devices)))
    for bus in buses:
        bus.open()
    try:
        there = {bus.name for bus in buses if bus.counters["opened"]}
        asked = [device for device in devices if config.devices[device.name].bus in there]
        errors = dict(zip(asked, pool.map(_opened, asked), strict=True))
        answering = [device for device, error in errors.items() if not error]
        share, missed = _turn(config, buses, answering, clock, duration)
        yield from _buses(buses, there, config)
        yield from _answers(devices, errors, there, config)
        if answering:
            yield from _complete(share, missed, answering, config.rates.hal)
        with pulse(buses):
            checks = dict(zip(answering, pool.map(_checks, answering), strict=True))
        yield from _inspected(checks)
    finally:
        list(pool.map(lambda device: device.close(), devices))
        pool.shutdown()
        for bus in buses:
            bus.close()


def _opened(device: Device) -> str:
    """Open a device; why it cannot be, empty if it could."""
    try:
        device.open()
    except HalError as error:
        return str(error)
    return ""


def _turn(
    config: RobotConfig, buses: Sequence[Bus], devices: Iterable[Device], clock: SystemClock, duration: float
) -> tuple[float, dict[str, float]]:
    """Cycle with the motors off: share of cycles in which all answered, and in which each did not."""
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
            late = [one for one in devices if isinstance(one, CanDevice) and one.missed > one.patience]
            for device in late:
                missed[device.name] += 1
            whole += not late
        due = max(due + period, clock.monotonic())
        clock.sleep_until(due)
    return whole / cycles, {name: count / cycles for name, count in missed.items()}


def _buses(buses: Sequence[Bus], there: set[str], config: RobotConfig) -> Iterator[Finding]:
    planned = {found.bus: found.load for found in budget.budgets(config)}
    for bus in buses:
        what, settings = f"bus {bus.name}", config.buses[bus.name]
        if bus.name not in there:
            advice = (
                " Start `gemuco simulate`, or name real interfaces." if settings.interface in store.SIMULATED else ""
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
                f"strangers {bus.name}", f"Frames of nobody in the robot file: {strangers}. `gemuco scan` tells more."
            )


def _answers(
    devices: Sequence[Device], errors: dict[Device, str], there: set[str], config: RobotConfig
) -> Iterator[Finding]:
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
            f"It answers when asked, and sends no process data in {missed[device.name]:.0%} of the cycles. "
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


def _checks(device: Device) -> tuple[tuple[str, bool, str], ...]:
    try:
        return tuple((check.what, check.is_good, check.text) for check in device.inspect())
    except HalError as error:
        return (("inspection", False, str(error)),)


def _inspected(checks: dict[Device, tuple[tuple[str, bool, str], ...]]) -> Iterator[Finding]:
    """One line per kind of check if all devices pass it, and one per device that does not."""
    kinds = list(
        dict.fromkeys(what for found in checks.values() for what, _, _ in found if not what.startswith("object"))
    )
    for kind in kinds:
        passed = [device.name for device, found in checks.items() if any(w == kind for w, _, _ in found)]
        wrong = [
            (d.name, text) for d, found in checks.items() for w, is_good, text in found if w == kind and not is_good
        ]
        for name, text in wrong:
            yield bad(f"{kind} {name}", text)
        if not wrong:
            yield ok(kind, f"As it should be in {len(passed)} devices.")
    for device, found in checks.items():
        for what, is_good, text in found:
            if what.startswith("object") and not is_good:
                yield bad(f"{what} {device.name}", text)


def _listed(names: Sequence[str], most: int = 4) -> str:
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more


def interfaces(config: RobotConfig) -> Iterator[Finding]:
    """Whether the interfaces are there, up, and set as the robot file says."""
    for name, bus in config.buses.items():
        what = f"interface {name}"
        if bus.interface == "socketcan":
            commands = sum(bool(_commanded(config, device)) for device, at in config.devices.items() if at.bus == name)
            yield from socketcan(what, bus, link.look_up(bus.channel), commands)
        elif bus.interface == "virtual":
            yield warning(
                what, "'virtual' lives inside one process, for tests. For two processes use `interface: hub`."
            )
        elif bus.interface == "hub":
            yield ok(what, f"hub '{bus.channel}', for simulated nodes: it has no bit rate and no errors of its own.")
        else:
            yield warning(what, f"{bus.interface} {bus.channel}: what its adapter is set to cannot be looked up here.")


def socketcan(what: str, bus: BusConfig, found: link.Link | None, commands: int) -> Iterator[Finding]:
    """The state of a Linux CAN interface; `commands` frames are sent at once beside the SYNC."""
    up = f"sudo ip link set {bus.channel} up type can bitrate {bus.bitrate} restart-ms 100"
    if found is None:
        known = ", ".join(link.known_links()) or "none"
        yield bad(
            what, f"There is no interface '{bus.channel}'. CAN interfaces here: {known}. Is the adapter plugged in?"
        )
        return
    if not found.is_can:
        yield bad(what, f"'{bus.channel}' is no CAN interface. Those here: {', '.join(link.known_links()) or 'none'}.")
        return
    if not found.is_up:
        command = up if found.kind in ("can", "") else f"sudo ip link set {bus.channel} up"
        yield bad(what, f"'{bus.channel}' is down. Set it up with `{command}`.")
        return
    yield ok(what, f"'{bus.channel}' ({found.kind or 'CAN'}) is up.")
    if found.kind == "can":
        if found.bitrate != bus.bitrate:
            yield bad(
                f"bit rate {what.split()[-1]}",
                f"{found.bitrate} bit/s, and the robot file says {bus.bitrate}. "
                f"`sudo ip link set {bus.channel} down; {up}`",
            )
        else:
            yield ok(f"bit rate {what.split()[-1]}", f"{bus.bitrate / 1e3:g} kbit/s.")
        yield from _controller(what.split()[-1], bus, found)
    if found.queue is not None and found.queue < commands + 2:
        more = f"sudo ip link set {bus.channel} txqueuelen {4 * (commands + 2)}"
        yield warning(
            f"queue {what.split()[-1]}", f"{found.queue} frames, and {commands + 2} are sent at once. `{more}`"
        )


def _controller(name: str, bus: BusConfig, found: link.Link) -> Iterator[Finding]:
    if not found.restart:
        yield warning(
            f"restart {name}",
            "The controller stays off after bus-off. "
            f"`sudo ip link set {bus.channel} down; sudo ip link set {bus.channel} type can restart-ms 100`",
        )
    else:
        yield ok(f"restart {name}", f"{found.restart * 1e3:g} ms after bus-off.")
    if found.state not in ("ERROR-ACTIVE", ""):
        is_lost = found.state in ("BUS-OFF", "STOPPED")
        text = f"The controller is {found.state}. Check wiring, both 120 ohm terminations, and every node's bit rate."
        yield bad(f"controller {name}", text) if is_lost else warning(f"controller {name}", text)


def _commanded(config: RobotConfig, device: str) -> str | None:
    driver, settings = registry.equipment(config, device)
    quantity: str | None = driver.commanded(settings)
    return quantity
