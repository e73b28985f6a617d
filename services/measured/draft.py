"""Draft of a description of measured data: signals, units, time and faults of a recording, guessed from its files."""

import json
import re
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from gemuco.errors import DatasetError
from hal.calibration.units import CONVERSIONS, factor
from services.measured.alignment import are_apart, usual_steps
from services.measured.column_groups import Column, Group, grouped, unit_in
from services.measured.episode_files import Recording, read_recording

ENOUGH = 20_000
"""A draft thins a recording of more rows out to about this many."""
BRIDGED = 3.0
"""Samples of a signal are interpolated if they are at most this many steps of the slowest signal apart."""
PAUSE = 10.0
"""A pause longer than this many usual steps begins another episode."""
TIMES = {"time", "timestamp", "stamp", "t", "sec", "secs", "seconds", "ts", "date", "datetime", "clock", "received"}
"""A column whose name has one of these words may be the time."""
EPISODES = {"episode", "trial", "run", "rep", "repetition", "segment", "traj", "trajectory"}
"""A column whose name has one of these words may be the number of the episode."""
MARK = "unit not known: write it here"
"""A line of the draft that has this mark awaits a unit."""


@dataclass(frozen=True, slots=True)
class Clock:
    """Time of a recording.

    Attributes:
        column: The column with the stamps.
        unit: Unit of the stamps in the file.
        step: Usual step between rows [s].
        gap: Pause that begins another episode [s].
        pauses: Number of longer pauses inside files.
        longest: The longest pause [s].
        back: Number of steps back inside files.
        repeated: Number of rows with the stamp of the row before.
    """

    column: Column
    unit: str
    step: float
    gap: float
    pauses: int
    longest: float
    back: int
    repeated: int

    @property
    def rate(self) -> float:
        """Rows per second [Hz]."""
        return 1.0 / self.step


@dataclass(frozen=True, slots=True)
class Alignment:
    """Interpolation of rows that hold some of the signals only.

    Attributes:
        rate: Rows per second after it [Hz].
        pause: Samples further apart than this are not interpolated [s].
        reason: Words on the rows.
    """

    rate: float
    pause: float
    reason: str


