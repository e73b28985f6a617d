"""File of an unfinished training, from which it is resumed: one safetensors file without pickle."""

import hashlib
import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from gemuco.writing import replace, writing

FORMAT = "gemuco.draft.3"


def key_of(*parts: Any) -> str:
    """Return a hash of everything that a training depends on: arrays by their bytes, other parts by their text."""
    digest = hashlib.sha256()
    for part in parts:
        array = isinstance(part, np.ndarray)
        digest.update(f"{part.dtype}{part.shape}".encode() if array else repr(part).encode())
        digest.update(np.ascontiguousarray(part).tobytes() if array else b"|")
    return digest.hexdigest()


class Draft:
    """File of the state of a training.

    Args:
        path: The file; without one nothing is saved.
        key: Hash of everything that the training depends on. A draft with another key is ignored and overwritten.
    """

    def __init__(self, path: str | Path | None, key: str) -> None:
        self.path, self.key = None if path is None else Path(path), key

    def load(self) -> tuple[dict[str, np.ndarray], dict[str, Any]] | None:
        """Return arrays and facts, or None if there is no draft with this key or the draft is damaged."""
        if self.path is None or not self.path.exists():
            return None
        try:
            with safe_open(self.path, framework="numpy") as file:
                head = file.metadata() or {}
                if head.get("format") != FORMAT or head.get("key") != self.key:
                    return None
                arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
            facts = json.loads(head["facts"])
        except (SafetensorError, OSError, ValueError, KeyError):
            return None
        return (arrays, facts) if head.get("sha256") == _digest(arrays.items(), head["facts"]) else None

    def save(self, arrays: Mapping[str, np.ndarray], facts: Mapping[str, Any]) -> None:
        """Replace the draft in one step: a process that is killed meanwhile leaves the previous draft."""
        if self.path is None:
            return
        text = json.dumps(dict(facts))
        whole = {name: np.ascontiguousarray(array) for name, array in arrays.items()}
        head = {"format": FORMAT, "key": self.key, "facts": text, "sha256": _digest(whole.items(), text)}
        with writing("The training", self.path):
            replace(self.path, save(whole, head))


def _digest(arrays: Iterable[tuple[str, np.ndarray]], facts: str) -> str:
    digest = hashlib.sha256(facts.encode())
    for name, array in sorted(arrays):
        digest.update(name.encode())
        digest.update(array.tobytes())
    return digest.hexdigest()
