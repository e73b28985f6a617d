"""Comparison of the speed of gemuco with that of peers, in under a quarter of an hour; writes docs/benchmarks.md.

    make bench                                     # or: python -m studies.speed.all [--minutes 10]

A result that is worse by more than a third than the recorded one (docs/benchmarks.json) is printed in red.
"""

import argparse
import ctypes
import datetime
import json
import os
import platform
import sys
from collections.abc import Iterator
from pathlib import Path

from rich.console import Console

from gemuco.compiled.jit import NUMPYS
from studies.speed import service_cost, sizes, solvers, structure, updates
from studies.speed.table import Row
from studies.stack import loops

PAGE, RECORD = Path("docs/benchmarks.md"), Path("docs/benchmarks.json")
ROBOT = Path("robots/musashi_arm.yaml")
RATES = "estimation=500,control=100,anomaly=200,update=20"
WORSE = 4.0 / 3.0
_BEYOND = "the compared value is the difference to the bare loop"
INTRODUCTION = """# Benchmarks

`python -m studies.speed.all --minutes {minutes:g}` on {machine}, {day}. The loops run for `--minutes` (with 0 they
do not run; `make bench` uses 10). Each side uses one thread unless a note gives another number. Each round measures
gemuco and the peer one after the other and takes the ratio; the table has the median over the rounds. Times differ
between machines, ratios differ little. The peer does the same work. torch is eager, float32, on one thread.

| measurement | peer | gemuco | result of the peer | compared value | bar | |
|---|---|---|---|---|---|---|
"""


def loop_rows(minutes: float) -> Iterator[Row]:
    """Measure the service's four loops on an arm without a bus, beside bare timer loops."""
    with loops.with_rates(ROBOT, RATES) as file:
        result = loops.run(file, minutes, with_bus=False)
    for name in ("estimation", "control", "anomaly", "update"):
        loop = result["loops"][name]
        bare = loop["bare"]
        share, other = (100 * x["skipped"] / max(x["ticks"] + x["skipped"], 1) for x in (loop, bare))
        what = f"{name} loop at {loop['rate_wanted']:g} Hz, {minutes:g} min"
        yield Row(f"{what}: missed ticks", "bare timer loop", share, other, "%", share - other, 0.1, True, _BEYOND)
        late, least = 1e3 * loop["total_p99"], 1e3 * bare["total_p99"]
        yield Row(f"{what}: p99 lateness", "bare timer loop", late, least, "ms", late / least, 3.0, True)
    cores = 100 * result["cores"]["serve"]
    yield Row("the model service's share of a core meanwhile", "35 %", cores, 35.0, "%", cores, 35.0, True)


def chapters(minutes: float) -> dict[str, Iterator[Row]]:
    """Return the rows of every chapter; the loops are first, because no other measurement may run beside them."""
    first = {"loops": loop_rows(minutes)} if minutes else {}
    return first | {
        "solvers": solvers.rows(),
        "updates": updates.rows(),
        "structure": structure.rows(),
        "service_cost": service_cost.rows(),
    }


def processor() -> str:
    """Return the processor's name, whether it has AVX-512, and the core for which OpenBLAS computes."""
    description = Path("/proc/cpuinfo").read_text()
    names = (line.partition(":")[2].strip() for line in description.splitlines() if line.startswith("model name"))
    avx = "with" if "avx512f" in description else "without"
    name = f"{next(names, '') or platform.machine()} {avx} AVX-512"
    if NUMPYS is None:
        return name
    core = ctypes.CDLL(str(NUMPYS)).scipy_openblas_get_corename64_
    core.restype = ctypes.c_char_p
    return f"{name}, OpenBLAS as for {core().decode()}"


def is_worse(row: Row, before: dict[str, float]) -> bool:
    """Whether a result got worse by more than a third."""
    if row.what not in before or before[row.what] <= 0.0 or row.value <= 0.0:
        return False
    ratio = row.value / before[row.what]
    return ratio > WORSE if row.is_most else ratio < 1.0 / WORSE


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=10.0, help="of the loops; 0 leaves them out")
    options = parser.parse_args()
    console = Console(width=160)
    before = json.loads(RECORD.read_text()) if RECORD.exists() else {}
    results: list[Row] = []
    failures: list[str] = []
    for chapter, rows in chapters(options.minutes).items():
        try:
            for row in rows:
                results.append(row)
                console.print(" | ".join(row.cells()), style="red" if is_worse(row, before) else "")
        except Exception as error:  # the other results are kept, and the missing ones are named
            console.print_exception()
            failures.append(f"`{chapter}` ended early and lacks rows: {type(error).__name__}: {error}")
    sizes.draw()
    machine = f"{os.cpu_count()} cores of {processor()}, Python {platform.python_version()}"
    lines = [INTRODUCTION.format(machine=machine, day=datetime.date.today(), minutes=options.minutes)]
    lines += [f"| {' | '.join(row.cells())} |\n" for row in results]
    notes = [f"{row.what}: {row.note}." for row in results if row.note]
    lines += ["\n", *(f"- {line}\n" for line in failures + notes)]
    PAGE.write_text("".join(lines) + "\n![cost against size](images/cost.png)\n")
    RECORD.write_text(json.dumps({row.what: row.value for row in results}, indent=1) + "\n")
    for line in failures:
        console.print(line, style="red")
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
