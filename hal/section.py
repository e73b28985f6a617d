"""A part of a file that people write: typed, frozen, and one sentence for what is wrong with it."""

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, ValidationError


class Section(BaseModel):
    """A part of the robot file: frozen, and without room for a misspelt key."""

    model_config = ConfigDict(extra="forbid", frozen=True)


Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Rate = Annotated[float, Field(gt=0, le=10_000, allow_inf_nan=False)]
"""Ticks per second [Hz], and no more than a loop in Python could ever do."""
Finite = Annotated[float, Field(allow_inf_nan=False)]


def explain(error: ValidationError, model: type[BaseModel]) -> str:
    """One problem in one sentence: an unknown key, with the keys that are known there, or else the first."""
    problems = error.errors()
    first = next((problem for problem in problems if problem["type"] == "extra_forbidden"), problems[0])
    where = ".".join(str(part) for part in first["loc"])
    if first["type"] == "extra_forbidden":
        fields = _model_at(model, first["loc"][:-1]).model_fields
        known = ", ".join(field.alias or name for name, field in fields.items())
        return f"unknown key '{where}'. Known keys there: {known}."
    message = first["msg"].removeprefix("Value error, ")
    more = f" (and {error.error_count() - 1} more)" if error.error_count() > 1 else ""
    sentence = f"{message.removesuffix('.')}{more}"
    return f"{where + ': ' if where else ''}{sentence}{'' if sentence.endswith('?') else '.'}"


def _model_at(model: type[BaseModel], location: tuple[int | str, ...]) -> type[BaseModel]:
    for part in location:
        field = model.model_fields.get(str(part))
        if field is None:
            continue  # a name inside a mapping, such as the device's
        inner = [field.annotation, *getattr(field.annotation, "__args__", ())]
        models = [kind for kind in inner if isinstance(kind, type) and issubclass(kind, BaseModel)]
        model = models[0] if models else model
    return model
