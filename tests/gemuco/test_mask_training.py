import os
import threading
import time

import numpy as np
import pytest

from gemuco.compiled.blas import one_thread
from gemuco.errors import NotEnoughData
from gemuco.learning.config import TrainConfig
from gemuco.structure import mask_training
from gemuco.structure.mask_training import train_masks, train_split

TINY = TrainConfig(hidden=(20,), latent=5, epochs=3, batch=100)
STEPS = 5000


def test_networks_trained_beside_each_other_are_those_trained_alone(data):
    beside = train_masks(data, TINY, 3)
    with one_thread():
        alone = [train_split(data, TINY, split) for split in range(3)]
    for one, other in zip(beside, alone, strict=True):
        np.testing.assert_array_equal(one.from_others(), other.from_others())


def test_the_others_end_when_one_fails(monkeypatch):
    begun, ended = threading.Event(), []

    def train(_data, _config, split, report, _drafts):
        if split == 0:
            begun.wait(1.0)  # on one core the other never begins
            raise NotEnoughData("Too few samples.")
        begun.set()
        try:
            for step in range(STEPS):
                report(step / STEPS, "")
                time.sleep(0.001)
        finally:
            ended.append(step)

    monkeypatch.setattr(mask_training, "train_split", train)
    with pytest.raises(NotEnoughData, match="Too few"):
        train_masks(None, TINY, 2)
    assert begun.is_set() == (len(os.sched_getaffinity(0)) > 1)
    assert all(step < STEPS - 1 for step in ended)
