"""Noisy measurements that are combined with their estimates."""

import numpy as np
import pytest
from arm_model import arm, sample_of, small_model, states
from msgspec.structs import replace

from hal.clock import ManualClock
from services.model.estimation import Estimation, Freshness
from services.model.fusion import LEAST, Fusion, Noise
from services.wire.messages import Estimates, Sample
from services.wire.streams import Arrival

NOISE = 0.3  # rad


def test_noise_is_measured_on_a_smooth_motion() -> None:
    random, noise = np.random.default_rng(0), Noise(2)
    for step in range(400):
        noise.see(np.array([np.sin(0.02 * step) + 0.01 * random.standard_normal(), np.nan]))
        assert np.isfinite(noise.std[0]) == (step >= LEAST + 1)
    assert noise.std[0] == pytest.approx(0.01, rel=0.15)
    assert np.isnan(noise.std[1])


class Bench:
    """A slow motion of the arm between two states, with noisy joint encoders."""

    def __init__(self, fuse: bool) -> None:
        self.clock, self.random = ManualClock(), np.random.default_rng(1)
        self.newest: Arrival[Sample] | None = None
        self.published: list[Estimates] = []
        freshness = Freshness(arm(), lambda: self.newest, self.clock)
        fusion = Fusion(small_model().layout.size) if fuse else None
        self.estimation = Estimation(freshness, small_model, self.published.append, self.clock, fusion=fusion)

    def move(self, count: int, offset: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
        """Return published and true joint positions [rad], each of shape (count, 5)."""
        begin, published, true = sample_of(3), [], []
        for index in range(count):
            near = {name: value[3] + 1e-4 * index * (value[4] - value[3]) for name, value in states().items()}
            noisy = near["joint_position"] + NOISE * self.random.standard_normal(5) + offset
            sample = replace(begin, cycle=index, values=near | {"joint_position": noisy})
            self.newest = Arrival(sample, self.clock.monotonic())
            self.estimation.tick()
            published.append(self.published[-1].values["joint_position"])
            true.append(near["joint_position"])
        return np.array(published), np.array(true)


def test_a_noisy_measurement_is_better_fused_and_marked() -> None:
    errors = {}
    for fuse in (False, True):
        bench = Bench(fuse)
        published, true = bench.move(200)
        errors[fuse] = float(np.sqrt(np.mean((published - true)[100:] ** 2)))
        message = bench.published[-1]
        assert message.method["joint_position"] == ("fused" if fuse else "measured")
        assert not message.estimated["joint_position"].any()
        assert (message.std["joint_position"] > 0.0).any() == fuse
        assert bench.estimation.counts()["estimated"] == 0
    assert errors[False] == pytest.approx(NOISE, rel=0.1)
    assert errors[True] < 0.7 * errors[False]


def test_a_measurement_that_disagrees_is_not_fused() -> None:
    bench = Bench(True)
    bench.move(100)
    published, true = bench.move(20, offset=5.0)
    assert bench.published[-1].method["joint_position"] == "measured"
    assert np.abs(published - true - 5.0).max() < 5.0 * NOISE


def test_nothing_is_fused_before_the_noise_is_known() -> None:
    bench = Bench(True)
    bench.move(LEAST)
    assert {message.method["joint_position"] for message in bench.published} == {"measured"}
