"""The robot file of an arm from a URDF, as text."""

import os
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from hal.finding.draft.parts import is_text
from simulators.nodes.canopen.spec import EDS_FOLDER
from simulators.robots.urdf_arm.choice import Arm, choose_arm, plain_name
from simulators.robots.urdf_arm.mjcf import convert, is_mjcf
from simulators.robots.urdf_arm.survey import ACCELERATION, Survey, survey
from simulators.robots.urdf_arm.tree import Tree, read_tree, tree_of

GEAR = 100
"""Drives have this many turns of the motor per turn of the joint."""
ON_ONE_BUS = 8
"""A bus has the drives and encoders of at most this many joints."""
SAMPLES, MANY, MORE = 3000, 6, 5000
"""The first number of samples is collected, and the last one of an arm with at least the second number of joints."""
FIRST_ENCODER = 31
"""The encoders have node ids from this one on; the drives from 1 on."""
TEXT = """\
# {title} `gemuco init` wrote this from {urdf}; docs/robots.md explains every section.
{notes}robot: {robot}
description: {description}

signals:
  joint_position:  # encoders behind the gears
    unit: rad
    elements: [{elements}]
    stale_after: 0.06
  motor_position: {{unit: rad, elements: [{elements}], stale_after: 0.06}}
  joint_effort: {{unit: N m, elements: [{elements}], stale_after: 0.06}}
  tool_tip_position: {{unit: m, elements: [x, y, z], source: vision, stale_after: 0.2}}

command: {{signal: motor_position, time_to_live: 0.1, hold: 1.0}}

# The URDF allows low: [{urdf_low}]
#                high: [{urdf_high}]
limits:
  motor_position:
    low: [{low}]
    high: [{high}]
    rate: [{rate}]
    acceleration: {acceleration:g}

stop: {{behaviour: hold}}

rates: {{hal: 100, estimation: 100, control: 25, anomaly: 25, update: 5}}

# From simulated to real hardware: interface: socketcan, channel: can0. Node ids, gears and zeros are then yours.
buses:
{buses}
kinds:
  drive: {{driver: cia402, settings: {{eds: eds/servo_drive.eds, counts_per_turn: 4096, gear: {gear}}}}}
  encoder: {{driver: cia406, settings: {{eds: eds/joint_encoder.eds, counts_per_turn: 262144}}}}

devices:
{devices}
simulator: simulators.robots.urdf_arm:simulator
urdf: {urdf}
tip: {tip}  # the link that the camera sees

collect: {{motion: "simulators.robots.urdf_arm:random_motion", samples: {samples}, rate: 10}}

model:
  # 0.5 is 70 % of a standard deviation: every signal is an output, and its expected error says how good it is.
  structure: {{threshold_out: 0.5, threshold_in: 0.5, epochs: 60, splits: 2}}
  control:
    target: joint_position
    speed: {speed:.3g}
"""


@dataclass(frozen=True, slots=True)
class Draft:
    """A robot file that is not written yet.

    Attributes:
        robot: Name of the robot.
        text: The robot file.
        sheets: EDS files that belong into the folder `eds` beside it.
        files: Path from the folder of the robot file -> content of a file that belongs there too.
        summary: Sentence on what was found.
        notes: Sentences on what was chosen, narrowed or guessed.
    """

    robot: str
    text: str
    sheets: tuple[Path, ...]
    summary: str
    notes: tuple[str, ...]
    files: Mapping[str, bytes] = field(default_factory=dict)


def draft(path: Path, tip: str | None, name: str | None, folder: Path) -> Draft:
    """Return the robot file of the arm in a URDF or MJCF file, to be written into a folder.

    Raises:
        ConfigError: The file is neither, or there is no arm in it that can move.
        ModuleNotFoundError: It is MJCF, and MuJoCo is not installed.
    """
    if not is_mjcf(path):
        return _draft(read_tree(path), _beside(path, folder), tip, name)
    converted, stem = convert(path), path.name.partition(".")[0]
    meshes = f"{stem}_meshes"
    with TemporaryDirectory() as scratch:  # the survey moves the arm before anything is written
        for mesh, content in converted.meshes.items():
            (Path(scratch) / mesh).write_bytes(content)
        tree = tree_of(ElementTree.fromstring(converted.text(scratch)), path)
        result = _draft(tree, f"{stem}.urdf", tip, name, converted.notes)
    used = {f"{meshes}/{mesh}": content for mesh, content in converted.meshes.items()}
    files = {f"{stem}.urdf": converted.text(meshes).encode(), **used}
    return replace(result, files=files)


