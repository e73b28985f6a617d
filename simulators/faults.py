"""Parts of a body that can break, such as `muscle_cut:biceps` and `heavy_object`."""

from collections.abc import Iterable, Sequence


class UnknownPart(ValueError):
    """The part cannot break; the message lists the parts that can."""


MUSCLE_CUT = "muscle_cut"
HEAVY_OBJECT = "heavy_object"
TOOL_CHANGED = "tool_changed"


def known_parts(muscles: Iterable[str]) -> list[str]:
    """Return every part of a muscle-driven body that can break."""
    return [*(f"{MUSCLE_CUT}:{muscle}" for muscle in muscles), HEAVY_OBJECT]


def check_part(part: str, muscles: Iterable[str]) -> tuple[str, str]:
    """Split a part into the kind of fault and the muscle (empty for the whole body).

    Raises:
        UnknownPart: The part is not known.
    """
    known = known_parts(muscles)
    if part not in known:
        raise UnknownPart(f"'{part}' is not a part that can break. Known parts: {', '.join(known)}.")
    kind, _, what = part.partition(":")
    return kind, what


def check_condition(condition: str | None, known: Sequence[str]) -> str | None:
    """Return the condition of a body; if None, the first known one, or None without known ones.

    Raises:
        UnknownPart: The condition is not known.
    """
    if condition is None:
        return known[0] if known else None
    if condition not in known:
        raise UnknownPart(
            f"'{condition}' is not a condition of this body. Known conditions: {', '.join(known) or 'none'}."
        )
    return condition


def changed_tool(part: str, known: Sequence[str]) -> str:
    """Return the condition that `tool_changed:<condition>` names.

    Raises:
        UnknownPart: The part is something else, or the condition is not known.
    """
    kind, _, condition = part.partition(":")
    if kind != TOOL_CHANGED or condition not in known:
        parts = ", ".join(f"{TOOL_CHANGED}:{name}" for name in known)
        raise UnknownPart(f"'{part}' is not a part that can break. Known parts: {parts}.")
    return condition
