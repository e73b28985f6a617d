"""One network under all masks for each split of the data, which structure determination then asks about any mask."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from gemuco.dataset import Dataset
from gemuco.errors import NotEnoughData
from gemuco.learning.train import Job, Progress, TrainConfig, Work, together
from gemuco.masks import Mask, all_masks
from gemuco.scaler import Scaler
from gemuco.structure.mask_errors import MaskErrors

LISTED = 10
"""Up to so many signals every mask is tried."""
ROUNDS = (("structure", 1.0),)
"""See `together`."""
TRAINED = 2000
"""With more signals the network is trained with so many masks, and is right about the others too."""


def train_masks(
    dataset: Dataset,
    config: TrainConfig,
    splits: int = 1,
    progress: Progress | None = None,
    drafts: Path | None = None,
) -> tuple[MaskErrors, ...]:
    """One network per split, and what it makes of masks on the episodes that it did not see."""
    return together([training_masks(dataset, config, splits, drafts)], ROUNDS, progress)[0]


def training_masks(
    dataset: Dataset, config: TrainConfig, splits: int, drafts: Path | None
) -> Work[tuple[MaskErrors, ...]]:
    """`train_masks`, for whoever has the trainings done."""
    jobs, parts = [], []
    for split in range(splits):
        own = replace(config, seed=config.seed + split)
        parts.append(dataset.split(own.held_out, own.seed))
        _check_alive(parts[-1][0])
        resume = None if drafts is None else drafts / f"structure_{split}.safetensors"
        jobs.append(Job(dataset, own, _drawn_masks(dataset.layout.names, own.seed), resume=resume))
    trained = yield jobs
    return tuple(
        MaskErrors.of_schema(schema, *part, config.outliers) for (schema, _), part in zip(trained, parts, strict=True)
    )


def _check_alive(train: Dataset) -> None:
    """Refuse signals about which there is nothing to say."""
    rows = train.rows()
    dead = np.isin(np.arange(train.layout.size), Scaler.fit(train.layout, rows).dead)
    for name in train.layout.names:
        span = train.layout.slice(name)
        if dead[span].all():
            fact = "never varies" if np.isfinite(rows[:, span]).any() else "was never measured"
            raise NotEnoughData(
                f"Signal '{name}' {fact} in the training data, so nothing can be learned of it; collect data in which "
                "it moves, or leave it out of the model."
            )


def _drawn_masks(names: tuple[str, ...], seed: int) -> tuple[Mask, ...]:
    """All masks, or `TRAINED` random ones of all sizes from which the network learns to do with any."""
    if len(names) <= LISTED:
        return all_masks(names)
    random = np.random.default_rng(seed)
    drawn = random.random((TRAINED, len(names))) < random.random((TRAINED, 1))
    drawn[~drawn.any(axis=1), 0] = True
    others = ~np.eye(len(names), dtype=bool)
    return tuple(dict.fromkeys(frozenset(np.array(names)[line].tolist()) for line in np.concatenate([others, drawn])))
