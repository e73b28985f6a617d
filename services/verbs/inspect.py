"""`gemuco inspect`: find sensors that lied in measured tables or recordings, and write what they should have read."""

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import typer
from rich.table import Table

from gemuco import checkpoint
from gemuco.errors import DatasetError
from gemuco.schema import BodySchema
from gemuco.signals import Layout
from gemuco.trust.inspection import Inspection, Inspector, Lie
from gemuco.writing import replace, writing
from hal.config import load_robot
from hal.errors import ConfigError
from services import show
from services.measured import description
from services.measured.reading import Timed, read_timed
from services.measured.table_files import is_table
from services.model import artifacts
from services.model.living_model import load_model
from services.model.model_config import CollectConfig, collect_config
from services.recording.dataset import is_recording, select


def run_inspection(file: Path, data: Sequence[Path], model: Path | None, rate: float | None, out: Path | None) -> None:
    """Print the lies in recorded data; arguments are those of the verb.

    Raises:
        SchemaError: Data, model or description do not fit.
        RecordingError: A recording cannot be read.
    """
    if is_table(file):
        raise ConfigError(f"'{file}' holds data. Name the description that `gemuco train` used, and this with --data.")
    schema, timed = _tables(file, data, model) if description.is_description(file) else _recordings(file, data, model)
    rate = rate or timed.rate
    if rate is None:
        raise DatasetError("The tables have no time, so their rate is not known; give the rows per second with --rate.")
    inspector, table, count = Inspector(schema, rate), _table(), 0
    with show.progress("inspecting") as progress:
        for number, (name, episode) in enumerate(zip(timed.names, timed.dataset.episodes, strict=True)):
            progress(number / len(timed.names), name)
            known = {signal: episode.values[signal] for signal in schema.layout.names if signal in episode.values}
            own = schema.under(episode.condition) if episode.condition in schema.biases else schema
            result = inspector.inspect(known, own)
            for lie in result.lies:
                table.add_row(*_line(name, lie, schema.layout))
            count += sum(lie.is_hidden for lie in result.lies)
            if out is not None:
                _write(out / f"{number:03d}_{re.sub(r'[^A-Za-z0-9_-]+', '_', name)}.csv", result, schema.layout, rate)
    if table.row_count:
        show.console().print(table)
    seconds = len(timed.dataset) / rate
    typer.echo(f"{count} lies in {len(timed.names)} episodes, {seconds / 60.0:.1f} min at {rate:g} rows per second.")
    if out is not None:
        typer.echo(f"Written to {out}; the last column names what is an estimate.")


def _tables(file: Path, data: Sequence[Path], model: Path | None) -> tuple[BodySchema, Timed]:
    """Return the model and the episodes of tables that a description fits."""
    config = description.load_measured(file)
    schema = checkpoint.load(model or artifacts.model_folder(config.recording))
    parts = []
    for place in data:
        if is_recording(place):
            raise DatasetError(f"'{place}' is a recording of a robot; name the robot file in place of '{file}'.")
        own = config.model_copy(update={"together": ()})
        if place.is_file():
            own = own.model_copy(update={"episodes": (place.name,)})
        elif not any(True for pattern in config.episodes for _ in place.glob(pattern)):
            own = own.model_copy(update={"episodes": ("*",)})
        parts.append(read_timed(own, place.parent if place.is_file() else place, typer.echo))
    episodes = tuple(episode for part in parts for episode in part.dataset.episodes)
    rates = [part.rate for part in parts if part.rate is not None]
    dataset = parts[0].dataset.__class__(parts[0].dataset.layout, episodes)
    return schema, Timed(dataset, tuple(name for part in parts for name in part.names), rates[0] if rates else None)


def _recordings(file: Path, data: Sequence[Path], model: Path | None) -> tuple[BodySchema, Timed]:
    """Return the model and the samples of a robot's recordings; a gap begins another episode."""
    robot = load_robot(file)
    wrong = next((path for path in data if not is_recording(path)), None)
    if wrong is not None:
        raise DatasetError(f"'{wrong}' is no recording (.mcap). Measured tables need the description of their columns.")
    schema = load_model(robot, model or artifacts.model_folder(robot.robot))
    selection = select(robot, data)
    typer.echo(selection.sentence())
    rate = (collect_config(robot) if robot.collect else CollectConfig()).rate
    names = tuple(f"part {number + 1}" for number in range(len(selection.dataset.episodes)))
    return schema, Timed(selection.dataset, names, rate)


def _table() -> Table:
    table = Table("episode")
    for head in ("from [s]", "to [s]"):
        table.add_column(head, justify="right")
    table.add_column("wrong")
    table.add_column("kind")
    table.add_column("error", justify="right")
    table.add_column("used, because")
    return table


def _line(name: str, lie: Lie, layout: Layout) -> tuple[str, ...]:
    """Return a row of the table."""
    what = {"environment": "another tool or load", "body": "the body, no sensor explains it"}.get(lie.cause)
    joined = {"either": " or ", "all": " and ", "part": " and "}.get(lie.cause, ", ").join(lie.elements)
    unit = layout.signal(lie.elements[0].partition(".")[0]).unit if lie.elements else ""
    size = f"{lie.size:.3g} {unit}" if np.isfinite(lie.size) else ""
    return name, f"{lie.start:.1f}", f"{lie.end:.1f}", what or joined, lie.kind, size, lie.reason


def _write(path: Path, result: Inspection, layout: Layout, rate: float) -> None:
    """Write the samples with estimates in place of what was hidden."""
    values, hidden = layout.join(result.values), layout.join(result.hidden) > 0.0
    names = [layout.element(index) for index in range(layout.size)]
    units = [layout.signal(name.partition(".")[0]).unit for name in names]
    path.parent.mkdir(parents=True, exist_ok=True)
    lines = [["time [s]", *(f"{name} [{unit}]" for name, unit in zip(names, units, strict=True)), "estimated"]]
    for number, (row, wrong) in enumerate(zip(values, hidden, strict=True)):
        estimated = " ".join(name for name, is_wrong in zip(names, wrong, strict=True) if is_wrong)
        lines.append(
            [f"{number / rate:.6g}", *(f"{value:.9g}" if np.isfinite(value) else "" for value in row), estimated]
        )
    text = "".join(",".join(line) + "\n" for line in lines)
    with writing("The inspected episode", path):
        replace(path, text.encode())
