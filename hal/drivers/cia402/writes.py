"""Objects that are written to a servo drive before its use: mode, limits, and the reaction to a lost connection."""

import math
from collections.abc import Iterator

import canopen

from hal.drivers.cia402.settings import LARGEST_COUNT, MODES, DriveSettings, DriveUnits
from hal.errors import ConfigError
from hal.protocols import cia301, cia402
from hal.protocols.cia301 import MappedObject

Write = tuple[MappedObject, int]

ERROR_BEHAVIOUR = MappedObject(cia301.ERROR_BEHAVIOUR, 1, 8)
POSITION_MARGIN = 0.1
"""The drive's limits are wider than the robot file's by this part of the range: a drive slightly out of range must not
jump into it when it is enabled. A drive further out of range is not enabled."""


def check_objects(settings: DriveSettings, has_effort: bool, sheet: canopen.ObjectDictionary, label: str) -> None:
    """Check that the drive has the objects that its settings need.

    Raises:
        ConfigError: An object is missing; it names the object and the setting.
    """
    for what, item in _needed(settings, has_effort):
        if sheet.get_variable(item.index, item.subindex) is None:
            raise ConfigError(f"{label} needs object {item} for {what}; its data sheet has none. Is it the right file?")
    watchdog = sheet.get_variable(cia301.CONSUMER_HEARTBEAT, 1)
    if watchdog is None and not settings.allow_no_watchdog:
        raise ConfigError(
            f"{label} has no object {cia301.CONSUMER_HEARTBEAT:04X}h by its data sheet, so it would go on moving when "
            "the HAL is gone. Use another drive, or accept it with allow_no_watchdog: true."
        )


def _needed(settings: DriveSettings, has_effort: bool) -> Iterator[tuple[str, MappedObject]]:
    yield "its mode", cia402.MODE_OF_OPERATION
    if has_effort and settings.rated_torque is None:
        yield "the rated torque (or the setting rated_torque)", cia402.RATED_TORQUE
    if settings.max_torque is not None:
        yield "max_torque", cia402.MAX_TORQUE
    if settings.following_error is not None:
        yield "following_error", cia402.FOLLOWING_ERROR_WINDOW
    profile = settings.profile
    for name, value, item in (
        ("profile.velocity", profile.velocity, cia402.PROFILE_VELOCITY),
        ("profile.acceleration", profile.acceleration, cia402.PROFILE_ACCELERATION),
        ("profile.deceleration", profile.deceleration, cia402.PROFILE_DECELERATION),
    ):
        if value is not None:
            yield name, item
    homing = settings.homing
    if homing:
        yield "homing", cia402.HOMING_METHOD
        yield "homing.speed", cia402.HOMING_SPEED_SWITCH
        yield "homing.slow_speed", cia402.HOMING_SPEED_ZERO
        if homing.acceleration is not None:
            yield "homing.acceleration", cia402.HOMING_ACCELERATION
        if homing.offset:
            yield "homing.offset", cia402.HOME_OFFSET


def drive_writes(
    settings: DriveSettings,
    units: DriveUnits,
    bounds: tuple[float, float],
    period: float,
    sheet: canopen.ObjectDictionary,
) -> tuple[Write, ...]:
    """Return objects and their values, in the order in which they are written.

    Args:
        settings: The drive's settings.
        units: The drive's units.
        bounds: Lowest and highest set-point of the robot file [unit of the commanded element]; infinite if not given.
        period: Period of the set-points [s], between which a drive interpolates.
        sheet: Its data sheet; a limit or reaction without an object there is not written.
    """
    value, index = cia402.interpolation(period)
    optional = (
        *([(cia402.INTERPOLATION_SUBMODE, cia402.LINEAR)] if settings.mode == "ip" else []),
        (cia402.INTERPOLATION_PERIOD, value),
        (cia402.INTERPOLATION_INDEX, index),
        (cia402.ABORT_CONNECTION, cia402.ABORT_QUICK_STOP),
        (ERROR_BEHAVIOUR, cia301.BECOME_PRE_OPERATIONAL),
        (cia402.QUICK_STOP_OPTION, cia402.QUICK_STOP_AND_OFF),
        *_limits(settings, units, bounds),
    )
    return (
        (cia402.MODE_OF_OPERATION, MODES[settings.mode]),
        *(write for write in optional if _takes(sheet, write[0])),
        *_profile(settings, units),
        *_homing(settings, units),
    )


def _takes(sheet: canopen.ObjectDictionary, item: MappedObject) -> bool:
    """Return whether the data sheet has the object and allows writing it."""
    entry = sheet.get_variable(item.index, item.subindex)
    return entry is not None and "w" in entry.access_type


def _limits(settings: DriveSettings, units: DriveUnits, bounds: tuple[float, float]) -> Iterator[Write]:
    largest = max(abs(bound) for bound in bounds)
    velocity, torque = settings.max_velocity, settings.max_torque
    if settings.commanded == "position" and min(abs(bound) for bound in bounds) < math.inf:
        yield from _positions(units, bounds)
    elif settings.commanded == "velocity" and velocity is None and math.isfinite(largest):
        velocity = largest * (1 + POSITION_MARGIN)
    elif settings.commanded == "effort" and torque is None and math.isfinite(largest):
        torque = min(math.ceil(abs(largest / units.effort)), 2**16 - 1)
    if torque is not None:
        yield cia402.MAX_TORQUE, torque
    if velocity is not None:
        yield cia402.MAX_PROFILE_VELOCITY, units.size(velocity, units.velocity)
        yield cia402.MAX_MOTOR_SPEED, units.size(velocity, units.motor_turn / 60)
    if settings.following_error is not None:
        yield cia402.FOLLOWING_ERROR_WINDOW, units.size(settings.following_error, units.position.scale)


def _positions(units: DriveUnits, bounds: tuple[float, float]) -> Iterator[Write]:
    low, high = bounds
    margin = POSITION_MARGIN * (high - low) if math.isfinite(high - low) else 0.0
    ends = []
    for bound in (low - margin, high + margin):
        if math.isfinite(bound):
            ends.append(units.counts(bound))
        else:
            ends.append(LARGEST_COUNT if (bound > 0) == (units.position.scale > 0) else -LARGEST_COUNT)
    yield cia402.LOWEST_POSITION, min(ends)
    yield cia402.HIGHEST_POSITION, max(ends)


def _profile(settings: DriveSettings, units: DriveUnits) -> Iterator[Write]:
    profile = settings.profile
    for value, item in (
        (profile.velocity, cia402.PROFILE_VELOCITY),
        (profile.acceleration, cia402.PROFILE_ACCELERATION),
        (profile.deceleration, cia402.PROFILE_DECELERATION),
    ):
        if value is not None:
            yield item, units.size(value, units.velocity)


def _homing(settings: DriveSettings, units: DriveUnits) -> Iterator[Write]:
    homing = settings.homing
    if homing is None:
        return
    yield cia402.HOMING_METHOD, homing.method
    yield cia402.HOMING_SPEED_SWITCH, units.size(homing.speed, units.velocity)
    yield cia402.HOMING_SPEED_ZERO, units.size(homing.slow_speed, units.velocity)
    if homing.acceleration is not None:
        yield cia402.HOMING_ACCELERATION, units.size(homing.acceleration, units.velocity)
    if homing.offset:
        yield cia402.HOME_OFFSET, round(homing.offset / units.position.scale)