@dataclass(frozen=True, slots=True)
class Draft:
    """Everything that was guessed of a recording.

    Attributes:
        name: Name of the recording.
        recording: Its files and columns.
        groups: Signals.
        clock: Time; None if no column is the time.
        episode: Column with the number of the episode; None if no column is.
        unused: Column -> reason for leaving it out.
        alignment: How the rows are interpolated; None if every row has all signals.
    """

    name: str
    recording: Recording
    groups: tuple[Group, ...]
    clock: Clock | None
    episode: Column | None
    unused: dict[str, str]
    alignment: Alignment | None = None

    @property
    def unknown(self) -> list[str]:
        """Signals whose unit is not known."""
        return [group.name for group in self.groups if group.unit is None]

    @property
    def omissions(self) -> list[str]:
        """Sentences on columns that are not used."""
        reasons = dict.fromkeys(self.unused.values())
        columns = {reason: [name for name, own in self.unused.items() if own == reason] for reason in reasons}
        return [f"Not used ({reason}): {', '.join(names)}." for reason, names in columns.items()]

    @property
    def every(self) -> int:
        """Of this many rows the draft uses one."""
        return 1 if self.alignment is not None else max(1, round(self.recording.rows / ENOUGH))

    def text(self, base: Path | None = None) -> str:
        """Return the description as YAML.

        Args:
            base: Folder in which the patterns of the episodes are searched; that of the recording if not given.
        """
        style, folder = self.recording.style, self.recording.folder
        inner = Path() if base is None else folder.relative_to(base.resolve())
        patterns = [(inner / pattern).as_posix() for pattern in self.recording.patterns]
        lines = [f"recording: {_quoted(self.name)}", f"episodes: [{', '.join(map(_quoted, patterns))}]"]
        lines += [f"separator: {json.dumps(style.separator)}"] if style.separator != "," else []
        lines += [f"decimal: {json.dumps(style.decimal)}"] if style.decimal != "." else []
        lines += ["header: false   # columns are numbered from 0"] if not style.header else []
        if self.recording.is_ragged and self.alignment is None:
            lines.append("cut_to_shortest: true   # the files of an episode have different numbers of rows")
        if style.names:
            lines.append(f"names: {_quoted(style.names)}   # the message of each row")
        lines += [
            "",
            "# A signal is what is lost, estimated or commanded together. Divide or join them as your robot is built.",
        ]
        lines += ["signals:", *(self._signal(group) for group in self.groups), ""]
        if self.clock is not None:
            place = _place(self.clock.column, self.alignment is not None)
            unit = "" if self.clock.unit == "s" else f", written_in: {self.clock.unit}"
            lines.append(
                f"time: {{{place}{unit}, gap: {self.clock.gap:g}}}   # a longer pause [s] begins another episode"
            )
        if self.episode is not None:
            lines.append(f"episode: {{{_place(self.episode)}}}   # another number begins another episode")
        lines += self._thinning()
        lines.append('# conditions: {"run_1*": light, "run_2*": heavy}   # if the body differed: tool, load, wear')
        if self.unused:
            lines += ["", *(f"# {sentence}" for sentence in self.omissions)]
        return "\n".join(lines) + "\n"

    def _signal(self, group: Group) -> str:
        unit, si = group.unit, CONVERSIONS.get(group.unit or "", ("", 0.0))[0]
        units = f"unit: {_quoted(si)}, written_in: {_quoted(str(unit))}" if si else f"unit: {_quoted(unit or '1')}"
        remarks = [MARK] if unit is None else ["unit guessed from the name"] if group.is_guess else []
        dead = [column.label for column in group.columns if column.is_dead]
        if dead:
            remarks.append(f"never vary: {', '.join(dead)}")
        return f"  {_quoted(group.name)}: {{{units}, {_places(group.columns)}}}" + (
            f"   # {'; '.join(remarks)}" if remarks else ""
        )

    def _thinning(self) -> list[str]:
        if self.alignment is not None:
            return [
                f"rate: {self.alignment.rate:g}   # [Hz] {self.alignment.reason}, so all are interpolated at it",
                f"interpolate: {self.alignment.pause:g}   # [s] longer pauses of a signal are not bridged",
            ]
        if self.every == 1:
            return []
        if self.clock is None:
            return [f"every: {self.every}   # one of {self.every} rows is used; 1 uses all {self.recording.rows}"]
        rate = float(f"{self.clock.rate / self.every:.2g}")
        return [
            f"rate: {rate:g}   # [Hz] of {self.clock.rate:.4g}; delete this line to use all {self.recording.rows} rows"
        ]


