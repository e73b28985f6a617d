"""A body schema on disk: a safetensors file for the arrays, manifest.json for everything else.

The manifest names the file of its arrays, so the replacement of the manifest replaces the model in one step. The model
before is kept: its manifest has the suffix `KEPT`.
"""

import hashlib
import json
import re
from collections.abc import Callable, Iterable, Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load as load_tensors
from safetensors.numpy import save as save_tensors

from gemuco.certainty import Certainty
from gemuco.errors import CheckpointError, SchemaError
from gemuco.layers import LINEAR, Chain, Layer, Weights, check_activation
from gemuco.linear import LinearPath
from gemuco.masks import Mask, label
from gemuco.normal import Normal
from gemuco.normal.soundness import check_normal
from gemuco.scaler import FLOOR, Scaler
from gemuco.schema import BodySchema, check_schema
from gemuco.signals import Layout, Signal
from gemuco.writing import replace, replacing, writing

FORMAT = "gemuco.body_schema"
VERSION = 4
READABLE = (2, 3, 4)
"""Versions that can be read; version 2 has no linear path, version 3 has it within the network only."""
TENSORS = re.compile(r"model(-[0-9a-f]+)?\.safetensors")
"""Names of files of arrays; models of the format before have no hash in this name."""
MANIFEST = "manifest.json"
KEPT = MANIFEST + ".before"
"""Manifest of the model before the last save; move it to `MANIFEST` to go back to that model."""
GAPS = ("normal.mean", "normal.rows", "normal.cloud")
"""These arrays are NaN where nothing is known."""
SIGNATURE = "signature"
"""Entry of the manifest; it is not part of what is signed."""
SCALES = ("mean", "std", "low", "high", "dead")
PATH = ("moments", "cross", "outputs")
NARROWEST = 1e-5
"""The standard deviation of an element is at least this share of its range: it left its mean in one of 1e10 samples."""


def save(schema: BodySchema, folder: str | Path) -> None:
    """Write a model into a folder in one step; a process that is killed meanwhile leaves the former model.

    The former model is kept beside it (`KEPT`), and older ones are removed. The manifest has a hash of the arrays and a
    hash of itself, so that `load` detects damage.

    Raises:
        NotWritten: The disk is full, or the folder may not be written to.
        CheckpointError: `load` would refuse it, so the former model stays.
    """
    check_schema(schema)
    folder = Path(folder)
    try:
        _check_arrays(schema)
    except ValueError as error:
        raise CheckpointError(f"The model is not saved in '{folder}', because it is not sound: {error}.") from None
    data = save_tensors({name: np.ascontiguousarray(array) for name, array in _tensors(schema).items()})
    digest = hashlib.sha256(data).hexdigest()
    name = f"model-{digest[:12]}.safetensors"
    text = json.dumps(signed(_head(schema) | {"tensors": {"file": name, "sha256": digest}}), indent=2).encode()
    with writing("The model", folder), replacing(folder / MANIFEST) as manifest:
        kept = _keep(folder, text)
        replace(folder / name, data)
        for old in folder.glob("model*.safetensors*"):
            if old.name not in (name, *kept):
                old.unlink()
        manifest.write(text)


def _keep(folder: Path, text: bytes) -> list[str]:
    """Keep the present model if it is whole and another one; return the files of arrays that are still needed."""
    files = []
    for path in (folder / KEPT, folder / MANIFEST):
        try:
            present = path.read_bytes()
            head = _manifest(path)
            _data(folder, head)
        except (OSError, CheckpointError, KeyError, TypeError):
            continue  # it is missing or damaged
        files.append(head["tensors"]["file"])
        if path.name == MANIFEST and present != text:
            replace(folder / KEPT, present)
    return files


def _head(schema: BodySchema) -> dict[str, Any]:
    """Return the manifest without the entry on arrays and without its hash."""
    return {
        "format": FORMAT,
        "version": VERSION,
        "signals": [
            {"name": s.name, "size": s.size, "unit": s.unit, "elements": list(s.elements)}
            for s in schema.layout.signals
        ],
        "x_in": list(schema.x_in),
        "x_out": list(schema.x_out),
        "masks": [label(mask, schema.layout.names) for mask in schema.masks],
        "network": {
            "encoder": [layer.activation for layer in schema.weights.encoder],
            "decoder": [layer.activation for layer in schema.weights.decoder],
            "straight": [layer.straight for layer in schema.weights.whole],
        },
        "errors": _labels(schema, schema.errors),
        "conditions": list(schema.biases),
        "normal": None if schema.normal is None else schema.normal.facts(),
        "certainty": None if schema.certainty is None else _labels(schema, schema.certainty.ways),
        "facts": dict(schema.manifest),
    }


