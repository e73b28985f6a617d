"""Mutants: small changes of the code, drawn at random among the operators of cosmic-ray.

Strings, f-strings, types and `override` are left alone, and `==` is not replaced by `is`.
"""

import ast
import random
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from cosmic_ray.ast import ast_nodes, get_ast
from cosmic_ray.mutating import mutate_code
from cosmic_ray.operators.provider import OperatorProvider

ROOT = Path(__file__).parents[2]
FOLDERS = ("hal/protocols", "hal/safety", "hal/calibration", "hal/drivers", "services/command")
LEFT_OUT = {"VariableReplacer", "VariableInserter"} | {
    f"ReplaceComparisonOperator_{first}_{second}" for first in ("Eq", "NotEq") for second in ("Is", "IsNot")
}


class Mutant(NamedTuple):
    """One change of one file. Without an operator it is a control: the file stays as it is."""

    path: str
    line: int
    function: str
    operator: str
    occurrence: int

    def apply(self, code: str) -> str | None:
        """Return the file's code with the change; None if the result is no Python or means the same."""
        if not self.operator:
            return code
        try:
            changed = mutate_code(code, OperatorProvider()[self.operator](), self.occurrence)
            return changed if changed and ast.dump(ast.parse(changed)) != ast.dump(ast.parse(code)) else None
        except (SyntaxError, AttributeError):  # cosmic-ray cannot replace the exception `module.Name`
            return None


def _is_left_alone(node: Any) -> bool:
    is_number = node.type == "number"
    while (parent := node.parent) is not None:
        if parent.type == "fstring" or (node.type == "decorator" and "override" in node.get_code()):
            return True
        is_type = (
            (parent.type == "annassign" and node is parent.children[1])
            or (parent.type == "funcdef" and node is parent.annotation)
            or (parent.type == "tfpdef" and node is not parent.children[0])
        )
        if is_type and not is_number:
            return True
        node = parent
    return False


def _functions(tree: ast.AST, prefix: str = "") -> Iterator[tuple[int, int, str]]:
    """Yield first line, last line and qualified name of each function, outer before inner."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.FunctionDef):
            yield node.body[0].lineno, node.end_lineno or 0, prefix + node.name
            yield from _functions(node, f"{prefix}{node.name}.<locals>.")
        else:
            yield from _functions(node, f"{prefix}{node.name}." if isinstance(node, ast.ClassDef) else prefix)


def _places(path: str) -> list[list[Mutant]]:
    """Return the mutants of a file, one list per place and kind of change."""
    code = (ROOT / path).read_text()
    functions = list(_functions(ast.parse(code)))
    places: dict[tuple[Any, str], list[Mutant]] = defaultdict(list)
    provider, nodes = OperatorProvider(), list(ast_nodes(get_ast(code)))
    for operator in sorted(set(provider) - LEFT_OUT):
        positions = ((node, start) for node in nodes for start, _ in provider[operator]().mutation_positions(node))
        for occurrence, (node, start) in enumerate(positions):
            if not _is_left_alone(node):
                owners = [name for first, last, name in functions if first <= start[0] <= last]
                mutant = Mutant(path, start[0], owners[-1] if owners else "", operator, occurrence)
                places[start, operator.split("_")[0]].append(mutant)
    return [places[key] for key in sorted(places)]


def draw(seed: int, within: str = "") -> Iterator[Mutant]:
    """Yield all places of the folders in random order, one random mutant of each."""
    files = sorted(str(file.relative_to(ROOT)) for folder in FOLDERS for file in (ROOT / folder).rglob("*.py"))
    places = [place for file in files if file.startswith(within) for place in _places(file)]
    print(f"{len(places)} places, {sum(map(len, places))} mutants", flush=True)
    chance = random.Random(seed)
    chance.shuffle(places)
    yield from (mutant for mutant in map(chance.choice, places) if mutant.apply((ROOT / mutant.path).read_text()))