def draft(paths: list[Path]) -> Draft:
    """Guess the description of files or folders.

    Raises:
        DatasetError: A file cannot be read, or no column can be a signal.
    """
    for path in paths:
        if path.suffix in (".yaml", ".yml"):
            raise DatasetError(f"'{path}' is no table; describe needs the table that a description is to be made of.")
    recording = read_recording(paths)
    unused: dict[str, str] = dict.fromkeys(recording.texts, "holds text")
    columns = [column for column in recording.columns if column.label not in unused]
    names = recording.messages
    clock, others = _clock(recording, columns, is_bus=names is not None)
    if names is not None and clock is not None:
        recording = read_recording(paths, names, (clock.column.label,))
        clock = replace(clock, column=next(c for c in recording.columns if c.label == clock.column.label))
        columns, others = [column for column in recording.columns if not column.is_dead], []
        unused = {column.label: "never varies" for column in recording.columns if column.is_dead}
    alignment = _alignment(recording, clock, columns)
    if clock is not None and alignment is not None:
        clock = replace(clock, gap=max(clock.gap, BRIDGED * alignment.pause))
        columns = [column for column in columns if column.label != clock.column.label or column is clock.column]
        others = [column for column in others if column.label != clock.column.label]
    unused |= {_label(column): "another time" for column in others}
    columns = [column for column in columns if column is not (clock and clock.column) and column not in others]
    episode = next((column for column in columns if _is_episode(column)), None)
    columns = [column for column in columns if column is not episode]
    for column in [column for column in columns if _is_counter(recording, column)]:
        unused[_label(column)] = "counts the rows"
        columns.remove(column)
    name = re.sub(r"\W+", "_", _stem(recording, paths)).strip("_") or "recording"
    groups = grouped(columns, name)
    for group in [group for group in groups if all(column.is_dead for column in group.columns)]:
        unused |= {_label(column): "never varies or was never measured" for column in group.columns}
        groups.remove(group)
    if not groups:
        raise DatasetError(
            f"No column of '{paths[0]}' is a signal: {', '.join(f'{n} {r}' for n, r in unused.items())}."
        )
    return Draft(name, recording, tuple(groups), clock, episode, unused, alignment)


def _alignment(recording: Recording, clock: Clock | None, columns: list[Column]) -> Alignment | None:
    """Return how rows that hold some of the signals only are interpolated; None if every row has most signals."""
    if clock is None:
        return None
    label = clock.column.label
    if any(len(tables) > 1 for tables in recording.episodes):
        has_clocks = all(label in table.columns for tables in recording.episodes for table in tables.values())
        if not recording.is_ragged or not has_clocks or clock.column.is_numbered:
            return None
        reason = "each file has stamps of its own"
    else:
        labels = [column.label for column in columns]
        tables = [table for own in recording.episodes for table in own.values()]
        if not recording.style.names and not any(
            are_apart(np.stack([table.columns[name] for name in labels], axis=1)) for table in tables
        ):
            return None
        reason = "a row has some of the signals only"
    scale, between, length = factor("s", clock.unit), [np.zeros(0)], 0.0
    for own in recording.episodes:
        stamps = [table.columns[label] * scale for table in own.values()]
        for table, times in zip(own.values(), stamps, strict=True):
            values = [part for name, part in table.columns.items() if name != label]
            between += [usual_steps(times, np.stack(values, axis=1))] if values else []
        known = np.concatenate(stamps)
        known = known[np.isfinite(known)]
        length += float(np.ptp(known)) if len(known) else 0.0
    steps = np.concatenate(between)
    steps = steps[np.isfinite(steps)]
    if not len(steps):
        return None
    rate = min(1.0 / float(np.median(steps)), ENOUGH / max(length, 1e-9))
    return Alignment(float(f"{rate:.2g}"), float(f"{BRIDGED * steps.max():.2g}"), reason)


def _stem(recording: Recording, paths: list[Path]) -> str:
    return paths[0].resolve().stem if len(recording.episodes) == 1 else recording.folder.name


def _label(column: Column) -> str:
    label = f"column {column.label}" if column.is_numbered else column.label
    return label if column.file is None else f"{column.file} {label}"


def _clock(recording: Recording, columns: list[Column], is_bus: bool) -> tuple[Clock | None, list[Column]]:
    """Return the time, and the other columns that could be; on a bus every row is another message."""
    candidates = [column for column in columns if _is_time(recording, column)]
    if not candidates:
        return None, []
    plain = [column for column in candidates if unit_in(column.label)[0].lower() in TIMES]
    best = (plain or candidates)[0]
    parts = recording.parts(best)
    steps = np.concatenate([np.diff(part[np.isfinite(part)]) for part in parts])
    unit = _time_unit(best, steps, is_bus)
    steps = steps * factor("s", unit)
    step = float(np.median(steps[steps > 0.0]))
    gap = float(f"{PAUSE * step:.2g}")
    counts = int((steps > gap).sum()), float(steps.max()), int((steps < 0.0).sum()), int((steps == 0.0).sum())
    return Clock(best, unit, step, gap, *counts), [column for column in candidates if column is not best]


