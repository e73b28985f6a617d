"""Mark of a training that runs, by which the next one knows that it was interrupted."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from gemuco.dataset import Dataset
from gemuco.errors import SchemaError
from gemuco.learning.draft import key_of
from gemuco.writing import replace, writing

MARK = "begun"
"""A running training has a file of this name beside its drafts."""


@contextmanager
def marked(drafts: Path, key: str) -> Iterator[bool]:
    """Mark a training while it runs, and yield whether the same training was interrupted before.

    The mark stays after Ctrl-C, a crash or a kill. It is removed when the training ends or is refused.

    Args:
        drafts: Folder of unfinished trainings.
        key: Hash of data and settings, see `key_of_training`.
    """
    mark = drafts / MARK
    was_interrupted = mark.exists() and mark.read_text() == key
    with writing("The training", mark):
        replace(mark, key.encode())
    try:
        yield was_interrupted
    except SchemaError:
        mark.unlink(missing_ok=True)
        raise
    mark.unlink(missing_ok=True)


def key_of_training(dataset: Dataset, *settings: object) -> str:
    """Return a hash of the data and the settings of a training."""
    return key_of(dataset.layout, dataset.conditions, dataset.condition_of_rows(), dataset.rows(), *settings)
