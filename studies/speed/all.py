"""Everything that is measured of speed, in under a quarter of an hour: writes docs/benchmarks.md.

    make bench                                     # or: python -m studies.speed.all [--minutes 10]

What got worse by more than a third since it was recorded last (docs/benchmarks.json) is printed in red.
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
from rich.table import Table

from gemuco.compiled.jit import NUMPYS
from studies.speed import learning, service_cost, sizes, solvers, updates
from studies.speed.table import Row
from studies.stack import loops

PAGE, RECORD = Path("docs/benchmarks.md"), Path("docs/benchmarks.json")
ROBOT = Path("robots/musashi_arm.yaml")
RATES = "estimation=500,control=100,anomaly=200,update=20"
WORSE = 4.0 / 3.0
INTRODUCTION = """# Benchmarks

`python -m studies.speed.all --minutes {minutes:g}` on {machine}, {day}; the loops ran for so many minutes (0: not at
all), and `make bench` lets them run for ten. One thread each unless said otherwise. Ours and the peer are measured in
turn in the same run; what is compared is their ratio in each round, and the table has the median. Microseconds do not
travel between machines, ratios nearly do. Torch is eager, float32, on one thread: what a user writes first.

| what | against | ours | theirs | result | bar | |
|---|---|---|---|---|---|---|
"""


def loop_rows(minutes: float) -> Iterator[Row]:
    """The four loops of the service on an arm without a bus, beside bare timer loops."""
    with loops.with_rates(ROBOT, RATES) as file:
        found = loops.run(file, minutes, with_bus=False)
    for name in ("estimation", "control", "anomaly", "update"):
        one = found["loops"][name]
        bare = one["bare"]
        share, other = (100 * x["skipped"] / max(x["ticks"] + x["skipped"], 1) for x in (one, bare))
        what = f"{name} loop at {one['rate_wanted']:g} Hz, {minutes:g} min"
        yield Row(
            f"{what}: missed ticks", "bare timer loop", share, other, "%", share - other, 0.1, True, "beyond the bare"
        )
        late, least = 1e3 * one["total_p99"], 1e3 * bare["total_p99"]
        yield Row(f"{what}: p99 lateness", "bare timer loop", late, least, "ms", late / least, 3.0, True)
    cores = 100 * found["cores"]["serve"]
    yield Row("the model service's share of a core meanwhile", "35 %", cores, 35.0, "%", cores, 35.0, True)


def chapters(minutes: float) -> dict[str, Iterator[Row]]:
    """All results; the loops first, while nothing else runs."""
    first = {"loops": loop_rows(minutes)} if minutes else {}
    return first | {
        "solvers": solvers.rows(),
        "updates": updates.rows(),
        "learning": learning.rows(),
        "service_cost": service_cost.rows(),
    }


def processor() -> str:
    """What Linux calls it, whether it has AVX-512, and as for which one OpenBLAS computes: what products cost."""
    told = Path("/proc/cpuinfo").read_text()
    name = next((line.partition(":")[2].strip() for line in told.splitlines() if line.startswith("model name")), "")
    has = f"{name or platform.machine()} {'with' if 'avx512f' in told else 'without'} AVX-512"
    if NUMPYS is None:
        return has
    tell = ctypes.CDLL(str(NUMPYS)).scipy_openblas_get_corename64_
    tell.restype = ctypes.c_char_p
    return f"{has}, OpenBLAS as for {tell().decode()}"


def is_worse(row: Row, before: dict[str, float]) -> bool:
    """Whether a result got worse by more than a third."""
    if row.what not in before or before[row.what] <= 0.0 or row.value <= 0.0:
        return False
    ratio = row.value / before[row.what]
    return ratio > WORSE if row.is_most else ratio < 1.0 / WORSE


def text(row: Row) -> list[str]:
    """The row's cells."""
    mark = "" if not row.bar else "yes" if row.is_reached else "NO"
    sign = "at most " if row.is_most else ""
    value = f"{row.value:.3g}" + ("" if row.is_most else " x")
    bar = f"{sign}{row.bar:g}" + ("" if row.is_most else " x") if row.bar else "-"
    return [row.what, row.against, f"{row.ours:.3g} {row.unit}", f"{row.theirs:.3g} {row.unit}", value, bar, mark]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=10.0, help="of the loops; 0 leaves them out")
    options = parser.parse_args()
    console = Console(width=160)
    before = json.loads(RECORD.read_text()) if RECORD.exists() else {}
    table = Table("what", "against", "ours", "theirs", "result", "bar", "reached", title="benchmarks")
    found: list[Row] = []
    broken: list[str] = []
    for chapter, rows in chapters(options.minutes).items():
        try:
            for row in rows:
                found.append(row)
                table.add_row(*text(row), style="red" if is_worse(row, before) else "")
                console.print(" | ".join(text(row)), style="red" if is_worse(row, before) else "")
        except Exception as error:  # what was measured is kept, and what was not is named
            console.print_exception()
            broken.append(f"`studies.{chapter}` ended early and lacks rows: {type(error).__name__}: {error}")
    sizes.draw()
    machine = f"{os.cpu_count()} cores of {processor()}, Python {platform.python_version()}"
    lines = [INTRODUCTION.format(machine=machine, day=datetime.date.today(), minutes=options.minutes)]
    lines += [f"| {' | '.join(text(row))} |\n" for row in found]
    noted = [f"{row.what}: {row.note}." for row in found if row.note]
    lines += ["\n", *(f"- {line}\n" for line in broken + noted)]
    PAGE.write_text("".join(lines) + "\n![cost against size](images/cost.png)\n")
    RECORD.write_text(json.dumps(before | {row.what: row.value for row in found}, indent=1) + "\n")
    console.print(table)
    for line in broken:
        console.print(line, style="red")
    return 1 if broken else 0


if __name__ == "__main__":
    sys.exit(main())
