"""No module imports itself by a detour; imports inside functions and under TYPE_CHECKING count too."""

import ast
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[2]
PACKAGES = ("gemuco", "hal", "simulators", "services", "studies")


def test_there_is_no_import_circle() -> None:
    assert not circles()


def test_a_circle_is_noticed() -> None:
    arrows = {"a": {"b"}, "b": {"c"}, "c": {"b"}}
    assert {name: _reached(name, arrows) for name in arrows} == {"a": {"b", "c"}, "b": {"b", "c"}, "c": {"b", "c"}}


def circles() -> set[frozenset[str]]:
    """Return the sets of modules that reach each other by imports."""
    files = {_module(path): path for package in PACKAGES for path in sorted((ROOT / package).rglob("*.py"))}
    arrows = {name: set(_imports(path, set(files))) - {name} for name, path in files.items()}
    reach = {name: _reached(name, arrows) for name in arrows}
    return {frozenset(b for b in reach[a] if a in reach[b]) for a in arrows if a in reach[a]}


def _module(path: Path) -> str:
    return ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


def _imports(path: Path, modules: set[str]) -> Iterator[str]:
    """Yield every module of ours that a file imports, wherever the import stands."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name in modules)
        elif isinstance(node, ast.ImportFrom) and node.module in modules:
            below = {f"{node.module}.{alias.name}" for alias in node.names}
            yield from below & modules
            if below - modules:
                yield node.module


def _reached(start: str, arrows: dict[str, set[str]]) -> set[str]:
    """Return every module that is reached from one, itself only by a circle."""
    reached: set[str] = set()
    stack = [start]
    while stack:
        fresh = arrows[stack.pop()] - reached
        reached |= fresh
        stack += fresh
    return reached
