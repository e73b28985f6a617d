"""A robot as rerun's entities, made from snapshots: values, the robot in 3D, log, health."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from services.watch.fields import element, tension_limits
from services.watch.frames import Frames
from services.watch.service_rows import Level
from services.watch.shapes import BALL, KNOB, ROD, Color, Shapes, Wires
from services.watch.signal_rows import Kind, SignalRow, signal_rows
from services.watch.snapshot import RobotSnapshot
from services.watch.trouble import Trouble, troubles

TIMELINE = "time"
SERIES = {"measured": 1.5, "estimated": 2.0, "low": 0.75, "high": 0.75}
"""Field of an element that is a series of its own, and the width of its line; a gap ends it."""
PALETTE = (0x4E98E2, 0x5CD6A9, 0xA395E2, 0xF5774D, 0xE27CB6, 0x8BD450, 0x49C7D8, 0xC9A36B, 0xE25B5B, 0x7F8FA9)
"""Colors of what is measured, by the place of the element in its signal."""
ESTIMATED, INTERVAL = 0xFFB04A, 0x99733F
"""Colors of an estimate, and of the ends of its interval."""
MOST_PLOTS = 3
"""At most this number of signals has a plot."""
LEVELS = {Level.GOOD: "INFO", Level.NOTE: "INFO", Level.DEGRADED: "WARN"}
"""Any other level is an error."""
WIRE = 0.025
"""Wires have this radius, as a share of the mean length of the robot's links."""