def _labels(schema: BodySchema, ways: Iterable[tuple[str, Mask]]) -> list[list[str]]:
    return [[method, label(mask, schema.layout.names)] for method, mask in ways]


def _ways(labels: Iterable[tuple[str, str]]) -> list[tuple[str, Mask]]:
    return [(method, frozenset(text.split("+")) if text else frozenset()) for method, text in labels]


def signed(head: Mapping[str, Any]) -> dict[str, Any]:
    """Return the manifest with the hash of all its other entries but its signature."""
    own = {name: value for name, value in head.items() if name != "sha256"}
    text = json.dumps({name: value for name, value in own.items() if name != SIGNATURE}, sort_keys=True)
    return {**own, "sha256": hashlib.sha256(text.encode()).hexdigest()}


def sign(folder: str | Path, signer: Callable[[bytes], str]) -> None:
    """Write a signature into the manifest of a saved model, in one step.

    Args:
        folder: The model.
        signer: Returns the signature of the digest of the whole model.

    Raises:
        CheckpointError: The model cannot be loaded.
        NotWritten: The folder may not be written to.
    """
    folder = Path(folder)
    load(folder)
    with writing("The signature", folder), replacing(folder / MANIFEST) as manifest:
        head = _manifest(folder / MANIFEST)
        manifest.write(json.dumps(head | {SIGNATURE: signer(_digest(head))}, indent=2).encode())


def _digest(head: Mapping[str, Any]) -> bytes:
    """Return a digest that covers manifest and arrays, and is no digest of anything else."""
    return f"{FORMAT} {head['sha256']}".encode()


def _tensors(schema: BodySchema) -> dict[str, np.ndarray]:
    tensors: dict[str, np.ndarray] = {}
    for part, chain in (("encoder", schema.weights.encoder), ("decoder", schema.weights.decoder)):
        for index, layer in enumerate(chain):
            tensors[f"{part}.{index}.matrix"] = layer.matrix
            tensors[f"{part}.{index}.offset"] = layer.offset
    for name in SCALES:
        tensors[f"scaler.{name}"] = getattr(schema.scaler, name)
    for index, array in enumerate(schema.errors.values()):
        tensors[f"errors.{index}"] = array
    for index, array in enumerate(schema.biases.values()):
        tensors[f"biases.{index}"] = array
    for name in PATH:
        tensors[f"linear.{name}"] = getattr(schema.path, name)
    for index, mask in enumerate(schema.masks):
        tensors[f"shares.{index}"] = schema.shares.get(mask, np.ones(len(schema.out_index)))
    tensors["bias"] = schema.bias
    tensors["anchors"] = schema.anchors
    tensors["anchor_conditions"] = schema.anchor_conditions
    if schema.normal is not None:
        tensors |= {f"normal.{name}": array for name, array in schema.normal.arrays().items()}
    if schema.certainty is not None:
        tensors |= {f"certainty.{name}": array for name, array in schema.certainty.arrays().items()}
    return tensors


def load(folder: str | Path, verify: Callable[[bytes, str], None] | None = None) -> BodySchema:
    """Read a schema that `save` wrote.

    Args:
        folder: The model.
        verify: Called with the digest of the whole model and its signature, which is empty without one; it raises an
            error if the model may not be used.

    Raises:
        CheckpointError: The model is missing, damaged, not a body schema, or of another version.
    """
    folder = Path(folder)
    head = _manifest(folder / MANIFEST)
    if verify is not None:
        verify(_digest(head), str(head.get(SIGNATURE, "")))
    try:
        schema = _schema(head, load_tensors(_data(folder, head)))
        _check_arrays(schema)
        return schema
    except CheckpointError:
        raise
    except (KeyError, TypeError, ValueError, AttributeError, IndexError, SafetensorError, SchemaError) as error:
        reason = str(error).strip("'\"").rstrip(".")
        raise CheckpointError(
            f"The model in '{folder}' is damaged ({type(error).__name__}: {reason}); {_advice(folder)}."
        ) from None


