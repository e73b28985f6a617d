"""Run the mutation probe.

    python -m studies.mutation [--count 300] [--seed 1] [--within hal/drivers/dbc] [--controls 20] [--calls FILE]

Every place has the same chance to be drawn, and at each place one change is drawn. The tests run twice without a
change, to record which functions each test calls and how long it takes (`--calls` reads an older record). A mutant
inside a function then meets the tests that call it; a mutant elsewhere meets the files that import its module, and the
tests that call it or a module that imports it. All files get the same share of the time, short tests first, until one
fails or `BUDGET` is spent. A mutant is noticed if a test fails with the change, passes without it, and fails with it
again. Controls are the same runs without a change: a control that fails shows how often a mutant is noticed by chance.
Everything runs in copies of the tree; the results are written to runs/mutation.
"""

import argparse
import ast
import difflib
import json
import math
import os
import queue
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from itertools import chain, islice
from pathlib import Path
from typing import Any

from studies.mutation.mutants import FOLDERS, ROOT, Mutant, draw

TESTS = [
    "tests/hal",
    *(f"tests/services/test_{name}.py" for name in ("client_lease", "command_intake", "lease", "permission")),
]
BUDGET = 25.0
"""The tests of one mutant take at most this time [s] without a change."""
SLOWER = 5.0
"""A test that takes this many times as long as without a change, and `GRACE`, does not end."""
GRACE = 15.0
"""A test may take this time [s] more than `SLOWER` allows, because the machine may be loaded."""
STEADY = 0.1
"""A test that takes less time [s] does not depend on the load of the machine."""
OUTCOMES = ("killed", "timeout", "survived")
Calls = dict[str, tuple[float, list[str]]]
"""Duration [s] and called functions of each test."""


def copy_tree(place: Path) -> Path:
    """Copy what git lists and return the copy."""
    names = subprocess.check_output(["git", "ls-files", "-co", "--exclude-standard"], cwd=ROOT, text=True).split("\n")
    for name in filter(None, names):
        (place / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / name, place / name)
    return place


def pytest(tree: Path, *words: str, timeout: float | None = None, **environment: str) -> tuple[int, str]:
    """Run pytest in a copy and return its exit code, -1 after the timeout [s], and its output.

    `CI` makes hypothesis draw the same examples each time; its plugin for pytest takes a second to load.
    """
    options = ("-q", "-p", "no:cacheprovider", "-p", "no:hypothesispytest")
    command = ["nice", "-n", "19", sys.executable, "-B", "-m", "pytest", *options, *words]
    variables = {**os.environ, "PYTHONPATH": str(tree), "CI": "1", **environment}
    try:
        run = subprocess.run(command, cwd=tree, env=variables, timeout=timeout, capture_output=True, text=True)
    except subprocess.TimeoutExpired:
        return -1, "timeout"
    return run.returncode, run.stdout


def record(trees: Sequence[Path], pool: ThreadPoolExecutor) -> Calls:
    """Run all tests in two copies at the same time, with and without a trace of their calls.

    Returns:
        The tests that pass in both, with their durations without the trace.
    """

    def run(tree: Path, trace: str) -> Calls:
        path = tree / f"calls{trace}.json"
        plugin = ("-p", "studies.mutation.calls", "-m", "not long", *TESTS)
        print(pytest(tree, *plugin, CALLS=str(path), TRACE=trace)[1].strip().split("\n")[-1], flush=True)
        return dict(json.loads(path.read_text()))

    traced, timed = pool.map(run, trees, ("1", ""))
    return {name: (timed[name][0], traced[name][1]) for name in timed if name in traced}


@cache
def importers(path: str) -> frozenset[str]:
    """Return a file and the files that import it."""
    module = path.removesuffix(".py").removesuffix("/__init__").replace("/", ".")
    parent, _, name = module.rpartition(".")
    files = {path}
    for file in chain(*((ROOT / package).rglob("*.py") for package in ("hal", "services", "simulators", "tests"))):
        for node in ast.walk(ast.parse(file.read_text())):
            if isinstance(node, ast.ImportFrom) and (
                node.module == module or (node.module == parent and name in {alias.name for alias in node.names})
            ):
                files.add(str(file.relative_to(ROOT)))
    return frozenset(files)


def tests_of(mutant: Mutant, calls: Calls) -> Iterator[str]:
    """Yield the tests of a mutant, in the order in which they run.

    All files get the same share of the time; those that import the mutant's module get twice the share.
    """
    key, files = f"{mutant.path}:{mutant.function}", importers(mutant.path)
    names = {name for name, (_, keys) in calls.items() if key in keys}
    if not names:
        users = (name for name, (_, keys) in calls.items() if any(key.split(":")[0] in files for key in keys))
        names = {*(name for name in calls if name.split("::")[0] in files), *users}
    spent: dict[str, float] = defaultdict(float)
    order = []
    for name in sorted(names, key=lambda name: (calls[name][0], name)):
        file = name.split("::")[0]
        spent[file] += calls[name][0] * (1.0 if file in files else 2.0)
        order.append((spent[file], name))
    left = BUDGET
    for _, name in sorted(order):
        left -= calls[name][0]
        if left > 0:
            yield name


