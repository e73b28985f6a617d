"""A synthetic body of many signals whose smallest possible error is known exactly, to test structure determination.

Latent coordinates q ~ N(0, I). Every signal depends on one to three of them: element = g(a . q + noise), where a has a
random direction. The argument of g has variance 1, of which the noise is 1 to 5 %. g(y) = y + sin(y) / 2 is nonlinear
and invertible. The last signal is noise alone. Because g is invertible, x determines y, and y is jointly normal. The
smallest mean squared error that any model can reach therefore has a closed form for every mask (`least_errors`).
"""

from dataclasses import dataclass

import numpy as np

from gemuco.dataset import Dataset, Episode
from gemuco.signals import Layout, Signal

BEND = 0.5


@dataclass(frozen=True)
class SyntheticBody:
    """A synthetic body.

    Attributes:
        layout: The signals, `s0` and so on.
        mixing: a of every element, shape (size, latents).
        noise: Standard deviation of every element's noise, shape (size,).
    """

    layout: Layout
    mixing: np.ndarray
    noise: np.ndarray

    @classmethod
    def random(cls, signals: int, seed: int) -> "SyntheticBody":
        """Make a body with 0.6 times as many latent coordinates as signals."""
        random = np.random.default_rng(seed)
        latents = round(0.6 * signals)
        made, mixing, noise = [], [], []
        for index in range(signals):
            size = int(random.integers(1, 5))
            seen = random.choice(latents, int(random.integers(1, 4)), replace=False)
            made.append(Signal(f"s{index}", size, "1"))
            for _ in range(size):
                share = random.uniform(0.01, 0.05) if index < signals - 1 else 1.0
                a = np.zeros(latents)
                a[seen] = random.normal(size=len(seen))
                mixing.append(np.sqrt(1.0 - share) * a / np.linalg.norm(a))
                noise.append(np.sqrt(share))
        return cls(Layout(tuple(made)), np.array(mixing), np.array(noise))

    def sample(self, count: int, seed: int, episodes: int = 20) -> Dataset:
        """Draw independent samples, in episodes."""
        random = np.random.default_rng(seed)
        y = random.normal(size=(count, self.mixing.shape[1])) @ self.mixing.T
        y += self.noise * random.normal(size=y.shape)
        x = y + BEND * np.sin(y)
        parts = np.array_split(x, episodes)
        return Dataset(self.layout, tuple(Episode("body", self.layout.split(part)) for part in parts))

    def least_errors(self, bits: np.ndarray) -> np.ndarray:
        """Return the least mean squared error of every signal from every mask [standard deviations squared].

        Args:
            bits: One mask per line, shape (masks, signals), truth values.

        Returns:
            Shape (masks, signals); 0 for signals that are given.
        """
        sizes = [signal.size for signal in self.layout.signals]
        starts = np.cumsum([0, *sizes[:-1]])
        covariance = self.mixing @ self.mixing.T + np.diag(self.noise**2)
        errors = np.zeros(bits.shape)
        for index, mask in enumerate(bits):
            given = np.repeat(mask, sizes)
            cross = covariance[:, given]
            explained = np.einsum("ij,ij->i", cross, np.linalg.solve(covariance[np.ix_(given, given)], cross.T).T)
            lost = _second_moment(np.ones(1), 0.0) - _second_moment(np.clip(explained, 0.0, 1.0), 1.0 - explained)
            errors[index] = np.where(mask, 0.0, np.add.reduceat(lost, starts) / sizes) / _second_moment(np.ones(1), 0.0)
        return errors


def _second_moment(spread: np.ndarray, left: np.ndarray | float) -> np.ndarray:
    """Return E[E[g(y) | mu]^2] for y ~ N(mu, left) and mu ~ N(0, spread)."""
    bend = BEND * np.exp(-np.asarray(left) / 2)
    return spread + 2 * bend * spread * np.exp(-spread / 2) + bend**2 * (1 - np.exp(-2 * spread)) / 2
