"""Run the mutation probe.

    python -m studies.mutation [--count 300] [--seed 1] [--within hal/drivers/dbc] [--controls 20] [--calls FILE]

Every place has the same chance to be drawn, and at each place one change is drawn. The tests run once to record the
calls of each test (`--calls` reads an older record). A mutant inside a function then meets the tests that call it; a
mutant elsewhere meets the files that import its module, and the tests that call it or a module that imports it. Short
tests come first, then one of each file in turn, until one fails or `BUDGET` is spent. Controls are the same runs
without a change: a control that fails shows how often a mutant counts as killed by chance. Everything runs in copies of
the tree; the results are written to runs/mutation.
"""

import argparse
import ast
import difflib
import json
import os
import queue
import shutil
import subprocess
import sys
import tempfile
from collections import Counter, defaultdict
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from itertools import chain, islice, zip_longest
from pathlib import Path
from typing import Any

from studies.mutation.mutants import ROOT, Mutant, draw

TESTS = [
    "tests/hal",
    *(f"tests/services/test_{name}.py" for name in ("client_lease", "command_intake", "lease", "permission")),
]
BUDGET = 20.0
"""The tests of one mutant take at most this time [s] when they pass."""
TIMEOUT = 400.0
"""A mutant whose tests take longer [s] is killed: a test does not end."""
STEADY = 0.1
"""A test that takes less time [s] does not depend on the load of the machine."""
Calls = dict[str, tuple[float, list[str]]]


def copy_tree(place: Path) -> Path:
    """Copy what git lists and return the copy."""
    names = subprocess.check_output(["git", "ls-files", "-co", "--exclude-standard"], cwd=ROOT, text=True).split("\n")
    for name in filter(None, names):
        (place / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / name, place / name)
    return place


def pytest(tree: Path, *words: str, timeout: float | None = None, **environment: str) -> tuple[int, str]:
    """Run pytest in a copy and return its exit code, -1 after the timeout, and its output."""
    command = ["nice", "-n", "19", sys.executable, "-B", "-m", "pytest", "-q", "-p", "no:cacheprovider", *words]
    variables = {**os.environ, "PYTHONPATH": str(tree), **environment}
    try:
        run = subprocess.run(command, cwd=tree, env=variables, timeout=timeout, capture_output=True, text=True)
    except subprocess.TimeoutExpired:
        return -1, "timeout"
    return run.returncode, run.stdout


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
    """Yield the tests of a mutant, in the order in which they run."""
    key, files = f"{mutant.path}:{mutant.function}", importers(mutant.path)
    names = [name for name, (_, keys) in calls.items() if key in keys]
    if not names:
        users = (name for name, (_, keys) in calls.items() if any(key.split(":")[0] in files for key in keys))
        names = [*(name for name in calls if name.split("::")[0] in files), *users]
    names = sorted(set(names), key=lambda name: (name.split("::")[0] not in files, *calls[name]))
    rows = defaultdict(list)
    for name in names:
        if calls[name][0] >= STEADY:
            rows[name.split("::")[0]].append(name)
    steady = (name for name in names if calls[name][0] < STEADY)
    left = BUDGET
    for name in filter(None, chain(steady, *zip_longest(*rows.values()))):
        left -= calls[name][0]
        if left > 0:
            yield name


def first_failure(tree: Path, names: list[str], calls: Calls) -> str:
    """Run tests until one fails; return its name, or why they did not end; empty if all pass.

    A longer test must fail twice, because it may depend on the load of the machine.
    """
    while names:
        (tree / "names.txt").write_text("\n".join(names))
        status, output = pytest(tree, "-x", "--timeout=60", "@names.txt", timeout=TIMEOUT)
        if status == 0:
            return ""
        failed = [name for name in names if f" {name} -" in output.replace("\n", " -")]
        if not failed:
            return output.strip().split("\n")[-1]
        name = max(failed, key=len)
        (tree / "names.txt").write_text(name)
        if calls[name][0] < STEADY or pytest(tree, "--timeout=60", "@names.txt", timeout=TIMEOUT)[0]:
            return name
        names = names[names.index(name) + 1 :]
    return ""


def probe(mutant: Mutant, trees: queue.Queue[Path], calls: Calls) -> dict[str, Any]:
    """Run the tests of a mutant in a free copy of the tree."""
    tree, names = trees.get(), list(tests_of(mutant, calls))
    original = (tree / mutant.path).read_text()
    code = mutant.apply(original) or original
    (tree / mutant.path).write_text(code)
    noticed_by = first_failure(tree, names, calls)
    (tree / mutant.path).write_text(original)
    trees.put(tree)
    lines = difflib.unified_diff(original.splitlines(), code.splitlines(), lineterm="", n=0)
    diff = [line for line in lines if line[:1] in "+-" and line[:3] not in ("---", "+++")]
    outcome = {"": "survived", "timeout": "timeout"}.get(noticed_by, "killed")
    print(f"{outcome:9} {mutant.path}:{mutant.line} {mutant.function} {mutant.operator} {noticed_by}", flush=True)
    return {**mutant._asdict(), "outcome": outcome, "tests": len(names), "noticed_by": noticed_by, "diff": diff}


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
        trees: queue.Queue[Path] = queue.Queue()
        for name in ("one", "two"):
            trees.put(copy_tree(Path(place) / name))
        calls = options.calls or folder / "calls.json"
        if options.calls is None:
            plugin = ("-p", "studies.mutation.calls", "-m", "not long", *TESTS)
            print(pytest(trees.queue[0], *plugin, CALLS=str(calls))[1].strip().split("\n")[-1], flush=True)
        listed = set(pytest(trees.queue[0], "--collect-only", *TESTS)[1].split("\n"))
        record = {name: entry for name, entry in json.loads(calls.read_text()).items() if name in listed}
        results = list(pool.map(lambda mutant: probe(mutant, trees, record), [*mutants, *controls]))
    (folder / f"seed{options.seed}.json").write_text(json.dumps(results, indent=1))
    for result in results:
        if result["outcome"] == "survived" and result["operator"]:
            print("{path}:{line} {function} {operator}, {tests} tests".format(**result), *result["diff"], "", sep="\n")
    counts = Counter(result["outcome"] for result in results if result["operator"])
    failed = sum(result["outcome"] != "survived" for result in results if not result["operator"])
    share = 1 - counts["survived"] / len(mutants)
    print(f"{len(mutants)} mutants: {dict(counts)}, {share:.1%} noticed; {failed} of {len(controls)} controls failed")


if __name__ == "__main__":
    main()
