"""Training of a network that infers every signal from any mask. `mask_errors` measures it."""

import threading
from concurrent.futures import FIRST_EXCEPTION, ThreadPoolExecutor, wait
from dataclasses import replace
from pathlib import Path

import numpy as np

from gemuco.compiled.blas import cores, one_thread
from gemuco.dataset import Dataset
from gemuco.learning.config import TrainConfig
from gemuco.learning.learner import Progress
from gemuco.learning.train import fit_weights
from gemuco.masks import Mask, all_masks
from gemuco.structure.mask_errors import LISTED, MaskErrors

TRAINED = 2000
"""With more signals the network is trained under this many random masks, and generalises to the others."""


class _Stopped(Exception):
    """A training ends because one beside it failed or was interrupted."""


def train_masks(
    dataset: Dataset,
    config: TrainConfig,
    splits: int = 1,
    progress: Progress | None = None,
    drafts: Path | None = None,
    first: int = 0,
) -> tuple[MaskErrors, ...]:
    """Train one network under all masks per split from `first` on, and return each with its held-out rows.

    The trainings run beside each other, one per core. If one fails, or Ctrl-C comes, the others end with their epoch.

    Raises:
        NotEnoughData: There are too few samples.
    """
    shares, stop = np.zeros(splits), threading.Event()

    def train(split: int) -> MaskErrors:
        def report(done: float, text: str) -> None:
            if stop.is_set():
                raise _Stopped
            shares[split - first] = done
            if progress is not None:
                progress(float(shares.mean()), text)

        return train_split(dataset, config, split, report, drafts)

    with one_thread(), ThreadPoolExecutor(min(splits, cores())) as pool:
        jobs = [pool.submit(train, split) for split in range(first, first + splits)]
        try:
            ended, _ = wait(jobs, return_when=FIRST_EXCEPTION)
            return tuple(job.result() for job in sorted(ended, key=jobs.index))
        finally:
            stop.set()
            pool.shutdown(wait=False, cancel_futures=True)


def train_split(
    dataset: Dataset, config: TrainConfig, split: int, progress: Progress | None = None, drafts: Path | None = None
) -> MaskErrors:
    """Train a network under all masks on one split of the data, and return it with its held-out rows.

    Args:
        dataset: Episodes of one body.
        config: Settings of the training.
        split: Index of the split; successive ones hold out other motions.
        progress: Called after every epoch.
        drafts: A folder in which the training is saved; see `fit`.

    Raises:
        NotEnoughData: There are too few samples.
    """
    own = replace(config, seed=config.seed + split)
    train, held = dataset.split(own.held_out, own.seed)
    resume = None if drafts is None else drafts / f"structure_{split}.safetensors"
    masks = _drawn_masks(dataset.layout.names, own.seed)
    schema, _, _ = fit_weights(dataset, own, masks, progress, title=f"structure, split {split + 1}", resume=resume)
    return MaskErrors.of_schema(schema, train, held, config.outliers)


def _drawn_masks(names: tuple[str, ...], seed: int) -> tuple[Mask, ...]:
    """Return all masks, or the masks that lack one signal and `TRAINED` random masks of all sizes."""
    if len(names) <= LISTED:
        return all_masks(names)
    random = np.random.default_rng(seed)
    drawn = random.random((TRAINED, len(names))) < random.random((TRAINED, 1))
    drawn[~drawn.any(axis=1), 0] = True
    others = ~np.eye(len(names), dtype=bool)
    return tuple(dict.fromkeys(frozenset(np.array(names)[line].tolist()) for line in np.concatenate([others, drawn])))
