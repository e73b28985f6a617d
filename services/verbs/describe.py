"""The verbs of measured data: describe them, to train from, and inspect them for sensors that lied."""

import shlex
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.console import Console
from rich.table import Table

from gemuco.writing import replace, writing
from services import show
from services.errors import ServiceError
from services.measured.draft import Draft, draft
from services.verbs.verb import report_errors


def register(app: typer.Typer) -> None:
    """Add the verb to the command line."""
    app.command()(describe)
    app.command()(inspect)


@report_errors
def describe(
    files: Annotated[
        list[Path],
        typer.Argument(metavar="FILE...", help="Tables (.csv and other text, .npz, .parquet) or folders of them."),
    ],
    out: Annotated[
        Path | None, typer.Option(help="The description to write; the name of the recording with .yaml if not given.")
    ] = None,
) -> None:
    """Draft a description of measured data: separator, signals, units, time, faults.

    `gemuco train` accepts the draft as it is. Write the units that are marked in it, and check the signals. Files of
    one call are episodes of one recording; a folder of files with different columns is one episode.
    """
    result = draft(files)
    path = out or Path(f"{result.name}.yaml")
    if path.exists():
        raise ServiceError(f"'{path}' exists already. Remove it, or name another file with --out.")
    here, folder = path.resolve().parent, result.recording.folder
    is_below = folder.is_relative_to(here)
    with writing("The description", path):
        replace(path, result.text(here if is_below else None).encode())
    _show(result, show.console())
    typer.echo(f"Written to {path}.")
    if result.unknown:
        typer.echo(f"Units are not known of {', '.join(result.unknown)}: write them where {path} marks it.")
    data = "" if is_below else f" --data {shlex.quote(str(folder))}"
    typer.echo(f"Next: gemuco train {shlex.quote(str(path))}{data}")


@report_errors
def inspect(
    file: Annotated[
        Path, typer.Argument(metavar="FILE", help="The description of measured tables that `gemuco train` used.")
    ],
    data: Annotated[
        list[Path],
        typer.Option(help="What to inspect: a table, or a folder of tables; repeat for more."),
    ],
    model: Annotated[Path | None, typer.Option(help="Folder of the model; runs/<name>/model if not given.")] = None,
    rate: Annotated[
        float | None, typer.Option(min=1e-3, metavar="HZ", help="Rows per second, if the tables have no time.")
    ] = None,
    out: Annotated[
        Path | None, typer.Option(metavar="FOLDER", help="Write each episode with estimates in place of lies as CSV.")
    ] = None,
) -> None:
    """Find sensors that lied in measured tables: frozen, off, drifting, clipped, swapped.

    The model must be trained from other data, in which all sensors were right.
    """
    from services.verbs.inspect import run_inspection

    run_inspection(file, data, model, rate, out)


def _show(result: Draft, console: Console) -> None:
    """Print signals, time and faults."""
    recording, clock = result.recording, result.clock
    table = Table()
    for title in ("signal", "elements", "unit in the file", "smallest", "largest", "not measured", "never vary"):
        table.add_column(title, justify="left" if title in ("signal", "unit in the file") else "right")
    for group in result.groups:
        values = np.concatenate([column.values for column in group.columns])
        dead = sum(column.is_dead for column in group.columns)
        unit = "?" if group.unit is None else f"{group.unit} (guess)" if group.is_guess else group.unit
        limits = (f"{np.nanmin(values):.4g}", f"{np.nanmax(values):.4g}")
        table.add_row(
            group.name, str(len(group.columns)), unit, *limits, f"{np.isnan(values).mean():.1%}", str(dead or "")
        )
    console.print(table)
    count = len(recording.episodes)
    lines = [f"{recording.rows} rows in {count} {'file or folder' if count == 1 else 'files or folders'}."]
    if clock is None:
        lines.append(
            "No column is the time, so every file is one episode."
            if result.episode is None
            else "No column is the time."
        )
    else:
        lines.append(
            f"Time: {clock.column.label} in {clock.unit}, {clock.rate:.4g} rows per second; the longest step is "
            f"{clock.longest:.3g} s, {clock.pauses} are longer than {clock.gap:g} s, {clock.back} go back, "
            f"{clock.repeated} are 0."
        )
    if result.episode is not None:
        lines.append(f"Episodes by {result.episode.label}.")
    if (alignment := result.alignment) is not None:
        lines.append(f"As {alignment.reason}, all are interpolated at {alignment.rate:g} Hz.")
    if result.every > 1:
        lines.append(
            f"One of {result.every} rows is used, so that the first training is short; the draft says how to use all."
        )
    for line in lines + result.omissions + recording.notes:
        console.print(line, highlight=False, markup=False)
