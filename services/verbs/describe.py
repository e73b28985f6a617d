"""The verbs of measured data: describe them, to train from, and inspect them for sensors that lied."""

import shlex
from pathlib import Path
from typing import Annotated

import typer

from services.errors import ServiceError
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
    from gemuco.writing import replace, writing
    from services import show
    from services.measured.draft import draft
    from services.measured.draft_table import show_draft

    result = draft(files)
    path = out or Path(f"{result.name}.yaml")
    if path.exists():
        raise ServiceError(f"'{path}' exists already. Remove it, or name another file with --out.")
    here, folder = path.resolve().parent, result.recording.folder
    is_below = folder.is_relative_to(here)
    with writing("The description", path):
        replace(path, result.text(here if is_below else None).encode())
    show_draft(result, show.console())
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
