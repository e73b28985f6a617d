"""The model beside ordinary methods: the same rows in the same run, one table.

    python -m studies.peers [--rows PATTERN] [--seeds N] [--ours-only | --peers-only] [--list]

Writes runs/peers/table.md and table.json. Results of the peers are cached in runs/peers/cache, by their data; the model
is trained anew in every run. `--ours-only` takes the peers that are in the cache and computes none.
"""

import argparse
import json
import sys
from collections.abc import Sequence
from fnmatch import fnmatch
from functools import partial
from importlib.util import find_spec
from pathlib import Path

if find_spec("sklearn") is None:
    raise ImportError("The peers need scikit-learn. Run `make peers`, or install the extra `peers`.")

from studies.peers import anomalies, recordings, robots
from studies.peers.anomalies import Fault, window_name
from studies.peers.contest import DETECTORS, ESTIMATORS, Peers, detections, estimates
from studies.peers.question import Body, MissingData, Question
from studies.peers.table import OURS, Row, figures, summary, verdicts

FOLDER = Path("runs/peers")
LEGEND = f"""Every method learned from the same rows and was judged on the same rows; mean ± spread over seeds or folds.
First figure: norm of the error over the elements, mean over the rows, in the unit of the row. In brackets: root mean
square in standard deviations of the training rows. A bar in std and the bars of recordings compare the latter.

Peers: inputs in standard deviations; settings are chosen by held-out blocks of the training rows. Ridge, cubic ridge,
Gaussian process and imputers are fitted for each condition, trees get it one-hot. Cubic ridge has a lower degree with
more than 2500 products. The Gaussian process has a length per input; its kernel is searched on 300 rows, and it keeps
at most 1500; its noise is at least 1e-5 of the variance, the default of scikit-learn. The imputers keep at most 5000
rows.
Detectors keep at most 6000 rows, the boosted residual 3000.

{OURS}: one model for all rows of a body, with the settings in brackets.

Noise of the simulated sensors: KXR 0.002 rad, 0.2 mm (center of gravity), 2 mm (tip), 1 px; PR2 0.0005 rad, 5 mm;
Musashi 0.001 rad, 0.5 N, 0.05 mm."""


def chosen(bodies: Sequence[Body], pattern: str) -> list[tuple[Body, list[Question]]]:
    """Return the bodies and questions whose `body: question` matches a pattern, or contains it."""
    rows = []
    for body in bodies:
        mine = [question for question in body.questions if _matches(f"{body.name}: {question.name}", pattern)]
        if mine:
            rows.append((body, mine))
    return rows


def chosen_faults(faults: Sequence[Fault], pattern: str) -> list[tuple[Fault, list[int]]]:
    """Return the faults and windows whose `fault: window` matches a pattern, or contains it."""
    rows = [(f, [w for w in f.windows if _matches(f"{f.name}: {window_name(w)}", pattern)]) for f in faults]
    return [(fault, windows) for fault, windows in rows if windows]


def _matches(name: str, pattern: str) -> bool:
    return fnmatch(name, pattern) or pattern in name


def run(
    selected: Sequence[tuple[Body, list[Question]]],
    faults: Sequence[tuple[Fault, list[int]]],
    seeds: int,
    peers: Peers,
    has_ours: bool,
) -> list[Row]:
    """Measure every row, and print the rows of a body when they are known; bodies without data are skipped."""
    rows: list[Row] = []
    jobs = [(body.name, partial(estimates, body, asked)) for body, asked in selected]
    jobs += [(fault.name, partial(detections, fault, windows)) for fault, windows in faults]
    for name, job in jobs:
        try:
            part = job(seeds, peers, has_ours)
        except MissingData as error:
            print(f"skipped {name}: {error}", file=sys.stderr)
            continue
        print(verdicts(part), figures(part, DETECTORS if part[0].bar.is_score else ESTIMATORS), sep="\n\n", flush=True)
        rows += part
    return rows


def whole(rows: Sequence[Row]) -> str:
    """Return the whole text of the result."""
    errors = [row for row in rows if not row.bar.is_score]
    scores = [row for row in rows if row.bar.is_score]
    parts = [verdicts(rows), figures(errors, ESTIMATORS), figures(scores, DETECTORS), summary(rows), LEGEND]
    return "\n\n".join(part for part in parts if part)


def main() -> int:
    """Run the study."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rows", default="*", help="pattern of `body: missing signal`, or a part of it")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--ours-only", action="store_true", help="compute no peer that is not in the cache")
    parser.add_argument("--peers-only", action="store_true", help="train no model")
    parser.add_argument("--list", action="store_true", help="list the rows")
    options = parser.parse_args()
    peers = Peers(FOLDER / "cache", options.ours_only)
    selected = chosen([*robots.bodies(), *recordings.bodies()], options.rows)
    faults = chosen_faults(anomalies.faults(peers.record), options.rows)
    if not selected and not faults:
        print(f"No row matches '{options.rows}'. --list shows all rows.", file=sys.stderr)
        return 2
    if options.list:
        print(*(f"{body.name}: {question.name}" for body, asked in selected for question in asked), sep="\n")
        print(*(f"{fault.name}: {window_name(w)}" for fault, windows in faults for w in windows), sep="\n")
        return 0
    rows = run(selected, faults, options.seeds, peers, not options.peers_only)
    text = whole(rows)
    FOLDER.mkdir(parents=True, exist_ok=True)
    (FOLDER / "table.md").write_text(text + "\n")
    (FOLDER / "table.json").write_text(json.dumps([row.record() for row in rows], indent=1))
    print(f"\n{summary(rows)} All rows are in {FOLDER}/table.md.")
    return 0


if __name__ == "__main__":
    sys.exit(main())
