"""The rules of CONTRIBUTING.md for English, where a program can check them."""

import ast
import io
import re
import tokenize
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
CODE = ("gemuco", "hal", "simulators", "services", "studies", "examples")
WORDS = re.compile(
    r"\b(tells?|told|telling|foretells?|foretold|nobody|somebody|anybody|everybody|whoever|whomever|amiss|so many)\b",
    re.IGNORECASE,
)
QUESTIONS = {"What", "Where", "Who", "How", "Which", "Whose", "Why", "Whoever", "Whatever"}
NO_VERBS = {"The", "A", "An", "All", "Every", "Each", "One", "These", "This", "That", "For", "In", "Of", "If"}
NO_NOUNS = {"found", "told", "amiss", "foretold"}
PROPERTIES = {"property", "cached_property"}


def _name(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


MODULES = [path for folder in CODE for path in sorted((ROOT / folder).rglob("*.py"))]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]


@pytest.mark.parametrize("path", MODULES, ids=_name)
@pytest.mark.long
def test_code_is_in_plain_english(path: Path) -> None:
    faults = list(code_faults(path.read_text()))
    assert not faults, "\n".join(faults)


@pytest.mark.parametrize("path", PAGES, ids=_name)
def test_page_is_in_plain_english(path: Path) -> None:
    faults = [f"line {n}: {line}" for n, line in enumerate(path.read_text().splitlines(), 1) if WORDS.search(line)]
    assert not faults, "\n".join(faults)


def code_faults(source: str) -> Iterator[str]:
    """Yield one line per fault of a module: line number, rule and text."""
    tree = ast.parse(source)
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            yield from _docstring_faults(node)
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store) and node.id in NO_NOUNS:
            yield f"line {node.lineno}: a variable is a noun of the field, not '{node.id}'"
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and WORDS.search(node.value):
            yield f"line {node.lineno}: {WORDS.findall(node.value)} in a docstring or message"
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT and WORDS.search(token.string):
            yield f"line {token.start[0]}: {token.string}"


def _docstring_faults(node: ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef) -> Iterator[str]:
    words = (ast.get_docstring(node) or "").split()
    if not words:
        return
    first = words[0].rstrip(".,:;")
    if first in QUESTIONS:
        yield f"line {node.lineno}: the docstring of '{node.name}' begins with '{first}'"
    if isinstance(node, ast.ClassDef):
        return
    decorators = {d.id for d in node.decorator_list if isinstance(d, ast.Name)}
    if first in NO_VERBS and not decorators & PROPERTIES:
        yield f"line {node.lineno}: the docstring of '{node.name}' begins with '{first}', not with a verb"
    if first == "Whether" and not _returns_bool(node):
        yield f"line {node.lineno}: '{node.name}' is no boolean, its docstring begins with 'Whether'"


def _returns_bool(node: ast.FunctionDef | ast.AsyncFunctionDef) -> bool:
    return node.returns is not None and "bool" in ast.unparse(node.returns)


@pytest.mark.parametrize(
    "source",
    [
        'def f() -> int:\n    """What is left."""',
        'def f() -> int:\n    """The number of frames."""',
        'def f() -> int:\n    """Whether there is one."""',
        'class A:\n    """Who may enter."""',
        'x = "Nobody answered."',
        "found = 1",
        "x = 1  # told by the drive",
    ],
)
def test_faults_are_noticed(source: str) -> None:
    assert list(code_faults(source))


def test_plain_code_has_no_fault() -> None:
    source = (
        '@property\ndef size() -> int:\n    """Number of elements."""\ndef f() -> bool:\n    """Whether it is open."""'
    )
    assert not list(code_faults(source))