class RobotPicture:
    """Everything of one robot, as entities whose paths begin with its name.

    Args:
        robot: Name of the robot.
        stream: Stream of the file or viewer that takes the entities.
        frames: Frames of its URDF; None without one.
        wires: Its wires.
    """

    def __init__(
        self, robot: str, stream: rr.RecordingStream, frames: Frames | None = None, wires: Wires | None = None
    ) -> None:
        self._robot, self._stream, self._frames = robot, stream, frames
        self._shapes = Shapes(frames, wires)
        self._shown: dict[str, set[str]] = {}
        self._kinds: dict[str, tuple[Kind, str]] = {}
        self._present: dict[str, Trouble] = {}
        self._styled: set[str] = set()
        self._has_health = False

    def show(self, snapshot: RobotSnapshot, now_ns: int) -> None:
        """Send a snapshot at a time [ns since 1970]; a value that is neither measured nor estimated leaves a gap."""
        rows = [row for row in signal_rows(snapshot) if row.unit]
        self._stream.set_time(TIMELINE, timestamp=np.datetime64(now_ns, "ns"))
        places: dict[str, int] = {}
        for row in rows:
            self._put_value(row, places.setdefault(row.signal, 0))
            places[row.signal] += 1
        self._put_robot(rows, tension_limits(snapshot))
        self._put_events(snapshot, rows)

    def _put_value(self, row: SignalRow, place: int) -> None:
        path = f"{self._robot}/{row.signal}/{row.element}"
        fields = element(row)
        present = {name for name in SERIES if name in fields}
        for name in present:
            if f"{path}/{name}" not in self._styled:
                self._styled.add(f"{path}/{name}")
                color = {"measured": PALETTE[place % len(PALETTE)], "estimated": ESTIMATED}.get(name, INTERVAL)
                style = rr.SeriesLines(
                    colors=[(color << 8) | 0xFF], names=[f"{row.element} {name}"], widths=[SERIES[name]]
                )
                self._stream.log(f"{path}/{name}", style, static=True)
            self._stream.log(f"{path}/{name}", rr.Scalars(fields[name]))
        for name in self._shown.get(path, set()) - present:
            self._stream.log(f"{path}/{name}", rr.Clear(recursive=False))
        self._shown[path] = present

    def _put_robot(self, rows: Sequence[SignalRow], limits: Mapping[str, float]) -> None:
        shapes, frames = self._shapes, self._frames
        if frames is not None:
            shapes.follow(rows)
            poses = frames.poses(shapes.positions())
            for link, color in shapes.colors(rows).items():
                if link not in poses:
                    continue
                place = poses[link][0]
                ends = [frames.point(poses, link, end) for end in shapes.rods.get(link, ())]
                path = f"{self._robot}/robot/{link}"
                knob = rr.Points3D([place], radii=[KNOB * shapes.thick], colors=[_bytes(color)])
                self._stream.log(f"{path}/joint", knob)
                if ends:
                    strips = [[place, end] for end in ends]
                    rods = rr.LineStrips3D(strips, radii=[ROD * shapes.thick], colors=[_bytes(color)])
                    self._stream.log(f"{path}/rod", rods)
            lines = list(shapes.lines(rows, limits))
            if lines:
                drawn = rr.LineStrips3D(
                    [line.points for line in lines], radii=[WIRE * shapes.thick],
                    colors=[_bytes(line.color) for line in lines],
                )  # fmt: skip
                self._stream.log(f"{self._robot}/robot/wires", drawn)
        for point in shapes.points(rows):
            path = f"{self._robot}/robot/{point.signal}"
            if point.place is None:
                self._stream.log(path, rr.Clear(recursive=False))
            else:
                ball = rr.Points3D([point.place], radii=[BALL * shapes.thick], colors=[_bytes(point.color)])
                self._stream.log(path, ball)

    def _put_events(self, snapshot: RobotSnapshot, rows: Sequence[SignalRow]) -> None:
        """Log each element that changes its kind, and each trouble that begins or ends."""
        kinds = {row.name: (row.kind, row.distrust) for row in rows}
        if self._kinds:
            for name, (kind, why) in kinds.items():
                before = self._kinds.get(name, (kind, why))
                if before != (kind, why):
                    level = "INFO" if kind is Kind.MEASURED else "WARN"
                    self._log(f"{name} is {kind.value}{f': {why}' if why else ''} (was {before[0].value})", level)
        self._kinds = kinds
        present = {str(trouble): trouble for trouble in troubles(snapshot, rows)}
        for text, trouble in present.items():
            if text not in self._present:
                self._log(text, LEVELS.get(trouble.level, "ERROR"))
        for text in self._present.keys() - present.keys():
            self._log(f"over: {text}", "INFO")
        if self._present.keys() != present.keys() or not self._has_health:
            self._has_health = True
            lines = "\n".join(f"- {text}" for text in present) or "Healthy."
            self._stream.log(f"{self._robot}/health", rr.TextDocument(lines, media_type="text/markdown"))
        self._present = present

    def _log(self, text: str, level: str) -> None:
        self._stream.log(f"{self._robot}/log", rr.TextLog(text, level=level))


def blueprint(robot: str, signals: Mapping[str, str]) -> Any:
    """Return the arrangement of the views: the robot in 3D, plots of its first signals, log and health.

    Args:
        robot: Name of the robot.
        signals: Signal -> unit.
    """
    plotted = [name for name, unit in signals.items() if unit][:MOST_PLOTS]
    plots = [rrb.TimeSeriesView(origin=f"/{robot}/{name}", name=f"{name} [{signals[name]}]") for name in plotted]
    left = rrb.Vertical(
        rrb.Spatial3DView(origin=f"/{robot}/robot", name=robot),
        rrb.Horizontal(
            rrb.TextLogView(origin=f"/{robot}/log", name="log"),
            rrb.TextDocumentView(origin=f"/{robot}/health", name="health"),
        ),
        row_shares=[3, 1],
    )
    return rrb.Blueprint(rrb.Horizontal(left, rrb.Vertical(*plots)) if plots else left, collapse_panels=True)


def _bytes(color: Color) -> list[int]:
    """Return red, green and blue, 0 to 255; a shape has no opacity in rerun, so a faint one is dark."""
    *parts, opacity = color
    return [math.floor(255.0 * part * (0.4 + 0.6 * opacity) + 0.5) for part in parts]
