"""A bad network, tried out: HAL and model on two sides of a link, broken in each way of `cases.py`.

    python tests/network/campaign.py [--runs 3] [--protocols tcp quic] [--only WORDS] [--json FILE]

What is judged comes from witnesses in the HAL's and the model's process (`witness.py`) and from a client, all on the
machine's one monotonic clock. Prints a table in markdown; ends with 1 if anything required was not seen.
"""

import argparse
import bisect
import itertools
import json
import math
import os
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import seesaw
from cases import CASES, Case, Times
from link import Link, missing
from stack import Stack

FRESH_WITHIN = 1.0
REPORTED_WITHIN = 1.5
VIEWERS_WITHIN = 1.0
SETTLE = 0.3
"""The ramp of a set-point that comes to rest in `hold` takes less [s]."""
WITNESS = 1e-3
"""How well [s] the witness, which stands outside the robot, knows when a cycle began."""
STILL = 1e-4
"""[m]"""
WATCH = 2.5
"""How long [s] after the mending it is watched."""
PATIENCE = 15.0
"""How long [s] to wait for estimates that are late."""
ALIVE = ("hold", "follow")


def run(stack: Stack, case: Case, number: int) -> dict[str, Any]:
    """Break once; returns what was seen, times in seconds."""
    stack.until(lambda: stack.mode() != "", "the HAL turns")
    stack.engage(1 if number % 2 else -1)
    time.sleep(0.7)
    begun = time.monotonic()
    times = case.do(stack)
    time.sleep(WATCH)
    while time.monotonic() < times.mended + PATIENCE and not is_measuring(stack, begun):
        time.sleep(0.1)
    seen: dict[str, Any] = {"case": case.name, "took": times.mended - times.broken}
    everything = {name: stack.records[name].read(begun - 1.0) for name in stack.records}
    hal = [row for row in everything["hal"] if row[0] >= begun]
    client = stack.here.records.read(begun - 1.0)
    seen |= commanded(hal, times)
    seen |= estimated(everything["hal"], [row for row in everything["model"] if row[0] >= begun], times)
    seen["gone"], seen["there"] = report(client, case.gone, times) if case.gone else (None, None)
    seen["viewers"] = None
    if seen["mode_after"] == "fault":
        seen["fault"] = ((stack.here.status("hal") or {}).get("facts") or {}).get("fault", "")
    if case.viewers:
        seen["viewers"] = max(
            first(records, "sample", times.mended)
            for records in (client, stack.there.records.read(begun - 1.0))
        )  # fmt: skip
    seen["timer"] = max((row[1] for row in everything["timer"] if row[0] >= begun), default=0.0)
    seen["wrong"] = judged(case, seen)
    return seen


def is_measuring(stack: Stack, since: float) -> bool:
    """Whether the model called anything measured in its last estimate."""
    rows = stack.records["model"].read(since)
    return bool(rows) and "measured" in rows[-1][2].values()


def commanded(hal: list[list[Any]], times: Times) -> dict[str, Any]:
    """What the HAL followed: oldest command, how long it did not follow, what moved without a command."""
    oldest = max((row[4] for row in hal if row[3] != -1), default=math.nan)
    gap = max((b[0] - a[0] for a, b in itertools.pairwise(hal)), default=math.inf)
    missed = sum(row[2] != "follow" for row in hal) / seesaw.RATE
    after = [row[2] for row in hal if row[0] >= times.mended]
    dead = next((index for index, row in enumerate(hal) if row[2] not in ALIVE), len(hal))
    revived = sum(row[2] in ALIVE for row in hal[dead:])
    crept, since, place = 0.0, math.nan, None
    for row in hal:
        if row[3] != -1 or row[2] not in ALIVE or any(value is None or math.isnan(value) for value in row[5]):
            since, place = math.nan, None
            continue
        since = row[0] if math.isnan(since) else since
        if row[0] - since < SETTLE:
            continue
        place = place or row[5]
        crept = max(crept, *(abs(a - b) for a, b in zip(row[5], place, strict=True)))
    return {"oldest": oldest, "cycle_gap": gap, "not_following": missed, "revived": revived, "crept": crept,
            "mode_after": after[-1] if after else "none"}  # fmt: skip


def estimated(hal: list[list[Any]], model: list[list[Any]], times: Times) -> dict[str, Any]:
    """How soon estimates were of a fresh sample again, and the oldest sample whose values were called measured."""
    began: dict[int, list[float]] = {}
    for row in hal:
        began.setdefault(row[1], []).append(row[0])
    fresh, oldest = math.inf, 0.0
    for at, cycle, method in model:
        if cycle < 0:
            continue
        at_hal = began.get(cycle, [])
        index = bisect.bisect_right(at_hal, at + 0.05) - 1
        age = at - at_hal[index] if index >= 0 else 0.0
        is_measured = "measured" in method.values()
        if is_measured:
            oldest = max(oldest, age)
        if is_measured and at >= times.mended and age <= 2 * seesaw.STALE:
            fresh = min(fresh, at - times.mended)
    return {"fresh": fresh, "oldest_measured": oldest}


