"""What takes over two seconds shows how far it is."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

WIDE = 200
"""Columns where no terminal says how many there are, so that a line of a table stays a line in a file or a pipe."""
Tell = Callable[[float, str], None]


def console() -> Console:
    """Where tables go: standard output, as wide as the terminal."""
    found = Console(highlight=False)
    return found if found.is_terminal else Console(highlight=False, width=WIDE)


@contextmanager
def progress(title: str, console: Console | None = None) -> Iterator[Tell]:
    """A bar on stderr; call what is yielded with the share done, 0 to 1, and a line of text."""
    columns = (
        TextColumn("[bold]{task.fields[title]}"),
        BarColumn(),
        TextColumn("{task.description}"),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=console or Console(stderr=True), transient=True) as bar:
        task = bar.add_task("", total=1.0, title=title)
        yield lambda done, text: bar.update(task, completed=done, description=text)
