"""Parts of a body that can break, named as a person types them: `muscle_cut:biceps`, `heavy_object`."""

from collections.abc import Iterable


class UnknownPart(ValueError):
    """No such part can break; the message lists those that can."""


MUSCLE_CUT = "muscle_cut"
HEAVY_OBJECT = "heavy_object"


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