def _data(folder: Path, head: Mapping[str, Any]) -> bytes:
    """Return the arrays of a manifest as they are in the file, checked against the hash in the manifest."""
    name, digest = head["tensors"]["file"], head["tensors"]["sha256"]
    if not TENSORS.fullmatch(name):
        raise CheckpointError(f"The manifest in '{folder}' names {name!r} in place of a file of arrays beside it.")
    try:
        data = (folder / name).read_bytes()
    except OSError:
        raise CheckpointError(f"The model in '{folder}' has no {name}; {_advice(folder)}.") from None
    if hashlib.sha256(data).hexdigest() != digest:
        raise CheckpointError(f"{name} in '{folder}' does not match its manifest; {_advice(folder)}.")
    return data


def _advice(folder: Path) -> str:
    again = "train the model again"
    return f"{again}, or go back to the model before ({KEPT})" if (folder / KEPT).exists() else again


def _manifest(path: Path) -> dict[str, Any]:
    folder = path.parent
    try:
        head = json.loads(path.read_bytes())
    except OSError:
        raise CheckpointError(f"There is no model in '{folder}': {MANIFEST} is missing. Run `gemuco train`.") from None
    except (ValueError, RecursionError):
        raise CheckpointError(f"'{path}' is damaged: it is not JSON; {_advice(folder)}.") from None
    if not isinstance(head, dict) or head.get("format") != FORMAT:
        kind = head.get("format") if isinstance(head, dict) else type(head).__name__
        raise CheckpointError(f"'{path}' does not describe a body schema but {kind!r}.")
    version = head.get("version")
    if version not in READABLE:
        newer = isinstance(version, int) and version > VERSION
        advice = "use a newer gemuco" if newer else "train it again"
        raise CheckpointError(
            f"The model in '{folder}' has version {version!r}; this gemuco reads {VERSION}: {advice}."
        )
    if signed(head) != head:
        raise CheckpointError(f"'{path}' is damaged: it was changed after it was written; {_advice(folder)}.")
    return head


def _schema(head: Mapping[str, Any], tensors: Mapping[str, np.ndarray]) -> BodySchema:
    layout = Layout(tuple(Signal(s["name"], s["size"], s["unit"], tuple(s["elements"])) for s in head["signals"]))
    for name, array in tensors.items():
        if name not in GAPS and not name.startswith("errors.") and not np.isfinite(array).all():
            raise ValueError(f"array {name} holds NaN or infinity")
    normal = None
    if head["normal"] is not None:
        parts = {name.removeprefix("normal."): array for name, array in tensors.items() if name.startswith("normal.")}
        normal = Normal.of(parts, head["normal"])
    masks = tuple(frozenset(text.split("+")) for text in head["masks"])
    certainty = None
    if head.get("certainty") is not None:  # older models have none
        parts = {name.removeprefix("certainty."): array for name, array in tensors.items()}
        certainty = Certainty.of(tuple(_ways(head["certainty"])), parts)
    return BodySchema(
        layout=layout,
        x_in=tuple(head["x_in"]),
        x_out=tuple(head["x_out"]),
        masks=masks,
        scaler=Scaler(*(tensors[f"scaler.{name}"] for name in SCALES)),
        weights=_weights(head, tensors),
        errors={way: tensors[f"errors.{index}"] for index, way in enumerate(_ways(head["errors"]))},
        anchors=tensors["anchors"],
        anchor_conditions=tensors["anchor_conditions"],
        normal=normal,
        bias=tensors["bias"],
        biases={condition: tensors[f"biases.{index}"] for index, condition in enumerate(head["conditions"])},
        manifest=head["facts"],
        linear=_path(tensors, layout.subset(tuple(head["x_out"])).size) if head["version"] > 2 else None,
        shares={mask: tensors[f"shares.{i}"] for i, mask in enumerate(masks)} if head["version"] > 3 else {},
        certainty=certainty,
    )


def _path(tensors: Mapping[str, np.ndarray], outputs: int) -> LinearPath:
    """Return the linear path; version 3 does not have its outputs, and does not need them."""
    moments, cross = tensors["linear.moments"], tensors["linear.cross"]
    return LinearPath(moments, cross, tensors.get("linear.outputs", np.zeros((cross.shape[2] + 1, outputs))))


