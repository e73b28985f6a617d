"""Structure determination beside a loop over masks in torch, both on all cores.

    python -m studies.speed.structure

gemuco and the loop measure the same masks of ten signals on 1000 rows with the same trained network.
"""

from collections.abc import Iterator

import numpy as np
import torch
from joblib import cpu_count

from gemuco.learning.train import TrainConfig
from gemuco.masks import all_masks, bits
from gemuco.structure.determination import Judge, Thresholds
from gemuco.structure.mask_training import train_masks
from studies.bodies.synthetic_body import SyntheticBody
from studies.speed.bodies import module
from studies.speed.table import Row, faster, show

SAMPLES, BATCH, BAR = 10_000, 100, 4.0
TRAINING = TrainConfig(hidden=(200, 100), latent=20, epochs=60, batch=500, rate=3e-3)


def rows() -> Iterator[Row]:
    """Measure all masks of ten signals."""
    made = SyntheticBody.random(10, 0)
    names, sizes = made.layout.names, [signal.size for signal in made.layout.signals]
    judge = Judge(names, train_masks(made.sample(SAMPLES, 0), TRAINING), Thresholds())
    (errors,) = judge.errors
    masks = np.array([bits(m, names) > 0 for m in all_masks(names)])
    masks = masks[judge.is_judged(masks)]
    network, data = module(errors.chain), torch.from_numpy(errors.x)

    @torch.no_grad()
    def by_torch() -> np.ndarray:
        measured = []
        for mask in masks:
            through = np.repeat(mask, sizes).astype(np.float32)
            gate, line = torch.from_numpy(through), torch.from_numpy(errors.path.map(through).astype(np.float32))
            tail = torch.from_numpy(mask.astype(np.float32))
            squared = []
            for part in data.split(BATCH):
                given = part * gate
                code = given @ line[:-1] + line[-1]
                inputs = torch.cat([given, code, tail.expand(len(part), -1)], dim=1)
                squared.append((network(inputs) - part) ** 2)
            outputs = torch.from_numpy(np.repeat(judge.outputs & ~mask, sizes))
            measured.append(float(torch.cat(squared)[:, outputs].mean()))
        return np.array(measured)

    def measure() -> np.ndarray:
        judge.splits[0].known.clear()  # measured masks are remembered
        return judge.measure(masks)[0]

    torch.set_num_threads(cpu_count())
    np.testing.assert_allclose(measure(), by_torch(), rtol=2e-3)
    note = f"on {cpu_count()} cores; both measure the same L_m of {len(masks)} masks"
    yield faster(
        "structure, 10 signals, all masks x 1000 rows",
        "loop over masks in torch",
        measure,
        by_torch,
        BAR,
        note,
        rounds=5,
    )
    torch.set_num_threads(1)


if __name__ == "__main__":
    show(rows())
