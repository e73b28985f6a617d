"""Accuracy and time of structure determination with many signals.

    python -m studies.accuracy.structure_search [--signals 12] [--seeds 3] [--samples 10000]

The bodies are synthetic (`studies.bodies`). One network is trained. All 2^n - 1 masks are measured with it (up to 12
signals), and the search uses the same network. A feasible mask of the exhaustive result counts as found if the search
returned it or a feasible part of it. It counts as served if one of the masks of the schema (at most 64) is part of it.
The last line has the result of a perfect model of the body. Times are CPU times, summed over all cores.
"""

import argparse
import time

import numpy as np

from gemuco.learning.train import TrainConfig
from gemuco.masks import bits
from gemuco.structure.determination import Judge, Thresholds, search, select
from gemuco.structure.mask_training import train_masks
from studies.bodies.synthetic_body import SyntheticBody

CONFIG = TrainConfig(hidden=(200, 100), latent=40, activation="relu", epochs=100, batch=500, rate=3e-3)
EXHAUSTIVE = 12


def contains(masks: np.ndarray, parts: np.ndarray) -> np.ndarray:
    """Return for each mask whether it contains one of the parts, shape (masks,)."""
    lacking = (~masks).astype(np.float32) @ parts.T.astype(np.float32)
    return np.asarray((lacking < 0.5).any(axis=1))


def minimal(masks: np.ndarray) -> np.ndarray:
    """Return the masks that contain no other of them."""
    lacking = (~masks).astype(np.float32) @ masks.T.astype(np.float32)
    return masks[(lacking < 0.5).sum(axis=1) == 1]


def run(signals: int, samples: int, seed: int) -> None:
    """Search one body; print the number of feasible masks and the time."""
    body = SyntheticBody.random(signals, seed)
    names, thresholds = body.layout.names, Thresholds()
    started = time.process_time()
    judge = Judge(names, train_masks(body.sample(samples, seed), CONFIG), thresholds)
    trained = time.process_time()
    masks, is_whole = search(judge, seed)
    measured = judge.measured
    structure = select(body.layout, judge, masks, is_whole, seed)
    searched = time.process_time()
    feasible = np.array([bits(m, names) > 0 for m in structure.feasible])
    print(
        f"{signals} signals, body {seed}: training {trained - started:.0f} s, search {searched - trained:.1f} s, "
        f"{measured} masks measured of {2**signals - 1}, {len(feasible)} feasible, {len(minimal(feasible))} of them "
        f"minimal, {len(structure.masks)} kept"
    )
    if signals > EXHAUSTIVE:
        return
    every = (np.arange(1, 2**signals)[:, None] >> np.arange(signals) & 1) > 0
    every = every[judge.is_judged(every)]
    started = time.process_time()
    errors, _ = judge.measure(every)
    known = every[errors < thresholds.into]
    took = time.process_time() - started
    least, sizes = body.least_errors(every), np.array([signal.size for signal in body.layout.signals])
    judged = judge.outputs & ~every
    perfect = every[(least * judged * sizes).sum(axis=1) / (judged * sizes).sum(axis=1) < thresholds.into]
    exhaustive = {line.tobytes() for line in known}
    truth = {line.tobytes() for line in perfect}
    kept = np.array([bits(m, names) > 0 for m in structure.masks])
    returned = {line.tobytes() for line in feasible}
    whole = np.mean([line.tobytes() in returned for line in minimal(known)])
    print(
        f"    exhaustive: {len(known)} feasible, {len(minimal(known))} minimal, {took:.1f} s; found "
        f"{contains(known, feasible).mean():.1%} of them, {whole:.1%} of the minimal, "
        f"{len(returned - exhaustive)} false; served {contains(known, kept).mean():.1%}\n"
        f"    perfect model: {len(truth)} feasible; the network finds {len(truth & exhaustive) / len(truth):.1%} of "
        f"them and {len(exhaustive - truth)} false"
    )


def main() -> None:
    """Run all bodies."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--signals", type=int, nargs="+", default=[12, 16])
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--samples", type=int, default=10_000)
    options = parser.parse_args()
    for signals in options.signals:
        for seed in range(options.seeds):
            run(signals, options.samples, seed)


if __name__ == "__main__":
    main()
