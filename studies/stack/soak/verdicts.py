"""Verdicts on a soak: what was called measured and wrong, and whether memory, files, threads and rates stay."""

from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from studies.stack.soak.referee import LARGEST, LATE

SETTLED = 5
"""Minutes after its start in which a process may grow."""
MOST_SKIPPED = 1e-4
"""Share of a loop's periods that may be skipped beyond those of the bare loop beside it."""
MOST_GROWTH = 2.0
"""Growth [MB per hour] that counts as flat: an allocator's noise over one hour."""
RECOVERIES = ("until_estimated", "until_measured")


def judge(result: dict[str, Any], console: Console) -> bool:
    """Print the verdicts; return whether all of them are good."""
    rows = [row for row in result["rows"] if row["minute"] > result["judged_from"]]
    verdicts = {
        "nothing called measured was wrong": _judge_measured(result, console),
        "the faults were survived": _judge_faults(result, console),
        "no client was given an old message": result["clients"]["backwards"] == 0,
        "memory, threads and files are flat": _judge_processes(rows, console),
        "loops keep their rates": _judge_loops(rows, console),
    }
    last = result["rows"][-1]
    console.print(f"at the client: {last['arrivals']}; mover: {last['mover']}; ten clients: {result['clients']}")
    for name, is_good in verdicts.items():
        console.print(f"{'yes' if is_good else 'NO '} {name}")
    return all(verdicts.values())


def _judge_measured(result: dict[str, Any], console: Console) -> bool:
    """Print the longest time of a wrong value that was called measured, by fault; return whether all are short."""
    referee = result["referee"]
    table = Table("fault", "wrong and called measured, longest [s]", "longest pause of estimates [s]", "noticed as")
    noticed = {row["fault"]: row.get("noticed", "") for row in result["rows"]}
    for name in dict.fromkeys(["none", *result["plan"]]):
        if name in noticed or name in referee["longest"]:
            longest, pause = referee["longest"].get(name, 0.0), referee["pauses"].get(name, 0.0)
            table.add_row(name, f"{longest:.2f}", f"{pause:.2f}", noticed.get(name, "")[:60])
    console.print(table)
    count, within = referee["estimated"]
    console.print(f"compared with the truth: {referee['judged']} estimates; not: {referee['unjudged']}")
    console.print(f"measured without a sample: {referee['baseless']} estimates")
    console.print(f"messages of another type on the keys of samples, truth and estimates: {referee['others']}")
    console.print(f"promised std: {result['promised']}")
    console.print(f"estimated elements within 1.645 of their std: {100 * within / max(count, 1):.1f} % of {count}")
    for wrong in referee["wrong"]:
        console.print(
            f"WRONG: {wrong['element']} was called measured for {wrong['until'] - wrong['since']:.2f} s while wrong by "
            f"up to {wrong['worst']:.1f} promised std (allowed {LARGEST:g} for {LATE:g} s), during {wrong['fault']}"
        )
    return not referee["wrong"] and not referee["baseless"] and referee["judged"] > referee["unjudged"]


def _judge_faults(result: dict[str, Any], console: Console) -> bool:
    """Print recoveries; return whether all signals were measured again after each fault, without a traceback."""
    rows, is_good = result["rows"], not result["tracebacks"]
    for event in RECOVERIES:
        times = np.array([row[event] for row in rows if event in row])
        if len(times):
            recovered = times[np.isfinite(times)]
            is_good &= len(recovered) == len(times)
            worst = f"median {np.median(recovered):.3f} s, worst {recovered.max():.3f} s, " if len(recovered) else ""
            console.print(f"{event}: {worst}{len(times) - len(recovered)} of {len(times)} never")
    for row in rows:
        if not row["measured_again"] or row.get("never"):
            is_good = False
            console.print(f"NOT MEASURED AGAIN in minute {row['minute']} after {row['fault']}: {row.get('never', '')}")
    by_hand = sum(row["believed_by_hand"] for row in rows)
    console.print(f"trusted again by hand: {by_hand} elements; tracebacks in logs: {result['tracebacks'] or 'none'}")
    if not result["has_disk"]:
        console.print("NOT RUN: full disk; it needs root, to mount a disk of its own")
    return is_good


def _judge_processes(rows: list[dict[str, Any]], console: Console) -> bool:
    """Print memory, threads and files of every process; return whether all are flat after their first minutes."""
    table = Table("process", "minutes", "MB at first", "MB at last", "MB/h", "threads", "files", "% of a core", "flat")
    is_good = True
    for name in rows[-1]["processes"] if rows else []:
        life = [row for row in rows if row["pids"].get(name) == rows[-1]["pids"][name]]
        settled = life[SETTLED:] if len(life) > SETTLED + 1 else life
        hours = np.array([row["minute"] for row in settled], float) / 60.0
        states = [row["processes"][name] for row in settled]
        memory = [state["rss"] for state in states]
        slope = float(np.polyfit(hours, memory, 1)[0]) if len(hours) > 1 else float("nan")
        threads, files = ([int(state[kind]) for state in states] for kind in ("threads", "files"))
        is_flat = slope < MOST_GROWTH and not _creeps(threads) and not _creeps(files)
        is_good &= is_flat
        core = (states[-1]["cpu"] - states[0]["cpu"]) / max(3600.0 * (hours[-1] - hours[0]), 1.0)
        ends = [f"{state['rss']:.1f}" for state in (life[0]["processes"][name], states[-1])]
        spans = [f"{min(counts)} to {max(counts)}" for counts in (threads, files)]
        table.add_row(
            name, str(len(life)), *ends, f"{slope:.2f}", *spans, f"{100 * core:.0f}", "yes" if is_flat else "NO"
        )
    console.print(table)
    return is_good


def _creeps(counts: list[int]) -> bool:
    """Whether the last third needs more than the first: zenoh and Python start and end threads all the time."""
    third = max(1, len(counts) // 3)
    return max(counts[-third:]) > max(counts[:third]) + 1


def _judge_loops(rows: list[dict[str, Any]], console: Console) -> bool:
    """Print the skips of every loop beside those of the bare loop with the same rate, since the first minute."""
    table = Table("loop", "rate kept [Hz]", "skipped", "bare skipped", "late p99 [ms]", "failed")
    is_good = True
    for name, last in rows[-1]["loops"].items() if rows else []:
        first = rows[0]["loops"].get(name)
        span = 60.0 * (rows[-1]["minute"] - rows[0]["minute"])
        if first is None or span == 0.0 or last["ticks"] < first["ticks"]:
            continue
        counted = {kind: last[kind] - first[kind] for kind in ("ticks", "skipped", "failed")}
        is_good &= counted["failed"] == 0
        other = ""
        if name in rows[-1]["bare"]:
            bare = rows[-1]["bare"][name]["skipped"] - rows[0]["bare"][name]["skipped"]
            is_good &= counted["skipped"] <= bare + MOST_SKIPPED * counted["ticks"]
            other = f"{bare:.0f}"
        row = (f"{counted['ticks'] / span:.2f}", f"{counted['skipped']:.0f}", other, f"{1e3 * last['total_p99']:.2f}")
        table.add_row(name, *row, f"{counted['failed']:.0f}")
    console.print(table)
    return is_good
