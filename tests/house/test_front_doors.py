"""Each package exports what users need by name, and examples and snippets import nothing else."""

import ast
import importlib
import pkgutil
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
DOORS = ("gemuco", "hal", "services")
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md")), *sorted((ROOT / "examples").glob("*.py"))]


@pytest.mark.parametrize("package", DOORS)
def test_every_exported_name_is_true(package: str) -> None:
    door = importlib.import_module(package)
    submodules = {module.name for module in pkgutil.iter_modules(door.__path__)}
    assert sorted(door.__all__) == list(door.__all__)
    assert not submodules & set(door.__all__), "a function and a module of one name hide each other"
    assert set(door.__all__) <= set(dir(door))
    for name in door.__all__:
        assert getattr(door, name).__name__ == name
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = door.nothing


@pytest.mark.parametrize("package", DOORS)
def test_a_type_checker_sees_the_same_names(package: str) -> None:
    source = ast.parse((ROOT / package / "__init__.py").read_text())
    imports = [node for node in ast.walk(source) if isinstance(node, ast.ImportFrom) and node.module != "importlib"]
    seen = {alias.asname: node.module for node in imports for alias in node.names}
    door = importlib.import_module(package)
    assert sorted(name for name in seen if name) == door.__all__
    for name, room in seen.items():
        assert getattr(door, name) is getattr(importlib.import_module(room), name), name


@pytest.mark.parametrize("package", DOORS)
def test_the_door_itself_is_light(package: str) -> None:
    heavy = "{'numpy', 'torch', 'numba', 'zenoh', 'can', 'pydantic', 'msgspec'}"
    code = f"import sys, {package}; sys.exit(bool({heavy} & set(sys.modules)))"
    assert subprocess.run([sys.executable, "-c", code], check=False, cwd=ROOT).returncode == 0


def test_examples_and_snippets_use_the_front_doors() -> None:
    inside = {path.name: found for path in PAGES if (found := list(_imports_from_inside(path)))}
    assert not inside


def _imports_from_inside(path: Path) -> Iterator[str]:
    """Yield every import of one of our packages that goes past its front door."""
    text = path.read_text()
    for code in [text] if path.suffix == ".py" else re.findall(r"```python\n(.*?)```", text, re.DOTALL):
        for node in ast.walk(ast.parse(code)):
            if isinstance(node, ast.ImportFrom) and (node.module or "").partition(".")[0] in DOORS:
                package = node.module or ""
                if package not in DOORS or not {a.name for a in node.names} <= _exported(package):
                    yield ast.unparse(node)
            elif isinstance(node, ast.Import):
                yield from (alias.name for alias in node.names if alias.name.partition(".")[0] in DOORS)


def _exported(package: str) -> set[str]:
    rooms = {"plot"} if package == "gemuco" else set()  # a room with names of its own
    return rooms | set(getattr(importlib.import_module(package), "__all__", ()))
