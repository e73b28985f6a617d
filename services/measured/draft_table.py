"""The draft of a description as a table: what was recognised in measured data."""

import numpy as np
from rich.console import Console
from rich.table import Table

from services.measured.draft import Draft


def show_draft(result: Draft, console: Console) -> None:
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
