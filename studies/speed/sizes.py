"""Growth of costs: inference and searches with the network, recognition with signals, the step on W with its batch.

python -m studies.speed.sizes        # writes docs/images/cost.png
"""

from functools import partial
from pathlib import Path

import matplotlib as mpl
import numpy as np

from gemuco.adaption.config import UpdateConfig
from gemuco.adaption.recognise import Kalman
from gemuco.adaption.update import Updater
from gemuco.compiled.inference import infer
from gemuco.estimation import estimate
from gemuco.search.descent import NewtonConfig
from studies.speed.bodies import body
from studies.speed.solvers import BALANCE, PAPER, TERMS, Ours
from studies.speed.table import Job, timed

HIDDEN = (50, 100, 200, 300, 400)
SIGNALS = (3, 6, 10, 20, 30)
WINDOW = (20, 50, 100, 200, 500, 1000)
NAMED = "estimate, named arrays"
PICTURE = Path("docs/images/cost.png")


def median(job: Job, calls: int) -> float:
    """Return the median time of one call [us]."""
    job()
    return float(np.median([timed(job, 1) for _ in range(calls)]))


def by_hidden() -> dict[str, list[float]]:
    """Return the times of searches and inference with wider layers [us]."""
    times: dict[str, list[float]] = {}
    for hidden in HIDDEN:
        schema = body((hidden, hidden))
        size, gate = schema.layout.size, schema.gate(schema.masks[0])
        arguments = (*schema.parts, np.zeros(size), *gate, np.ones(size, bool), np.empty(size))
        plain, balanced = Ours(schema, "e", TERMS), Ours(schema, "e", (*TERMS, BALANCE))
        for name, job, calls in (
            ("estimate by mask", partial(infer, *arguments), 300),
            ("default search", partial(plain.solve, NewtonConfig()), 30),
            ("default search, torque balance", partial(balanced.solve, NewtonConfig()), 15),
            ("descent 20 x 30", partial(plain.solve, PAPER), 15),
        ):
            times.setdefault(name, []).append(median(job, calls))
    return times


def by_signals() -> dict[str, list[float]]:
    """Return the times of inference and recognition of p with more signals of three elements [us]."""
    times: dict[str, list[float]] = {NAMED: [], "p update": []}
    random = np.random.default_rng(0)
    for count in SIGNALS:
        signals = {f"s{index}": (3, "1") for index in range(count)}
        masks = tuple(frozenset(signals) - {f"s{index}"} for index in range(3))
        schema = body((200, 200), 15, 2, signals, masks, 300)
        values = {name: random.standard_normal(3) for name in signals if name != "s0"}
        row, seen = random.standard_normal(schema.layout.size), Kalman(schema)
        for _ in range(20):
            seen.see(schema, random.standard_normal(schema.layout.size))
        times[NAMED].append(median(partial(estimate, schema, values), 100))
        times["p update"].append(median(partial(seen.see, schema, row), 50))
    return times


def by_window() -> dict[str, list[float]]:
    """Return the time of one step on W with more samples, each under three masks [us]."""
    times: dict[str, list[float]] = {"W update, 3 masks": []}
    random = np.random.default_rng(0)
    for batch in WINDOW:
        schema = body((200, 200))
        config = UpdateConfig(what="weights", steps=1, batch=batch, window=batch, replay=0, held_out=0, minimum=1)
        updater = Updater(schema, config)
        for _ in range(batch):
            updater.add(schema.layout.split(random.standard_normal(schema.layout.size)))
        times["W update, 3 masks"].append(median(partial(updater._relearner.step, schema, 1, True, False), 15))
    return times


def draw(where: Path = PICTURE) -> None:
    """Measure, and write the picture."""
    mpl.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(1, 3, figsize=(13, 4), sharey=True)
    for axis, label, at, times in zip(
        axes,
        ("width of the hidden layers", "signals of three elements, hidden 200", "samples in a batch, hidden 200"),
        (HIDDEN, SIGNALS, WINDOW),
        (by_hidden(), by_signals(), by_window()),
        strict=True,
    ):
        for name, values in times.items():
            axis.plot(at, np.array(values) / 1e3, marker="o", label=name)
        axis.set(xlabel=label, yscale="log", xscale="log")
        axis.set_xticks(at, [str(size) for size in at])
        axis.minorticks_off()
        axis.grid(alpha=0.3)
        axis.legend(fontsize=8)
    axes[0].set_ylabel("time of one call [ms]")
    figure.tight_layout()
    where.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(where, dpi=110)


if __name__ == "__main__":
    draw()
