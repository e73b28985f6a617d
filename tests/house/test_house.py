"""The rules of the house: what a reader may rely on in every file."""

import ast
import re
import tomllib
from pathlib import Path

import pytest

from hal.config import load_robot
from services.wire import keys

ROOT = Path(__file__).parents[2]
PACKAGES = ("gemuco", "hal", "simulators", "services", "studies")
MODULES = sorted(path for package in PACKAGES for path in (ROOT / package).rglob("*.py"))
TESTS = sorted((ROOT / "tests").rglob("*.py"))
ROBOTS = sorted(path for path in (ROOT / "robots").glob("*.yaml") if "." not in path.stem)
LONGEST_FILE = 450
MOST_MODULES = 16
COMPILED_MODULES = 20
"""gemuco/compiled is one flat folder because its hash names the cache of compiled code."""
LONGEST_FUNCTION = 50
EMPTY_NAMES = {"utils", "util", "common", "base", "core", "manager", "helper", "helpers", "misc"}


def _name(path: Path) -> str:
    return str(path.relative_to(ROOT))


@pytest.mark.parametrize("path", MODULES + TESTS, ids=_name)
def test_file_can_be_read_in_one_sitting(path: Path) -> None:
    lines = path.read_text().splitlines()
    assert len(lines) <= LONGEST_FILE, f"{_name(path)} has {len(lines)} lines: split it by what it is about"


@pytest.mark.parametrize("folder", sorted({path.parent for path in MODULES}), ids=_name)
def test_folder_is_seen_at_a_glance(folder: Path) -> None:
    modules = [path.name for path in folder.glob("*.py") if path.name != "__init__.py"]
    limit = COMPILED_MODULES if _name(folder) == "gemuco/compiled" else MOST_MODULES
    assert len(modules) <= limit, f"{_name(folder)} has {len(modules)} modules: which of them are a room of their own?"


@pytest.mark.parametrize("path", MODULES, ids=_name)
def test_functions_are_short(path: Path) -> None:
    functions = (n for n in ast.walk(ast.parse(path.read_text())) if isinstance(n, ast.FunctionDef))
    too_long = {f.name: n for f in functions if (n := _code_lines(f)) > LONGEST_FUNCTION}
    assert not too_long


def _code_lines(function: ast.FunctionDef) -> int:
    """Lines of a function without its docstring."""
    first = function.body[1] if ast.get_docstring(function) and len(function.body) > 1 else function.body[0]
    return (function.end_lineno or 0) - first.lineno + 1


WRITE_OTHERWISE = {
    "gemuco/writing.py": "is the one step",
    "hal/calibration/store.py": "has its own, because hal does not know gemuco",
    "services/process/heartbeat.py": "writes every second into memory, not to the disk",
    "services/process/supervisor.py": "writes a log",
    "services/recording/export.py": "writes tables larger than the memory",
    "simulators/bullet.py": "writes nothing",
    "simulators/physics/bullet_arm.py": "writes a file that only PyBullet reads, at once",
    "simulators/robots/urdf_arm/robot_file.py": "writes meshes that are read at once and removed",
}
"""tests/system/test_kills.py kills those that write files."""


@pytest.mark.parametrize("path", [path for path in MODULES if _name(path).split("/")[0] != "studies"], ids=_name)
def test_a_file_is_replaced_in_one_step(path: Path) -> None:
    found = re.findall(r"""\.write_(?:text|bytes)\(|(?:open|fdopen)\([^)]*["'][wx]b?["']""", path.read_text())
    assert not found or _name(path) in WRITE_OTHERWISE, "use gemuco.writing.replacing"


@pytest.mark.parametrize("path", MODULES, ids=_name)
def test_name_says_something(path: Path) -> None:
    assert path.stem not in EMPTY_NAMES


@pytest.mark.parametrize("path", MODULES, ids=_name)
def test_nothing_is_swallowed(path: Path) -> None:
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ExceptHandler):
            assert node.type is not None, f"{_name(path)}:{node.lineno} catches everything, Ctrl-C included"
            silent = len(node.body) == 1 and isinstance(node.body[0], ast.Pass)
            assert not silent, f"{_name(path)}:{node.lineno} swallows an error"


def test_key_table_lists_every_key() -> None:
    table = (ROOT / "docs" / "keys.md").read_text()
    for noun in (
        keys.sample,
        keys.vision,
        keys.applied,
        keys.command,
        keys.holder,
        keys.estimate,
        keys.anomaly,
        keys.update,
        keys.target,
    ):
        assert f"`{noun('<robot>')}`" in table
    assert f"`{keys.truth('<robot>')}`" in table
    for pattern in (keys.status("<robot>", "<service>"), keys.alive("<robot>", "<service>")):
        assert f"`{pattern}`" in table


def test_key_table_lists_no_other_key() -> None:
    known = {
        keys.sample("<robot>"),
        keys.vision("<robot>"),
        keys.applied("<robot>"),
        keys.command("<robot>"),
        keys.holder("<robot>"),
        keys.estimate("<robot>"),
        keys.anomaly("<robot>"),
        keys.update("<robot>"),
        keys.target("<robot>"),
        keys.truth("<robot>"),
        keys.status("<robot>", "<service>"),
        keys.alive("<robot>", "<service>"),
    }
    listed = re.findall(r"`(gemuco/<robot>/[^`]+)`", (ROOT / "docs" / "keys.md").read_text())
    verbs = {key for key in listed if "/do/" in key}
    assert set(listed) - verbs == known
    for key in verbs:
        robot, service, rest = keys.parse(key)
        assert key == keys.verb(robot, service, rest.removeprefix("do/"))


@pytest.mark.parametrize("path", ROBOTS, ids=_name)
def test_shipped_robot_files_load(path: Path) -> None:
    assert load_robot(path).robot == path.stem


def test_every_dependency_is_pinned_and_explained() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    wanted = project["dependencies"] + [d for extra in project["optional-dependencies"].values() for d in extra]
    names = {re.split(r"[>=<\[]", entry)[0].lower() for entry in wanted}
    names.discard(project["name"])  # one extra may name another
    pinned = {line.split("==")[0].lower() for line in (ROOT / "constraints.txt").read_text().splitlines()}
    design = (ROOT / "docs" / "design.md").read_text().lower()
    assert names <= pinned
    assert not {name for name in names if f"`{name}`" not in design}
