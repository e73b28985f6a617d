"""Inputs, masks and outputs of a training, as arrays."""

from dataclasses import dataclass, field

import numpy as np

from gemuco.linear import LinearPath
from gemuco.masks import Mask, bits
from gemuco.scaler import CLIP
from gemuco.signals import Layout


@dataclass(frozen=True, slots=True, eq=False)
class Task:
    """Masks and signals as arrays.

    Attributes:
        layout: Every signal.
        masks: Feasible masks.
        x_out: Signals to infer, in the order of the layout.
        linear: The linear path; without code if not given.
        x_in: Union of the masks, in the order of the layout.
        in_index: Indices of the elements of x_in in the layout, shape (in_size,).
        out_index: Indices of the elements of x_out in the layout, shape (out_size,).
        signal_of: Index of the signal that each element of the layout belongs to, shape (layout.size,).
        needs: 1 for the signals of the layout that a mask contains, else 0, shape (masks, signals), float32.
        tails: m of every mask as the network receives it, shape (masks, signals of x_in), float32.
        through: 1 for the elements of x_in that a mask lets through, else 0, shape (masks, in_size), float32.
        paths: Regression of the code l under every mask, shape (masks, in_size + 1, width), float32.
    """

    layout: Layout
    masks: tuple[Mask, ...]
    x_out: tuple[str, ...]
    linear: LinearPath | None = None
    x_in: tuple[str, ...] = field(init=False)
    in_index: np.ndarray = field(init=False, repr=False)
    out_index: np.ndarray = field(init=False, repr=False)
    signal_of: np.ndarray = field(init=False, repr=False)
    needs: np.ndarray = field(init=False, repr=False)
    tails: np.ndarray = field(init=False, repr=False)
    through: np.ndarray = field(init=False, repr=False)
    paths: np.ndarray = field(init=False, repr=False)

    def __post_init__(self) -> None:
        set_field = object.__setattr__
        layout = self.layout
        x_in = tuple(name for name in layout.names if any(name in m for m in self.masks))
        set_field(self, "x_in", x_in)
        set_field(self, "in_index", layout.indices(x_in))
        set_field(self, "out_index", layout.indices(self.x_out))
        set_field(self, "signal_of", np.repeat(np.arange(len(layout.names)), [s.size for s in layout.signals]))
        set_field(self, "needs", np.stack([bits(m, layout.names) for m in self.masks]))
        set_field(self, "tails", np.stack([bits(m, x_in) for m in self.masks]))
        set_field(self, "through", np.repeat(self.tails, [layout.signal(name).size for name in x_in], axis=1))
        set_field(self, "paths", np.stack([self.path.map(through) for through in self.through]))

    @property
    def path(self) -> LinearPath:
        """The linear path, of width 0 without one."""
        return self.linear or LinearPath.none(len(self.in_index), len(self.out_index))

    def any_of(self, elements: np.ndarray) -> np.ndarray:
        """Return whether any element of each signal is true, (samples, layout.size) -> (samples, signals)."""
        starts = np.searchsorted(self.signal_of, np.arange(len(self.layout.names)))
        return np.logical_or.reduceat(elements, starts, axis=1)

    def allowed(self, present: np.ndarray) -> np.ndarray:
        """Return whether each mask has all its signals, shape (samples, masks).

        Args:
            present: Whether each element is present, shape (samples, layout.size).
        """
        absent = self.any_of(~present).astype(np.float32)
        return absent @ self.needs.T < 0.5

    def inputs(self, x: np.ndarray, index: int, bias: np.ndarray) -> np.ndarray:
        """Return x_in, the code l, m and p under one mask, shape (samples, inputs), float32.

        Args:
            x: Every signal [standard deviations], shape (samples, layout.size); NaN counts as the mean.
            index: Index of the mask.
            bias: p of every sample, shape (samples, bias_size).
        """
        through = self.through[index]
        values = np.nan_to_num(np.where(through > 0, x[:, self.in_index], 0.0))
        code = values @ self.paths[index, :-1] + self.paths[index, -1]
        tail = np.broadcast_to(self.tails[index], (len(x), len(self.x_in)))
        return np.concatenate([np.clip(values, -CLIP, CLIP), code, tail, bias], axis=1, dtype=np.float32)
