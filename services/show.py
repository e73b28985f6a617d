"""Console output of all verbs: tables, and a progress bar for work of more than two seconds."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich import progress as bars
from rich.console import Console

WIDE = 200
"""Without a terminal, output has this many columns, so that a line of a table stays one line in a file or a pipe."""
Progress = Callable[[float, str], None]
"""A function of this type takes the share done, 0 to 1, and a line of text."""


def console() -> Console:
    """Return the console for tables: standard output, as wide as the terminal."""
    terminal = Console(highlight=False)
    return terminal if terminal.is_terminal else Console(highlight=False, width=WIDE)


@contextmanager
def progress(title: str, console: Console | None = None) -> Iterator[Progress]:
    """Show a progress bar on stderr, and yield the function that moves it."""
    columns = (
        bars.TextColumn("[bold]{task.fields[title]}"),
        bars.BarColumn(),
        bars.TextColumn("{task.description}"),
        bars.TimeRemainingColumn(),
    )
    with bars.Progress(*columns, console=console or Console(stderr=True), transient=True) as bar:
        task = bar.add_task("", total=1.0, title=title)
        yield lambda done, text: bar.update(task, completed=done, description=text)
