"""What was measured of a robot's devices, kept in a file beside the robot file that a person can read.

Each record belongs to one very device and is sealed by a hash, so that neither another device nor a slip of the editor
moves a joint. A record is refused when what it was measured with has changed since, as a gear or a number of counts.
"""

import hashlib
import json
import os
from collections.abc import Iterable, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import yaml
from pydantic import ValidationError

from hal import registry
from hal.calibration.line import Calibration, Point
from hal.config import RobotConfig, Section, explain
from hal.errors import ConfigError

SIMULATED = ("hub", "virtual")
"""Interfaces behind which there is nothing to be calibrated."""
KEPT = ".before"
"""Added to the name of the file as it was before the last change."""
WITHOUT_EFFECT = frozenset(
    (
        *("eds", "pdo", "master_id", "silent_after", "frozen_after", "periods", "heartbeat", "identity", "around"),
        *("mode", "command", "cyclic", "stiffness", "damping", "ramp", "profile", "velocity_unit", "temperature"),
        *("rated_torque", "max_torque", "max_velocity", "max_effort", "following_error"),
        *("watch_time", "watchdog", "watchdog_timeout", "allow_no_watchdog", "status", "bad_status", "error", "state"),
        *("open", "tare", "enable", "disable", "quick_stop", "reset"),
    )
)
"""Settings that do not change what a number of the device means; any other one makes a calibration void."""
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
    """`Device.identity`; empty if the device does not tell who it is."""
    settings: dict[str, Any]
    """Laid over the robot file's."""
    measured_with: dict[str, Any]
    """The driver and its other settings at the time."""
    unit: str
    points: tuple[Point, ...]
    residual: float
    """Largest difference [unit] between a known value and what the calibrated device would have read."""
    date: str = ""
    """When it was measured, UTC."""
    hash: str = ""

    @property
    def seal(self) -> str:
        """Hash of all the rest."""
        content = json.dumps(self.model_dump(exclude={"hash"}), sort_keys=True)
        return hashlib.sha256(content.encode()).hexdigest()[:16]


def path_of(config: RobotConfig) -> Path:
    """Where a robot's calibrations are."""
    return config.folder / f"{config.robot}.calibration.yaml"


def measured_with(config: RobotConfig, device: str, measured: Mapping[str, Any]) -> dict[str, Any]:
    """What a calibration of `measured` settings rests upon: the driver, and the settings that give counts a meaning."""
    settings = config.settings_of(device)
    kept = {key: value for key, value in settings.items() if key not in WITHOUT_EFFECT and key not in measured}
    return {"driver": config.kinds[config.devices[device].kind].driver, **json.loads(json.dumps(kept, default=str))}


def records(config: RobotConfig) -> list[Record]:
    """Every record of a robot, as it is in the file.

    Raises:
        ConfigError: The file cannot be read.
    """
    path = path_of(config)
    found = []
    for name, entry in _raw(path).items():
        try:
            found.append(Record.model_validate(entry))
        except ValidationError as error:
            raise ConfigError(f"'{path}', record '{name}': {explain(error, Record)} {_AGAIN}") from None
    return found


def load(config: RobotConfig) -> dict[str, Calibration]:
    """Device -> what is to be laid over its settings; whether the very device answers is for its driver to check.

    Raises:
        ConfigError: The file cannot be read, a record was edited, or what it was measured with has changed.
    """
    return {one.device: checked(config, one) for one in records(config) if one.device in config.devices}


def uncalibrated(config: RobotConfig, stored: Iterable[str]) -> list[str]:
    """Devices that go by the zero of the robot file though they could be calibrated; simulated ones need not be."""
    done = set(stored)
    return [
        name
        for name, entry in config.devices.items()
        if name not in done
        and config.buses[entry.bus].interface not in SIMULATED
        and "zero" in registry.equipment(config, name)[0].Settings.model_fields
    ]


def checked(config: RobotConfig, record: Record) -> Calibration:
    """The calibration of a record.

    Raises:
        ConfigError: It was edited, or what it was measured with has changed.
    """
    where = f"The calibration of '{record.device}' in '{path_of(config)}'"
    if record.hash != record.seal:
        raise ConfigError(f"{where} was edited: its hash does not fit. {_AGAIN}")
    now = measured_with(config, record.device, record.settings)
    for key in sorted({*now, *record.measured_with}):
        before, after = record.measured_with.get(key), now.get(key)
        if before != after:
            raise ConfigError(
                f"{where} was measured with {key} {_said(before)}, the robot file has {_said(after)} now. {_AGAIN}"
            )
    return Calibration(record.identity, record.settings)


def _said(value: Any) -> str:
    return "not given" if value is None else str(value)


def sealed(record: Record) -> Record:
    """The record with the time and its hash."""
    dated = record.model_copy(update={"date": datetime.now(UTC).isoformat(timespec="seconds"), "hash": ""})
    return dated.model_copy(update={"hash": dated.seal})


def save(config: RobotConfig, record: Record) -> Path:
    """Put a sealed record in the place of any other of that device or of that identity; other records stay.

    The file is replaced as a whole, and kept as it was under a name that ends in `KEPT`.

    Raises:
        ConfigError: The file that is there cannot be read, or the folder cannot be written.
    """
    path = path_of(config)
    kept = {
        name: entry
        for name, entry in _raw(path).items()
        if name != _name(record) and not (isinstance(entry, dict) and entry.get("device") == record.device)
    }
    kept[_name(record)] = record.model_dump(mode="json")
    text = _HEAD + yaml.safe_dump(kept, sort_keys=False, width=120)
    fresh = path.with_name(f"{path.name}.{os.getpid()}")
    try:
        with fresh.open("w") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        if path.exists():
            path.with_name(path.name + KEPT).write_bytes(path.read_bytes())
        fresh.replace(path)
    except OSError as error:
        fresh.unlink(missing_ok=True)
        raise ConfigError(f"The calibration cannot be kept in '{path}': {error.strerror}.") from None
    return path


def _name(record: Record) -> str:
    return record.identity or f"unknown:{record.device}"


def _raw(path: Path) -> dict[str, Any]:
    try:
        raw = yaml.safe_load(path.read_text())
    except FileNotFoundError:
        return {}
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        told = " ".join(str(error).split())
        raise ConfigError(f"Calibrations '{path}' cannot be read: {told}. Move the file away.") from None
    if raw is None:
        return {}
    if not isinstance(raw, dict):
        raise ConfigError(f"Calibrations '{path}' are not a mapping. Move the file away.")
    return raw