class Workplace:
    """A copy of the tree with a changed file."""

    def __init__(self, tree: Path, mutant: Mutant, calls: Calls) -> None:
        self._tree, self._calls, self._file = tree, calls, tree / mutant.path
        self._original = self._file.read_text()
        self._changed = mutant.apply(self._original) or self._original

    @property
    def diff(self) -> list[str]:
        """Lines that the change removes and adds."""
        lines = difflib.unified_diff(self._original.splitlines(), self._changed.splitlines(), lineterm="", n=0)
        return [line for line in lines if line[:1] in "+-" and line[:3] not in ("---", "+++")]

    def run(self, names: Sequence[str], is_changed: bool = True) -> tuple[int, str]:
        """Run tests until one fails; return pytest's exit code and its output."""
        (self._tree / "names.txt").write_text("\n".join(names))
        durations = [self._calls[name][0] for name in names]
        longest, together = (GRACE + SLOWER * duration for duration in (max(durations), sum(durations)))
        self._file.write_text(self._changed if is_changed else self._original)
        try:
            return pytest(self._tree, "-x", f"--timeout={longest:.0f}", "@names.txt", timeout=together + GRACE)
        finally:
            self._file.write_text(self._original)

    def noticed_by(self, names: Sequence[str]) -> str:
        """Return the test that notices the change, or why the tests did not end; empty if there is none.

        A longer test may fail because the machine is loaded, so it must pass without the change and fail again with it.
        """
        while names:
            status, output = self.run(names)
            if status == 0:
                return ""
            failed = [name for name in names if f" {name} -" in output.replace("\n", " -")]
            if not failed:
                return output.strip().split("\n")[-1]
            name = max(failed, key=len)
            if self._calls[name][0] < STEADY or (self.run([name], is_changed=False)[0] == 0 and self.run([name])[0]):
                return name
            names = names[names.index(name) + 1 :]
        return ""


def probe(mutant: Mutant, trees: queue.Queue[Path], calls: Calls) -> dict[str, Any]:
    """Run the tests of a mutant in a free copy of the tree."""
    tree, names, started = trees.get(), list(tests_of(mutant, calls)), time.monotonic()
    place = Workplace(tree, mutant, calls)
    noticed_by = place.noticed_by(names)
    trees.put(tree)
    outcome = {"": "survived", "timeout": "timeout"}.get(noticed_by, "killed")
    print(f"{outcome:9} {mutant.path}:{mutant.line} {mutant.function} {mutant.operator} {noticed_by}", flush=True)
    duration = round(time.monotonic() - started, 1)
    result = {"outcome": outcome, "tests": len(names), "noticed_by": noticed_by, "duration": duration}
    return {**mutant._asdict(), **result, "diff": place.diff}


def show(results: Sequence[dict[str, Any]]) -> None:
    """Print the mutants that no test noticed, then the numbers by folder and the share with its 95 % interval."""
    mutants = [result for result in results if result["operator"]]
    for result in mutants:
        if result["outcome"] == "survived":
            print("{path}:{line} {function} {operator}, {tests} tests".format(**result), *result["diff"], "", sep="\n")
    print("| folder | mutants | a test fails | the tests do not end | not noticed |", "|---|---|---|---|---|", sep="\n")
    for folder in (*FOLDERS, ""):
        counts = Counter(result["outcome"] for result in mutants if result["path"].startswith(folder))
        print(f"| {folder or 'all'} |", counts.total(), *(f"| {counts[outcome]}" for outcome in OUTCOMES), "|")
    count, share = len(mutants), counts["killed"] / len(mutants) + counts["timeout"] / len(mutants)
    spread = 1.96 * math.sqrt(share * (1 - share) / count + (0.98 / count) ** 2)  # Wilson's interval
    middle, width = share + 1.92 / count, 1 + 3.84 / count
    failed = [result["outcome"] for result in results if not result["operator"]]
    print(
        f"{share:.1%} of {count} are noticed, 95 % interval {(middle - spread) / width:.0%} to "
        f"{(middle + spread) / width:.0%}; {len(failed) - failed.count('survived')} of {len(failed)} controls failed"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description="Run the mutation probe.")
    parser.add_argument("--count", type=int, default=300)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--within", default="")
    parser.add_argument("--controls", type=int, default=20)
    parser.add_argument("--calls", type=Path, default=None)
    options = parser.parse_args()
    folder = ROOT / "runs" / "mutation"
    folder.mkdir(parents=True, exist_ok=True)
    mutants = list(islice(draw(options.seed, options.within), options.count))
    controls = [mutant._replace(operator="") for mutant in mutants[: options.controls]]
    with tempfile.TemporaryDirectory() as place, ThreadPoolExecutor(2) as pool:
        copies = [copy_tree(Path(place) / name) for name in ("one", "two")]
        if options.calls is None:
            options.calls = folder / "calls.json"
            options.calls.write_text(json.dumps(record(copies, pool)))
        listed = set(pytest(copies[0], "--collect-only", *TESTS)[1].split("\n"))
        calls = {name: entry for name, entry in json.loads(options.calls.read_text()).items() if name in listed}
        trees: queue.Queue[Path] = queue.Queue()
        for copy in copies:
            trees.put(copy)
        results = list(pool.map(lambda mutant: probe(mutant, trees, calls), [*mutants, *controls]))
    (folder / f"seed{options.seed}.json").write_text(json.dumps(results, indent=1))
    show(results)


if __name__ == "__main__":
    main()
