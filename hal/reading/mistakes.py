"""YAML as data, and the mistakes in a file as one sentence."""

import difflib
import re
from typing import Any

import yaml
from pydantic import BaseModel, ValidationError

NUMBERS = {
    "float_parsing": "a number",
    "float_type": "a number",
    "int_parsing": "a whole number",
    "int_type": "a whole number",
    "int_from_float": "a whole number",
}
"""Problem of pydantic -> the value that belongs there."""
BRANCHES = re.compile(r"constrained-.*|tuple\[.*|float|int|function-.*|list\[.*")
"""pydantic names the branch of a union by such words."""


def parse_yaml(text: str, loader: type[yaml.SafeLoader] = yaml.SafeLoader) -> Any:
    """Return the content of a YAML text.

    Raises:
        yaml.YAMLError: It is not YAML, is nested too deeply, or has a date or number that does not exist.
    """
    try:
        return yaml.load(text, loader)
    except RecursionError:
        raise yaml.YAMLError("It is nested too deeply.") from None
    except (ValueError, OverflowError) as error:  # such as 2025-13-01, or a number of 5000 digits
        raise yaml.YAMLError(f"A value cannot be read: {error}.") from None


def yaml_problem(error: yaml.YAMLError) -> str:
    """Return place and problem of a text that is not YAML."""
    mark, problem = getattr(error, "problem_mark", None), getattr(error, "problem", None)
    if mark is None or problem is None:
        return " ".join(str(error).split()).rstrip(".")
    hint = "; indent with spaces, not tabs" if "\\t" in problem else ""
    return f"line {mark.line + 1}, column {mark.column + 1}: {problem}{hint}"


def explain(error: ValidationError, model: type[BaseModel]) -> str:
    """Return one problem as a sentence: an unknown key with the known keys there, otherwise the first problem."""
    problems = error.errors()
    first = next((problem for problem in problems if problem["type"] == "extra_forbidden"), problems[0])
    where = ".".join(str(part) for part in first["loc"])
    if first["type"] == "extra_forbidden":
        fields = _model_at(model, first["loc"][:-1]).model_fields
        known = [field.alias or name for name, field in fields.items()]
        near = difflib.get_close_matches(str(first["loc"][-1]), known, 1)
        hint = f" Did you mean '{near[0]}'?" if near else ""
        return f"unknown key '{where}'. Known keys there: {', '.join(known)}.{hint}"
    message = first["msg"].removeprefix("Value error, ")
    if first["type"] in NUMBERS:  # in place of pydantic's words, and of the branch of a union that it names
        where = ".".join(str(part) for part in first["loc"] if not BRANCHES.fullmatch(str(part)))
        return f"{where}: {first['input']!r} is not {NUMBERS[first['type']]}."
    if first["type"] == "string_pattern_mismatch" and where == "robot":
        message = f"{first['input']!r} is no name of a robot: it has lower-case letters, digits and underscores"
    more = f" (and {error.error_count() - 1} more)" if error.error_count() > 1 else ""
    sentence = f"{message.removesuffix('.')}{more}"
    return f"{where + ': ' if where else ''}{sentence}{'' if sentence.endswith('?') else '.'}"


def _model_at(model: type[BaseModel], location: tuple[int | str, ...]) -> type[BaseModel]:
    for part in location:
        field = model.model_fields.get(str(part))
        if field is None:
            continue  # a key of a mapping, such as the name of a device
        inner = [field.annotation, *getattr(field.annotation, "__args__", ())]
        models = [kind for kind in inner if isinstance(kind, type) and issubclass(kind, BaseModel)]
        model = models[0] if models else model
    return model
