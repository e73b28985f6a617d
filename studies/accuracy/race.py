"""How often the race of structure determination puts a mask on the wrong side of the threshold.

    python -m studies.accuracy.race [--seeds 3] [--sure 4] [--bad 3]

Ten signals each: made-up bodies, and the recording of the Schunk arm (folder $GEMUCO_DATA, ../shared/data if that is
not set; left out where it is missing) with its 18 channels in random groups. One network is trained; all masks are
measured on all rows; then thresholds are put between two masks each, anywhere from the best tenth to the worst, and
races are run with them, each on another draw of rows. `--sure` and `--bad` are what a verdict takes (`SURE` and `BAD`
of `gemuco.structure.mask_judge`), to see what they are good for.
"""

import argparse
from collections.abc import Iterator

import numpy as np

from gemuco.dataset import Dataset, Episode
from gemuco.errors import DatasetError
from gemuco.learning.train import TrainConfig
from gemuco.masks import all_masks, bits
from gemuco.signals import Layout, Signal
from gemuco.structure import mask_judge
from gemuco.structure.determination import Judge, Thresholds
from gemuco.structure.mask_training import train_masks
from studies.accuracy.measured_data import recording
from studies.accuracy.synthetic_body import SyntheticBody

TRAINED = TrainConfig(hidden=(100, 50), latent=12, epochs=15, batch=500, rate=3e-3)
SIGNALS, SAMPLES, TRIED = 10, 10_000, 12
OUTPUTS = (0.15, 0.3, 0.5)
"""Thresholds of what is an output: other outputs, other races."""


def regrouped(data: Dataset, seed: int) -> Dataset:
    """The same data with its elements in random groups."""
    order = np.array_split(np.random.default_rng(seed).permutation(data.layout.size), SIGNALS)
    layout = Layout(tuple(Signal(f"s{index}", len(group), "1") for index, group in enumerate(order)))
    rows = np.concatenate(order)
    return Dataset(
        layout,
        tuple(Episode(one.condition, layout.split(data.layout.join(one.values)[:, rows])) for one in data.episodes),
    )


def bodies(seeds: int) -> Iterator[tuple[str, Dataset]]:
    """All that is raced on."""
    for seed in range(seeds):
        yield f"made-up {seed}", SyntheticBody.random(SIGNALS, seed).sample(SAMPLES, seed)
    try:
        _, data = recording("schunk_arm")
    except DatasetError as error:
        print(f"Schunk arm left out: {error}")
        return
    for seed in range(seeds):
        yield f"Schunk arm {seed}", regrouped(data, seed)


def verdicts(data: Dataset, seed: int) -> np.ndarray:
    """Races of one body: masks, rough ones, lost ones, won ones; and by how much the worst is off the threshold."""
    names, random = data.layout.names, np.random.default_rng(seed)
    errors, found = train_masks(data, TRAINED), np.zeros(5)
    every = np.array([bits(m, names) > 0 for m in all_masks(names)])
    for out in OUTPUTS:
        judge = Judge(names, errors, Thresholds(out=out))
        if not judge.outputs.any():
            continue
        masks = every[judge.is_judged(every)]
        truth = judge.of(masks).L_m
        order = np.sort(truth)
        for place in random.integers(len(order) // 10, len(order), TRIED):
            into = float(order[place - 1 : place + 1].mean())
            judge.thresholds = Thresholds(out=out, into=min(into, 1.0))
            judge.draw(int(random.integers(2**31)))
            judged = judge.race(masks)
            told = judged.L_m
            lost, won = (truth < into) & (told >= into), (truth >= into) & (told < into)
            worst = np.abs(truth[lost | won] / into - 1.0).max(initial=0.0)
            found[:4] += len(masks), judged.is_rough.sum(), lost.sum(), won.sum()
            found[4] = max(found[4], worst)
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--sure", type=float, default=mask_judge.SURE, help="standard errors")
    parser.add_argument("--bad", type=int, default=mask_judge.BAD, help="rows")
    options = parser.parse_args()
    mask_judge.SURE, mask_judge.BAD = options.sure, options.bad
    for name, data in bodies(options.seeds):
        masks, rough, lost, won, worst = verdicts(data, 0)
        print(
            f"{name:14s} {masks:6.0f} verdicts, {rough / max(masks, 1):.0%} from few rows, {lost:.0f} wrongly above, "
            f"{won:.0f} wrongly below, at most {worst:.1%} from the threshold"
        )


if __name__ == "__main__":
    main()
