"""Exceptions about values, data and stored models."""

from numbers import Integral


class SchemaError(Exception):
    """Base of all exceptions of `gemuco`."""


class UnknownSignal(SchemaError):
    """A signal or element is not part of the layout."""


class UnknownCondition(SchemaError):
    """The schema was not trained on this condition of the body."""


class WrongSize(SchemaError):
    """An array does not have as many elements as its signal."""


class WrongKind(SchemaError):
    """An argument has the wrong class."""


class NotFinite(SchemaError):
    """A value that must be a number is NaN or infinite."""


class NotObservable(SchemaError):
    """A value or command cannot be inferred from the available signals."""


class NotEnoughData(SchemaError):
    """There are too few samples."""


class DatasetError(SchemaError):
    """A data file is damaged, or is not a data file."""


class NotWritten(SchemaError):
    """A model or data cannot be stored: the disk is full, or the folder is not writable."""


class CheckpointError(SchemaError):
    """A stored model is missing, damaged, or of another version."""


def check_kind(what: str, value: object, kind: type | tuple[type, ...], needed: str) -> None:
    """Refuse a value of another class.

    Args:
        what: First words of the message, such as `The schema`.
        value: The argument.
        kind: Allowed classes.
        needed: Last words of the message, such as `a BodySchema`.

    Raises:
        WrongKind: The value is not an instance of an allowed class.
    """
    if not isinstance(value, kind):
        raise WrongKind(f"{what} must be {needed}, not {described(value)}.")


def described(value: object) -> str:
    """Return a short description of a value: `an array of shape (3,)`, `the class Signal`, `an int`."""
    if isinstance(value, type):
        return f"the class {value.__name__}"
    if hasattr(value, "shape"):
        return f"an array of shape {value.shape}"
    name = type(value).__name__
    return f"{'an' if name[0].lower() in 'aeiou' else 'a'} {name}"


def whole_number(what: str, value: object, least: int) -> None:
    """Refuse a value that is not a whole number or is below the least allowed one.

    Raises:
        SchemaError: The value is refused; the message begins with `what`.
    """
    if not isinstance(value, Integral):
        raise SchemaError(f"{what} is {value!r}; it must be a whole number.")
    if value < least:
        raise SchemaError(f"{what} is {value}; it must be at least {least}.")
