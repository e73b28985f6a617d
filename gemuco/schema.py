"""The body schema: a learned model of a body, as one immutable value.

A schema never changes. Learning makes another schema (`with_weights`, `with_normal`), so a loop can use one schema
while another thread makes the next.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from html import escape
from typing import Any, NamedTuple, TypeVar

import numpy as np

from gemuco.certainty import Certainty
from gemuco.compiled.chain import pack
from gemuco.compiled.inference import Parts, Predictor
from gemuco.derived import ByPattern
from gemuco.errors import NotFinite, UnknownCondition, UnknownSignal, WrongSize, check_kind
from gemuco.layers import Chain, Weights, run
from gemuco.linear import LinearPath
from gemuco.masks import Mask, bits, label
from gemuco.normal import Normal
from gemuco.scaler import CLIP, Scaler
from gemuco.signals import Layout

T = TypeVar("T")

ErrorTable = Mapping[tuple[str, Mask], np.ndarray]
"""The table maps (method, given signals) to the expected error of every x_out element [unit], shape (out_size,). The
method `input` also estimates signals outside x_out, so its errors are those of the whole layout, shape (size,)."""

ERRORS = "error from mask (% of std)"
"""This is the head of the table of errors."""


PER_SIGNAL = 1.02
"""A mask must lower the squared error by this factor per further signal to be preferred: useless inputs do no harm."""


class Gate(NamedTuple):
    """Share of the network input that a mask determines, float32.

    Attributes:
        through: 0 or 1 for every element of x_in, shape (in_size,).
        line: Regression of the code l of the linear path, shape (in_size + 1, width).
        tail: m and p, shape (signals of x_in + bias_size,).
        direct: Part of the linear path in x_out (`LinearPath.direct`), shape (in_size + 2, out_size).
    """

    through: np.ndarray
    line: np.ndarray
    tail: np.ndarray
    direct: np.ndarray


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class BodySchema:
    """Layout, masks, scaler and network weights of one body.

    Attributes:
        layout: Every signal of the body.
        x_in: Signals the network is given, in the order of the layout.
        x_out: Signals the network infers, in the order of the layout.
        masks: The feasible masks: sets of signals that are enough to infer x_out.
        scaler: Conversion between units and standard deviations.
        weights: The network's W.
        errors: Expected errors on held-out data (1 sigma), see `ErrorTable`.
        anchors: Samples of the training data [standard deviations], shape (n, layout.size), at which a descent starts.
        anchor_conditions: Index into `biases` of every anchor, shape (n,); empty without parametric bias.
        normal: Statistics of the prediction errors of a healthy body; None if unknown.
        bias: The parametric bias p of the present condition, shape (bias_size,).
        biases: Condition -> its p.
        manifest: Further facts that are stored with the schema (JSON values).
        linear: The linear path; of width 0 without one, which is the default.
        shares: Mask -> share of the network in every element of x_out, shape (out_size,), 1 where not given; the rest
            is the linear path itself.
        certainty: Calibration of the std of estimates; None if unknown: the std is then the expected error.
        out_layout: The layout of x_out alone.
        in_index: Positions of the elements of x_in in the layout, shape (in_size,).
        out_index: Positions of the elements of x_out in the layout, shape (out_size,).
    """

    layout: Layout
    x_in: tuple[str, ...]
    x_out: tuple[str, ...]
    masks: tuple[Mask, ...]
    scaler: Scaler
    weights: Weights
    errors: ErrorTable = field(default_factory=dict)
    anchors: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))
    anchor_conditions: np.ndarray = field(default_factory=lambda: np.zeros(0, int))
    normal: Normal | None = None
    bias: np.ndarray = field(default_factory=lambda: np.zeros(0, np.float32))
    biases: Mapping[str, np.ndarray] = field(default_factory=dict)
    manifest: Mapping[str, Any] = field(default_factory=dict)
    linear: LinearPath | None = None
    shares: Mapping[Mask, np.ndarray] = field(default_factory=dict)
    certainty: Certainty | None = None
    out_layout: Layout = field(init=False)
    in_index: np.ndarray = field(init=False)
    out_index: np.ndarray = field(init=False)
    _gates: dict[Mask, Gate] = field(init=False)
    _folded: dict[Mask, Chain] = field(init=False)
    _ranked: dict[str, tuple[Mask, ...]] = field(init=False)
    _derived: dict[Callable[..., Any], Any] = field(init=False)

    def __post_init__(self) -> None:
        set_field = object.__setattr__
        set_field(self, "out_layout", self.layout.subset(self.x_out))
        set_field(self, "in_index", self.layout.indices(self.x_in))
        set_field(self, "out_index", self.layout.indices(self.x_out))
        if self.linear is None:
            set_field(self, "linear", LinearPath.none(len(self.in_index), len(self.out_index)))
        inputs = len(self.in_index) + self.path.width + len(self.x_in) + len(self.bias)
        shape = (self.weights.encoder[0].matrix.shape[0], self.weights.decoder[-1].matrix.shape[1])
        if shape != (inputs, len(self.out_index)):
            raise WrongSize(
                f"The network is {shape[0]} -> {shape[1]}; the layout needs {inputs} -> {len(self.out_index)}."
            )
        set_field(self, "_gates", {})
        set_field(self, "_folded", {})
        set_field(self, "_ranked", {})
        set_field(self, "_derived", {})
        for mask in self.masks:
            self.gate(mask)
        for array in (*self.weights.arrays(), self.anchors, self.bias):
            array.setflags(write=False)

    def __repr__(self) -> str:
        size = f"{len(self.layout.names)} signals ({self.layout.size} elements), {len(self.masks)} masks"
        lines = [
            f"BodySchema of {size}, p of {len(self.bias)}",
            f"  x_in        {', '.join(self.x_in)}",
            f"  x_out       {', '.join(self.x_out)}",
            f"  conditions  {', '.join(self.biases) or 'none'}",
        ]
        return "\n".join(lines)

    def summary(self) -> str:
        """Return tables of the signals and of the root mean square errors of all masks on held-out data."""
        width = max(map(len, self.layout.names))
        lines = [f"{'signal':<{width}}  elements  unit   role"]
        for signal in self.layout.signals:
            roles = [role for role, names in (("x_in", self.x_in), ("x_out", self.x_out)) if signal.name in names]
            poor = " (poor)" if signal.name in self.manifest.get("poor", ()) else ""
            role = (", ".join(roles) or "not used") + poor
            lines.append(f"{signal.name:<{width}}  {signal.size:>8}  {signal.unit:<5}  {role}")
        labels = [label(mask, self.layout.names) for mask in self.masks]
        width, heads = max(map(len, [ERRORS, *labels])), [f"{s.name} [{s.unit}]" for s in self.out_layout.signals]
        lines += ["", "  ".join([f"{ERRORS:<{width}}", *heads])]
        errors = {(row[0], row[1]): f"{row[3]:.3g} ({row[4]:.0f} %)" for row in self.error_rows()}
        for text in labels:
            row = zip(heads, (errors.get((text, name), "") for name in self.x_out), strict=True)
            lines.append("  ".join([f"{text:<{width}}", *(f"{error:>{len(head)}}" for head, error in row)]))
        if self.manifest.get("poor"):
            lines.append(f"POOR: {', '.join(self.manifest['poor'])} is inferred with an error above the threshold.")
        return "\n".join(lines)

    def _repr_html_(self) -> str:
        """Return the signals, and what explains them best, as a small table for notebooks."""
        heads = ("signal", "elements", "unit", "best inferred from", "error")
        rows = []
        for signal in self.layout.signals:
            mask = next((m for m in self.ranked(signal.name) if signal.name not in m), None)
            is_known = signal.name in self.x_out and mask is not None and ("mask", mask) in self.errors
            if is_known and mask is not None:
                rms = float(np.sqrt(np.mean(self.out_layout.split(self.errors["mask", mask])[signal.name] ** 2)))
                percent = 100.0 * float(np.sqrt(self.mask_error(mask, signal.name)))
                best, error = label(mask, self.layout.names).replace("+", " + "), f"{rms:.3g} ({percent:.0f} % of std)"
            else:
                best, error = "not inferred" if signal.name not in self.x_out else "", ""
            rows.append((signal.name, str(signal.size), signal.unit, best, error))
        table = "".join(f"<tr>{''.join(f'<td>{escape(cell)}</td>' for cell in row)}</tr>" for row in rows)
        head = "".join(f"<th>{text}</th>" for text in heads)
        poor = ", ".join(self.manifest.get("poor", ()))
        notes = [f"{len(self.masks)} feasible masks", f"conditions: {', '.join(self.biases) or 'none'}"]
        notes += [f"POOR: {poor}"] if poor else []
        return f"<table><thead><tr>{head}</tr></thead><tbody>{table}</tbody></table><p>{escape('; '.join(notes))}</p>"

    def __reduce__(self) -> tuple[type["BodySchema"], tuple[Any, ...]]:
        """Pickle only the arguments; another process derives the rest again."""
        return BodySchema, tuple(getattr(self, f.name) for f in fields(self) if f.init)

    def derived(self, kind: Callable[["BodySchema"], T]) -> T:
        """Return `kind(schema)`, computed at the first call and then kept with the schema."""
        value = self._derived.get(kind)
        if value is None:
            value = self._derived[kind] = kind(self)
        return value

    def prepare(self, before: "BodySchema") -> None:
        """Compute every value that was derived from another schema, so that no loop has to wait for it later."""
        for kind, value in list(before._derived.items()):
            derived = self.derived(kind)
            if isinstance(derived, ByPattern):
                derived.follow(value)

    @property
    def predictor(self) -> Predictor:
        """The network for compiled code."""
        return self.derived(_predictor)

    @property
    def parts(self) -> Parts:
        """The network as `gemuco.compiled.inference.infer` takes it."""
        return self.derived(_parts)

    @property
    def path(self) -> LinearPath:
        """The linear path, of width 0 without one."""
        assert self.linear is not None
        return self.linear

    def gate(self, mask: Mask) -> Gate:
        """Return the gate of a mask."""
        gate = self._gates.get(mask)
        if gate is None:
            for name in sorted(mask - set(self.x_in)):
                raise UnknownSignal(f"Signal '{name}' is not an input of the network. Inputs: {', '.join(self.x_in)}.")
            m = bits(mask, self.x_in)
            sizes = [self.layout.signal(name).size for name in self.x_in]
            through = np.repeat(m, sizes).astype(np.float32)
            tail = np.concatenate([m, self.bias]).astype(np.float32)
            direct = self.path.direct(through, self.shares.get(mask, np.ones(len(self.out_index))))
            gate = self._gates[mask] = Gate(through, self.path.map(through), tail, direct)
        return gate

    def chain(self, mask: Mask) -> Chain:
        """Return the network under a mask with the linear path folded into its first layer.

        Its inputs are those of `network_input`, but the code l has no effect. It is the same function within the limit
        of the inputs, and its derivatives by x_in are complete.
        """
        folded = self._folded.get(mask)
        if folded is None:
            first, *others = self.weights.whole
            size, matrix = len(self.in_index), first.matrix.copy()
            line, by_code = self.gate(mask).line, first.matrix[size : size + self.path.width]
            matrix[:size] += line[:-1] @ by_code
            matrix[size : size + self.path.width] = 0.0
            begin = first._replace(matrix=matrix, offset=first.offset + line[-1] @ by_code)
            folded = self._folded[mask] = _beside((begin, *others), self.gate(mask).direct)
        return folded

    def ranked(self, name: str) -> tuple[Mask, ...]:
        """Return the feasible masks, sorted by the error of a signal of x_out, the smallest first.

        Of nearly equal masks the one with fewer signals comes first: see `PER_SIGNAL`.
        """
        ranked = self._ranked.get(name)
        if ranked is None:
            key = {mask: self.mask_error(mask, name) * PER_SIGNAL ** len(mask) for mask in self.masks}
            ranked = self._ranked[name] = tuple(sorted(self.masks, key=key.__getitem__))
        return ranked

    def mask_error(self, mask: Mask, name: str) -> float:
        """Return the mean squared held-out error of a signal under a mask [standard deviations]; 1 if unknown."""
        errors = self.errors.get(("mask", mask))
        if errors is None:
            return 1.0
        scaled = errors / self.scaler.std[self.out_index]
        return float(np.mean(scaled[self.out_layout.slice(name)] ** 2))

    def network_input(self, normalised: np.ndarray, mask: Mask, bias: np.ndarray | None = None) -> np.ndarray:
        """Return the network input: x_in masked and clipped, the code l of the linear path, then m and p.

        Args:
            normalised: Every signal [standard deviations], shape (size,) or (samples, size); signals outside the mask
                may be NaN.
            mask: The given signals.
            bias: p of every sample, shape (samples, bias_size), or of all samples; the schema's p if not given.
        """
        through, line, tail, _ = self.gate(mask)
        size, width = line.shape[0] - 1, line.shape[1]
        x = np.empty((*normalised.shape[:-1], size + width + len(tail)), np.float32)
        values = np.where(through, normalised[..., self.in_index], 0.0)
        np.clip(values, -CLIP, CLIP, out=x[..., :size])
        x[..., size : size + width] = values @ line[:-1] + line[-1]
        x[..., size + width :] = tail
        if bias is not None and len(self.bias):
            x[..., -len(self.bias) :] = bias
        return x

    def infer(self, normalised: np.ndarray, mask: Mask, bias: np.ndarray | None = None) -> np.ndarray:
        """Infer x_out from the signals of a mask, usages (a) and (b) [standard deviations], shape (..., out_size).

        See `network_input` for the arguments.
        """
        network = run(self.weights.whole, self.network_input(normalised, mask, bias))
        gate = self.gate(mask)
        line, share = gate.direct[:-1], gate.direct[-1]
        if (share == 1.0).all():
            return network
        values = np.where(gate.through, normalised[..., self.in_index], 0.0)
        return np.asarray(share * network + (values @ line[:-1] + line[-1]), np.float32)

    def normalise(self, values: Mapping[str, np.ndarray]) -> np.ndarray:
        """Join named arrays [unit] into a vector [standard deviations]; NaN for absent and infinite values."""
        return self._normalised(self.layout.join(values))

    def normalise_one(self, values: Mapping[str, np.ndarray]) -> np.ndarray:
        """Join one sample, shape (size,), and refuse several; see `normalise`."""
        return self._normalised(self.layout.join_one(values))

    def _normalised(self, joined: np.ndarray) -> np.ndarray:
        joined[~np.isfinite(joined)] = np.nan
        return self.scaler.normalise(joined)

    def error_rows(self) -> list[tuple[str, str, str, float, float]]:
        """Return the errors on held-out data of every signal under every mask.

        Returns:
            Mask, signal, unit, root mean square error over the signal's elements [unit], and the same in per cent of
            the standard deviation.
        """
        rows: list[tuple[str, str, str, float, float]] = []
        for mask in self.masks:
            errors = self.errors.get(("mask", mask))
            if errors is None:
                continue
            for name, part in self.out_layout.split(errors).items():
                rms = float(np.sqrt(np.mean(part**2)))
                percent = 100.0 * float(np.sqrt(self.mask_error(mask, name)))
                rows.append((label(mask, self.layout.names), name, self.layout.signal(name).unit, rms, percent))
        return rows

    def with_weights(self, weights: Weights, errors: ErrorTable | None = None) -> "BodySchema":
        """Return the same body with another W, and with other errors if given."""
        return replace(self, weights=weights, errors=self.errors if errors is None else errors)

    def with_bias(self, bias: np.ndarray, covariance: np.ndarray | None = None) -> "BodySchema":
        """Return the same network with another p, shape (bias_size,).

        Args:
            bias: p.
            covariance: Covariance of p, shape (bias_size, bias_size); if not given, p is as uncertain as its distance
                from the nearest trained one.

        Raises:
            WrongSize: p does not have this schema's size.
            NotFinite: An element of p is not a finite number.
        """
        p = np.array(bias, np.float32)
        if p.shape != self.bias.shape:
            raise WrongSize(f"p has shape {p.shape}; this schema's has {self.bias.shape}.")
        if not np.isfinite(p).all():
            raise NotFinite(f"p is {p.tolist()}; every element needs a finite number.")
        certainty = self.certainty
        if certainty is not None and (covariance is not None or certainty.covariance is not None):
            certainty = certainty.at(covariance, certainty.unseen, certainty.excess)
        return replace(self, bias=p, certainty=certainty)

    def under(self, condition: str) -> "BodySchema":
        """Return the same network with the trained p of a condition.

        Raises:
            UnknownCondition: No condition has this name.
        """
        if condition not in self.biases:
            known = ", ".join(self.biases) or "none (trained without parametric bias)"
            raise UnknownCondition(f"Condition '{condition}' was not trained. Known conditions: {known}.")
        return self.with_bias(self.biases[condition])

    def with_normal(self, normal: Normal | None) -> "BodySchema":
        """Return the same body with other statistics of prediction errors."""
        return replace(self, normal=normal)

    def with_certainty(self, certainty: Certainty | None) -> "BodySchema":
        """Return the same body with another calibration of the std of estimates."""
        return replace(self, certainty=certainty)

    def with_manifest(self, **facts: Any) -> "BodySchema":
        """Return the same body with more facts in its manifest."""
        return replace(self, manifest={**self.manifest, **facts})


def _beside(chain: Chain, direct: np.ndarray) -> Chain:
    """Return a chain of which the outputs are mixed with the linear path; see `LinearPath.direct`.

    The linear path has a column of its own in every layer for each output that it has a part in.
    """
    line, share = direct[:-1], direct[-1]
    part = np.flatnonzero(share < 1.0)
    if not len(part):
        return chain
    layers = []
    for index, layer in enumerate(chain):
        wide, narrow = layer.matrix.shape
        is_first, is_last = index == 0, index == len(chain) - 1
        above = 0 if is_first else len(part)
        aside = 0 if is_last else len(part)
        matrix = np.zeros((wide + above, narrow + aside), layer.matrix.dtype)
        matrix[:wide, :narrow] = layer.matrix * share if is_last else layer.matrix
        offset = np.zeros(narrow + aside, layer.offset.dtype)
        offset[:narrow] = layer.offset * share if is_last else layer.offset
        if is_first:
            matrix[: len(line) - 1, narrow:] = line[:-1, part]
            offset[narrow:] = line[-1, part]
        elif is_last:
            matrix[wide:, part] = np.eye(len(part))
        else:
            matrix[wide:, narrow:] = np.eye(len(part))
        straight = layer.straight if is_last else layer.straight + aside
        layers.append(layer._replace(matrix=matrix, offset=offset, straight=straight))
    return tuple(layers)


def stacked(schema: BodySchema, masks: Sequence[Mask]) -> Gate:
    """Return the gates of several masks, each array with a row per mask."""
    gates = [schema.gate(mask) for mask in masks]
    if not gates:
        size, tail = len(schema.in_index), len(schema.x_in) + len(schema.bias)
        shapes = (size,), (size + 1, schema.path.width), (tail,), (size + 2, len(schema.out_index))
        return Gate(*(np.zeros((0, *shape), np.float32) for shape in shapes))
    return Gate(*(np.stack(column) for column in zip(*gates, strict=True)))


def check_schema(value: object) -> None:
    """Refuse anything but a body schema as the first argument of a verb.

    Raises:
        WrongKind: The value is not a body schema.
    """
    check_kind("The first argument", value, BodySchema, "a BodySchema")


def _predictor(schema: BodySchema) -> Predictor:
    scale = np.stack([schema.scaler.mean, schema.scaler.std])
    return Predictor(pack(schema.weights.whole), schema.in_index, schema.out_index, scale, CLIP)


def _parts(schema: BodySchema) -> Parts:
    return schema.predictor.parts