def _is_time(recording: Recording, column: Column) -> bool:
    """Whether a column rises all the time, and is named or numbered as a time is."""
    parts = [part[np.isfinite(part)] for part in recording.parts(column)]
    steps = np.concatenate([np.diff(part) for part in parts])
    if not len(steps) or not (steps > 0.0).any():
        return False
    words = set(re.split(r"[^a-z]+", unit_in(column.label)[0].lower()))
    if words & TIMES:
        return float((steps >= 0.0).mean()) > 0.9
    even = bool((steps > 0.0).all() and np.ptp(steps) < 0.5 * np.median(steps))
    if column.is_numbered:
        return even and not np.all(steps == 1.0) and (column.label == "0" or "time" in str(column.file))
    return False


def _time_unit(column: Column, steps: np.ndarray, is_bus: bool) -> str:
    """Return the unit of stamps: that of the name, or the one for which they are a date or a usual step.

    The messages of a bus follow each other faster than every half second.
    """
    _, unit = unit_in(column.label)
    if unit in ("s", "ms", "us", "ns", "min"):
        return unit
    first = float(np.nanmax(np.abs(column.values)))
    for limit, dated in ((1e17, "ns"), (1e14, "us"), (1e11, "ms"), (1e8, "s")):
        if first > limit:
            return dated
    usual = float(np.median(steps[steps > 0.0]))
    return "ms" if (usual >= 2.0 and np.all(steps == np.round(steps))) or (is_bus and usual > 0.5) else "s"


def _is_episode(column: Column) -> bool:
    known = column.values[np.isfinite(column.values)]
    words = set(re.split(r"[^a-z]+", column.label.lower()))
    changes = int((np.diff(known) != 0.0).sum())
    return bool(words & EPISODES) and bool(np.all(known == np.round(known))) and 0 < changes < len(known) / 5


def _is_counter(recording: Recording, column: Column) -> bool:
    parts = [np.diff(part[np.isfinite(part)]) for part in recording.parts(column)]
    return all(len(part) > 1 and bool(np.all(part == 1.0)) for part in parts)


def _place(column: Column, of_every_file: bool = False) -> str:
    file = "" if column.file is None or of_every_file else f"file: {_quoted(column.file)}, "
    return f"{file}columns: {_quoted(column.label)}"


def _places(columns: tuple[Column, ...]) -> str:
    """Return file and columns, as a range if they are one."""
    if len(columns) == 1:
        return _place(columns[0])
    file = "" if columns[0].file is None else f"file: {_quoted(columns[0].file)}, "
    labels = [column.label for column in columns]
    splits = [re.match(r"^(.*?)(\d+)(\D*)$", label, re.DOTALL) for label in labels]
    if all(splits):
        heads = {(match[1], match[3]) for match in splits if match}
        numbers = [match[2] for match in splits if match]
        is_row = all(int(after) == int(before) + 1 for before, after in pairwise(numbers))
        is_plain = all(not number.startswith("0") or number == "0" for number in numbers)
        if len(heads) == 1 and is_row and (is_plain or len({len(number) for number in numbers}) == 1):
            head, tail = heads.pop()
            return f"{file}columns: {json.dumps(f'{head}{{{numbers[0]}..{numbers[-1]}}}{tail}', ensure_ascii=False)}"
    return f"{file}columns: [{', '.join(map(_quoted, labels))}]"


def _quoted(text: str) -> str:
    """Return text as YAML reads it, in quotes where it needs some."""
    words = {"yes", "no", "on", "off", "true", "false", "null"}
    is_plain = re.fullmatch(r"[A-Za-z_][\w/.\-]*( m+)?", text) and text.lower() not in words
    return text if is_plain or (text.isdigit() and text != "1") else json.dumps(text, ensure_ascii=False)