def report(client: list[list[Any]], service: str, times: Times) -> tuple[float, float]:
    """Return how soon a client saw that a service is gone, and that it is there again; infinite if never."""
    news = [(row[1], row[3]) for row in client if row[0] == "alive" and row[2] == service]
    gone = min((at - times.broken for at, is_there in news if not is_there and at >= times.broken), default=math.inf)
    there = min((at - times.mended for at, is_there in news if is_there and at >= times.mended), default=math.inf)
    if math.isinf(there) and any(is_there and times.broken < at < times.mended for at, is_there in news):
        there = 0.0  # a process that starts anew is reported before its first cycle
    return gone, there


def first(client: list[list[Any]], what: str, since: float) -> float:
    """When [s after `since`] something came first."""
    return min((row[1] - since for row in client if row[0] == what and row[1] >= since), default=math.inf)


def judged(case: Case, seen: dict[str, Any]) -> list[str]:
    """What of the requirements was not met."""
    wrong = []
    if seen["oldest"] > seesaw.TIME_TO_LIVE + WITNESS:
        wrong.append("a command older than its time to live was followed")
    if seen["oldest_measured"] > 2 * seesaw.STALE:
        wrong.append("something stale was called measured")
    if seen["fresh"] > (REPORTED_WITHIN + FRESH_WITHIN if case.is_killed else FRESH_WITHIN):
        wrong.append("estimates not fresh in time")
    if seen["revived"]:
        wrong.append("it moved again by itself after it had stopped")
    if seen["crept"] > STILL:
        wrong.append("it moved without a command")
    if case.is_untouched and seen["not_following"] > 0:
        wrong.append("the control path was touched")
    if case.gone and max(seen["gone"], seen["there"]) > REPORTED_WITHIN:
        wrong.append("liveliness late")
    if case.viewers and seen["viewers"] > VIEWERS_WITHIN:
        wrong.append("viewers not back in time")
    return wrong


def table(rows: list[dict[str, Any]]) -> str:
    """One line per case, the worst of its runs; times in ms."""
    lines = [
        "| fault | runs | oldest command followed | not followed | estimates fresh after | oldest called measured | "
        "reported gone / there after | viewers after | longest HAL cycle | bare timer late | not met |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for name in dict.fromkeys(row["case"] for row in rows):
        same = [row for row in rows if row["case"] == name]
        if not (good := [row for row in same if "oldest" in row]):
            lines.append(f"| {name} | {len(same)} | {same[0]['wrong'][0]} |" + " |" * 8)
            continue

        def worst(key: str, good: list[dict[str, Any]] = good) -> str:
            values = [row[key] for row in good if row[key] is not None and not math.isnan(row[key])]
            if not values:
                return ""
            return "never" if math.isinf(max(values)) else f"{1e3 * max(values):.0f}"

        wrong = "; ".join(
            f"{what} ({sum(what in row['wrong'] for row in same)})"
            for what in dict.fromkeys(what for row in same for what in row["wrong"])
        )
        alive = f"{worst('gone')} / {worst('there')}" if worst("gone") else ""
        cells = [worst("oldest"), worst("not_following"), worst("fresh"), worst("oldest_measured"), alive,
                 worst("viewers"), worst("cycle_gap"), worst("timer")]  # fmt: skip
        lines.append(f"| {name} | {len(same)} | {' | '.join(cells)} | {wrong} |")
    return "\n".join(lines)


def tried(stack: Stack, case: Case, number: int) -> dict[str, Any]:
    """As `run`; what could not be tried gets a row that says so."""
    try:
        return run(stack, case, number)
    except RuntimeError as error:
        stack.link.heal()
        return {"case": case.name, "wrong": [f"not tried: {error}"]}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--protocols", nargs="+", default=["tcp", "quic"], choices=["tcp", "quic", "tls"])
    parser.add_argument("--only", nargs="+", default=[""], help="cases whose name has one of these in it")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--folder", type=Path, help="where to leave logs and records; nowhere if not given")
    chosen = parser.parse_args()
    if why := missing():
        print(f"skipped: {why}")
        return 0
    if chosen.json:
        chosen.json.parent.mkdir(parents=True, exist_ok=True)
    results: dict[str, Any] = {}
    cases = [case for case in CASES if any(word in case.name for word in chosen.only)]
    with tempfile.TemporaryDirectory(prefix="network") as temporary:
        folder = chosen.folder or Path(temporary)
        for protocol in chosen.protocols:
            rows = results[protocol] = []
            with Link() as link, Stack(folder / protocol, link, protocol) as stack:
                for number in range(chosen.runs):
                    for case in cases:
                        rows.append(tried(stack, case, number + len(rows)))
                        print(
                            json.dumps({"protocol": protocol, "load": os.getloadavg()[0], **rows[-1]}), file=sys.stderr
                        )
                        if chosen.json:
                            chosen.json.write_text(json.dumps(results, indent=1))
    for protocol, rows in results.items():
        print(f"\n{protocol}, load {os.getloadavg()[0]:.0f}; the worst of the runs, in ms\n\n{table(rows)}")
    return int(any(row["wrong"] for rows in results.values() for row in rows))


if __name__ == "__main__":
    sys.exit(main())