def _weights(head: Mapping[str, Any], tensors: Mapping[str, np.ndarray]) -> Weights:
    network = head["network"]
    count = len(network["encoder"])
    straight = network["straight"] if head["version"] > 2 else [0] * (count + len(network["decoder"]))
    return Weights(
        _chain(network, tensors, "encoder", straight[:count]), _chain(network, tensors, "decoder", straight[count:])
    )


def _chain(network: Mapping[str, Any], tensors: Mapping[str, np.ndarray], part: str, straight: list[int]) -> Chain:
    return tuple(
        Layer(tensors[f"{part}.{index}.matrix"], tensors[f"{part}.{index}.offset"], _activation(name), columns)
        for index, (name, columns) in enumerate(zip(network[part], straight, strict=True))
    )


def _activation(name: Any) -> str:
    return LINEAR if name == LINEAR else check_activation(name)


def _check_arrays(schema: BodySchema) -> None:
    """Check that the arrays of a schema fit each other and mean something.

    Raises:
        ValueError: An array has the wrong shape or an impossible value.
    """
    size, outputs, p = schema.layout.size, len(schema.out_index), len(schema.bias)
    parts = len(schema.path.moments)
    shapes: list[tuple[str, np.ndarray, tuple[int, ...]]] = [
        *((f"scaler.{name}", getattr(schema.scaler, name), (size,)) for name in SCALES[:-1]),
        *((f"p of '{condition}'", array, (p,)) for condition, array in schema.biases.items()),
        *(
            (f"error of {method}", array, (size if method == "input" else outputs,))
            for (method, _), array in schema.errors.items()
        ),
        ("linear.moments", schema.path.moments, (parts, *(len(schema.in_index) + 1,) * 2)),
        ("linear.cross", schema.path.cross, (parts, len(schema.in_index) + 1, schema.path.width)),
        ("linear.outputs", schema.path.outputs, (schema.path.width + 1, outputs)),
        *(("shares", share, (outputs,)) for share in schema.shares.values()),
        ("anchor_conditions", schema.anchor_conditions, (len(schema.anchors) if schema.biases else 0,)),
    ]
    if len(schema.anchors):
        shapes.append(("anchors", schema.anchors, (len(schema.anchors), size)))
    if schema.normal is not None:
        shapes += schema.normal.shapes(size, outputs, p)
    if schema.certainty is not None:
        shapes += schema.certainty.shapes(size)
    for before, layer in pairwise(schema.weights.whole):
        shapes.append(("layer", layer.matrix, (len(before.offset), len(layer.offset))))
    for name, array, shape in shapes:
        if array.shape != shape:
            raise ValueError(f"array {name} has shape {array.shape} in place of {shape}")
    for name, index, count in (
        ("scaler.dead", schema.scaler.dead, size),
        ("anchor_conditions", schema.anchor_conditions, len(schema.biases)),
    ):
        if len(index) and not (index.min() >= 0 and index.max() < count):
            raise ValueError(f"array {name} points beyond {count} entries")
    _check_scale(schema)
    for (method, _), array in schema.errors.items():
        if (array < 0.0).any():
            raise ValueError(f"an error of {method} is negative")
    if schema.certainty is not None:
        schema.certainty.check()
    if schema.normal is not None:
        check_normal(schema.normal, schema.scaler.std[schema.out_index], size + p)


def _check_scale(schema: BodySchema) -> None:
    """Check the scale: samples of a signal that vary by its range have a standard deviation of that order.

    Raises:
        ValueError: No training data have such a scale.
    """
    scaler = schema.scaler
    moving = np.ones(schema.layout.size, bool)
    moving[scaler.dead] = False
    for name in schema.layout.names:
        part = schema.layout.slice(name)
        std, widths = scaler.std[part], (scaler.high - scaler.low)[part]
        largest = float(widths[moving[part]].max(initial=0.0)) or 1.0  # 1 unit if the whole signal is dead
        if (std <= 0.0).any() or (widths < 0.0).any():
            raise ValueError(f"array scaler.std of {name} is not positive, or its range is not")
        if std.max() > largest or (std < NARROWEST * widths).any() or std.min() < 0.9 * FLOOR * std.max():
            raise ValueError(
                f"array scaler.std of {name}, {std.min():.3g} to {std.max():.3g}, does not fit a range of {largest:.3g}"
            )
