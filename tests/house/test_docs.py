"""The documentation site holds together: every page is in the navigation, every link and reference has a target."""

import re
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest
import typer
import yaml

import gemuco
import hal
import services
from services.cli import app

ROOT = Path(__file__).parents[2]
FRONT = ("README.md", "CONTRIBUTING.md", "CHANGELOG.md")


def pages(nav: list | str | dict) -> set[str]:
    """Return the files that a part of the navigation names."""
    if isinstance(nav, str):
        return {nav}
    parts = nav.values() if isinstance(nav, dict) else nav
    return set().union(*(pages(part) for part in parts))


def test_every_page_is_in_the_navigation() -> None:
    nav = yaml.safe_load((ROOT / "mkdocs.yml").read_text())["nav"]
    assert pages(nav) == {path.relative_to(ROOT / "docs").as_posix() for path in (ROOT / "docs").rglob("*.md")}


@pytest.mark.long
def test_site_builds_without_a_warning() -> None:
    """Broken links, anchors and references to Python names are errors of a strict build."""
    build = [sys.executable, "-m", "zensical", "build", "--strict", "--clean"]
    done = subprocess.run(build, cwd=ROOT, capture_output=True, text=True, timeout=100, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    page = (ROOT / "build" / "site" / "index.html").read_text()
    assert not re.findall(r'(?:src|rel="stylesheet" href)="https?://[^"]*"', page), "the site loads from another host"


@pytest.mark.parametrize("name", FRONT)
def test_links_of_the_front_pages_have_targets(name: str) -> None:
    text = (ROOT / name).read_text()
    for target in re.findall(r"\]\(([^)]+)\)", text):
        if target.startswith("http"):
            continue
        file, _, anchor = target.partition("#")
        page = ROOT / (file or name)
        assert page.exists(), f"{name}: {target}"
        assert not anchor or anchor in anchors(page), f"{name}: {target}"


def anchors(page: Path) -> set[str]:
    """Return the anchors of a page's headings, as GitHub and the site form them."""
    headings = re.findall(r"^#+ (.*)$", page.read_text(), re.MULTILINE)
    return {re.sub(r"[^\w -]", "", heading.lower()).strip().replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("package", [gemuco, hal, services], ids=lambda package: package.__name__)
def test_reference_lists_every_exported_name(package: ModuleType) -> None:
    page = (ROOT / "docs" / f"api_{package.__name__}.md").read_text()
    listed = set(re.findall(rf"^::: {package.__name__}\.(\w+)$", page, re.MULTILINE))
    assert listed == set(package.__all__), "a name has one line ':::' on this page"


def test_every_test_that_safety_names_exists() -> None:
    text = (ROOT / "docs" / "safety.md").read_text()
    named = re.findall(r"`(tests/[\w/]+\.py)((?:::\w+)*)`", text)
    assert named
    for path, names in named:
        assert (ROOT / path).exists(), path
        definitions = set(re.findall(r"(?:def|class) (\w+)", (ROOT / path).read_text()))
        assert set(filter(None, names.split("::"))) <= definitions, path + names


@pytest.mark.parametrize(
    "page", [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))], ids=lambda path: path.name
)
def test_files_and_modules_that_a_page_names_exist(page: Path) -> None:
    text = page.read_text()
    files = re.findall(
        r"\b(?:gemuco|hal|simulators|services|studies|examples|robots|deploy|tests)/[a-z0-9_/]+\.(?:py|yaml|dbc)\b",
        text,
    )
    missing = [file for file in files if not (ROOT / file).exists()]
    for module in re.findall(r"python -m ((?:gemuco|services|studies)[\w.]*\w)", text):
        path = ROOT / module.replace(".", "/")
        missing += [] if path.is_dir() or path.with_suffix(".py").exists() else [module]
    assert not missing


def test_every_verb_of_the_command_line_has_a_row() -> None:
    rows = (ROOT / "docs" / "verbs.md").read_text().split("## ")[0]
    listed = set(re.findall(r"`(\w+)[ \w]*`(?=[^|\n]*\|[^|\n]*\|\n)", rows))
    assert set(typer.main.get_command(app).commands) <= listed  # type: ignore[attr-defined]
