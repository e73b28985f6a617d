"""Calibrations of a robot's devices, in a readable file beside the robot file.

Each record belongs to one very device and has a hash, so that neither another device nor a mistake in an editor moves a
joint. A record is refused if its conditions have changed since, such as a gear or a number of counts.
"""

import fcntl
import hashlib
import json
import os
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import yaml
from pydantic import ValidationError

from hal import registry
from hal.calibration.line import Calibration, Point
from hal.config import RobotConfig, Section
from hal.errors import ConfigError
from hal.reading.mistakes import explain, parse_yaml

SIMULATED = ("hub", "virtual", "pty")
"""Devices on these interfaces are simulated and need no calibration."""
KEPT = ".before"
"""A copy of the file before the last change has this suffix."""
PART = ".part"
"""A file that is being written has its later name with this suffix."""
WITHOUT_EFFECT = frozenset(
    (
        *("eds", "pdo", "master_id", "silent_after", "frozen_after", "periods", "heartbeat", "identity", "around"),
        *("mode", "command", "cyclic", "stiffness", "damping", "ramp", "profile", "velocity_unit", "temperature"),
        *("rated_torque", "max_torque", "max_velocity", "max_effort", "following_error"),
        *("watch_time", "watchdog", "watchdog_timeout", "allow_no_watchdog", "status", "bad_status", "error", "state"),
        *("open", "tare", "enable", "disable", "quick_stop", "reset"),
    )
)
"""These settings do not change the meaning of a reading; a change of any other setting invalidates a calibration."""
_AGAIN = "Delete the record, or measure again with `gemuco calibrate`."
_HEAD = """\
# What `gemuco calibrate` measured of this robot's devices. Its settings take precedence over those of the robot file.
# Every record is sealed by its hash: calibrate again instead of editing, or delete a record to do without it.
"""


class Record(Section):
    """One calibration."""

    device: str
    """Name in the robot file."""
    identity: str
    """`Device.identity`; empty if the device has none."""
    settings: dict[str, Any]
    """Settings that replace those of the robot file."""
    measured_with: dict[str, Any]
    """Driver and other settings at the time of the calibration."""
    unit: str
    points: tuple[Point, ...]
    residual: float
    """Largest difference [unit] between a known value and the calibrated reading."""
    date: str = ""
    """Time of the calibration, UTC."""
    hash: str = ""

    @property
    def seal(self) -> str:
        """Hash of all other fields."""
        content = json.dumps(self.model_dump(exclude={"hash"}), sort_keys=True)
        return hashlib.sha256(content.encode()).hexdigest()[:16]


def path_of(config: RobotConfig) -> Path:
    """Return the path of a robot's calibrations."""
    return config.folder / f"{config.robot}.calibration.yaml"


def measured_with(config: RobotConfig, device: str, measured: Mapping[str, Any]) -> dict[str, Any]:
    """Return driver and settings on which a calibration of the `measured` settings depends."""
    settings = config.settings_of(device)
    others = {key: value for key, value in settings.items() if key not in WITHOUT_EFFECT and key not in measured}
    return {"driver": config.kinds[config.devices[device].kind].driver, **json.loads(json.dumps(others, default=str))}


def records(config: RobotConfig) -> list[Record]:
    """Return every record of a robot, as it is in the file.

    Raises:
        ConfigError: The file cannot be read.
    """
    path = path_of(config)
    result = []
    for name, entry in _raw(path).items():
        try:
            result.append(Record.model_validate(entry))
        except ValidationError as error:
            raise ConfigError(f"'{path}', record '{name}': {explain(error, Record)} {_AGAIN}") from None
    return result


def load(config: RobotConfig) -> dict[str, Calibration]:
    """Return the calibration of each device; its driver checks that the same device answers.

    Raises:
        ConfigError: The file cannot be read, a record was edited, or its conditions have changed.
    """
    return {record.device: checked(config, record) for record in records(config) if record.device in config.devices}


def uncalibrated(config: RobotConfig, stored: Iterable[str]) -> list[str]:
    """Return the devices that could be calibrated but are not, without simulated devices."""
    done = set(stored)
    return [
        name
        for name, entry in config.devices.items()
        if name not in done
        and config.buses[entry.bus].interface not in SIMULATED
        and "zero" in registry.equipment(config, name)[0].Settings.model_fields
    ]


def checked(config: RobotConfig, record: Record) -> Calibration:
    """Check a record and return its calibration.

    Raises:
        ConfigError: The record was edited, or its conditions have changed.
    """
    where = f"The calibration of '{record.device}' in '{path_of(config)}'"
    if record.hash != record.seal:
        raise ConfigError(f"{where} was edited: its hash does not fit. {_AGAIN}")
    now = measured_with(config, record.device, record.settings)
    for key in sorted({*now, *record.measured_with}):
        before, after = record.measured_with.get(key), now.get(key)
        if before != after:
            raise ConfigError(
                f"{where} was measured with {key} {_text(before)}, the robot file has {_text(after)} now. {_AGAIN}"
            )
    return Calibration(record.identity, record.settings)


def _text(value: Any) -> str:
    return "not given" if value is None else str(value)


def sealed(record: Record) -> Record:
    """Return the record with the present time and its hash."""
    dated = record.model_copy(update={"date": datetime.now(UTC).isoformat(timespec="seconds"), "hash": ""})
    return dated.model_copy(update={"hash": dated.seal})


def save(config: RobotConfig, record: Record) -> Path:
    """Save a sealed record, which replaces any other of this device or of this identity.

    The file is replaced as a whole; a copy of the old file has the suffix `KEPT`.

    Raises:
        ConfigError: The present file cannot be read, or the folder cannot be written.
    """
    path = path_of(config)
    try:
        with _locked(path.parent) as folder:
            entries = {
                name: entry
                for name, entry in _raw(path).items()
                if name != _name(record) and not (isinstance(entry, dict) and entry.get("device") == record.device)
            }
            entries[_name(record)] = record.model_dump(mode="json")
            if path.exists():
                _replace(path.with_name(path.name + KEPT), path.read_bytes())
            _replace(path, (_HEAD + yaml.safe_dump(entries, sort_keys=False, width=120)).encode())
            os.fsync(folder)
    except OSError as error:
        raise ConfigError(f"The calibration cannot be saved in '{path}': {error.strerror}.") from None
    return path


@contextmanager
def _locked(folder: Path) -> Iterator[int]:
    """Keep other processes from saving in a folder; yield its handle."""
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX)
        yield handle
    finally:
        os.close(handle)


def _replace(path: Path, data: bytes) -> None:
    """Write a file in one step; one that a killed process has begun is written anew, and a link is not followed."""
    part = path.with_name(path.name + PART)
    flags = os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_NOFOLLOW | os.O_CLOEXEC
    try:
        with os.fdopen(os.open(part, flags, 0o666), "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        part.replace(path)
    except OSError:
        part.unlink(missing_ok=True)
        raise


def _name(record: Record) -> str:
    return record.identity or f"unknown:{record.device}"


def _raw(path: Path) -> dict[str, Any]:
    try:
        raw = parse_yaml(path.read_text())
    except FileNotFoundError:
        return {}
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        reason = " ".join(str(error).split())
        raise ConfigError(f"Calibrations '{path}' cannot be read: {reason}. Move the file away.") from None
    if raw is None:
        return {}
    if not isinstance(raw, dict):
        raise ConfigError(f"Calibrations '{path}' are not a mapping. Move the file away.")
    return raw
