"""Parts of a body that can break, named as a person types them: `muscle_cut:biceps`, `heavy_object`."""

from collections.abc import Iterable, Sequence


class UnknownPart(ValueError):
    """No such part can break; the message lists those that can."""


MUSCLE_CUT = "muscle_cut"
HEAVY_OBJECT = "heavy_object"
TOOL_CHANGED = "tool_changed"


def known_parts(muscles: Iterable[str]) -> list[str]:
    """Every part of a muscle-driven body that can break."""
    return [*(f"{MUSCLE_CUT}:{muscle}" for muscle in muscles), HEAVY_OBJECT]


def check_part(part: str, muscles: Iterable[str]) -> tuple[str, str]:
    """Split a part into the kind of its fault and what it concerns (empty for the body as a whole).

    Raises:
        UnknownPart: It is none of the known parts.
    """
    known = known_parts(muscles)
    if part not in known:
        raise UnknownPart(f"'{part}' is no part that can break. Known parts: {', '.join(known)}.")
    kind, _, what = part.partition(":")
    return kind, what


def check_condition(condition: str | None, known: Sequence[str]) -> str | None:
    """The condition of a body; the first of the known ones, or None where there are none, if not given.

    Raises:
        UnknownPart: It is none of the known ones.
    """
    if condition is None:
        return known[0] if known else None
    if condition not in known:
        raise UnknownPart(
            f"'{condition}' is no condition of this body. Known conditions: {', '.join(known) or 'none'}."
        )
    return condition


def changed_tool(part: str, known: Sequence[str]) -> str:
    """The condition that `tool_changed:<condition>` asks for.

    Raises:
        UnknownPart: It asks for something else, or for a condition that is not known.
    """
    kind, _, condition = part.partition(":")
    if kind != TOOL_CHANGED or condition not in known:
        parts = ", ".join(f"{TOOL_CHANGED}:{name}" for name in known)
        raise UnknownPart(f"'{part}' is no part that can break. Known parts: {parts}.")
    return condition