def _draft(tree: Tree, urdf: str, tip: str | None, name: str | None, more: Sequence[str] = ()) -> Draft:
    path, arm = tree.path, choose_arm(tree, tip)
    ranges = survey(arm)
    robot = name or robot_name(tree.name or path.stem)
    notes = (*more, *arm.notes, *ranges.notes)
    mass = f"{len(arm.joints)} joints from {arm.joints[0].parent} to {arm.tip}"
    summary = f"{mass}, reach {arm.reach:.2f} m, largest torque {ranges.effort.max():.3g} N m."
    text = TEXT.format(
        title=f"{mass}.",
        urdf=_quoted(urdf),
        notes="".join(f"# {note}\n" for note in notes),
        robot=robot,
        description=f"'{len(arm.joints)} joints of {path.name}, reach {arm.reach:.2f} m'",
        elements=", ".join(arm.names),
        urdf_low=_row(joint.low for joint in arm.joints),
        urdf_high=_row(joint.high for joint in arm.joints),
        low=_row(ranges.low),
        high=_row(ranges.high),
        rate=_row(ranges.rate),
        acceleration=ACCELERATION,
        buses=_buses(robot, len(arm.joints)),
        gear=GEAR,
        devices=_devices(arm, ranges),
        tip=_quoted(arm.tip),
        samples=MORE if len(arm.joints) >= MANY else SAMPLES,
        speed=0.4 * float(ranges.rate.min()),
    )
    sheets = tuple(EDS_FOLDER / f"{kind}.eds" for kind in ("servo_drive", "joint_encoder"))
    return Draft(robot, text, sheets, summary, notes)


def robot_name(text: str) -> str:
    """Return a name of a robot made of a text: lower-case letters, digits and underscores."""
    name = re.sub(r"_+", "_", plain_name(text).lower()) or "arm"
    return name if name[0].isalpha() and is_text(name) else f"robot_{name}"


def _beside(path: Path, folder: Path) -> str:
    """Return the path of the URDF from the folder of the robot file."""
    return os.path.relpath(path.resolve(), folder.resolve())


def _quoted(text: str) -> str:
    """Return a text as YAML has it, in quotes if it has other characters than those of a path."""
    is_plain = re.fullmatch(r"[A-Za-z_./][\w./-]*", text) and is_text(text)
    return text if is_plain else "'" + text.replace("'", "''") + "'"


def _row(values: Iterable[float]) -> str:
    return ", ".join(f"{float(value):.4g}" for value in values)


def _bus_of(index: int, count: int) -> int:
    return 0 if count <= ON_ONE_BUS or index < (count + 1) // 2 else 1


def _buses(robot: str, count: int) -> str:
    return "".join(
        f"  can{bus}: {{interface: hub, channel: {robot}_can{bus}, bitrate: 1000000}}\n"
        for bus in range(1 + _bus_of(count - 1, count))
    )


def _devices(arm: Arm, ranges: Survey) -> str:
    lines, count = [], len(arm.names)
    for index, name in enumerate(arm.names):
        torque = max(0.001, round(float(ranges.effort[index]) / GEAR, 3))
        served = f"position: motor_position.{name}, effort: joint_effort.{name}"
        lines.append(
            f"  {name}_drive: {{kind: drive, bus: can{_bus_of(index, count)}, node: {1 + index}, "
            f"elements: {{{served}}}, settings: {{rated_torque: {torque:g}}}}}"
        )
    for index, name in enumerate(arm.names):
        zero = float(ranges.middle[index]) - np.pi  # half a turn away from the middle, where it wraps
        lines.append(
            f"  {name}_encoder: {{kind: encoder, bus: can{_bus_of(index, count)}, node: {FIRST_ENCODER + index}, "
            f"element: joint_position.{name}, settings: {{zero: {zero:.4f}}}}}"
        )
    return "\n".join(lines) + "\n"
