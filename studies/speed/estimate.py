"""What one estimate by mask costs through `BodySchema`: named numpy arrays in, named estimates out.

    python -m studies.speed.estimate [--rounds 15] [--calls 400]

Beside it, in the same rounds, the bare chain of layers (numpy) and what a user would write first: a torch nn.Module in
inference mode, with the arrays joined and the result taken apart by hand. One thread each; the median of a round is the
median of its calls, and the table shows the median of the rounds. Ratios travel between machines, microseconds do not.
"""

import argparse
import time
from collections.abc import Callable, Iterator
from itertools import pairwise

import numpy as np
import torch
from rich.console import Console
from rich.table import Table
from torch import nn

from gemuco.estimation import estimate
from gemuco.layers import Layer, Weights, run
from gemuco.scaler import Scaler
from gemuco.schema import BodySchema
from gemuco.signals import Layout, Signal

BODIES = {
    "musashi_arm": (
        {"joint_position": (5, "rad"), "muscle_tension": (10, "N"), "muscle_length": (10, "m")},
        (("muscle_tension", "muscle_length"), ("joint_position", "muscle_tension")),
        ("joint_position", "muscle_tension", "muscle_length"),
        (200, 30, 15, 30, 200),
        2,
        0,
        "joint_position",
    ),
    "pr2_duster": (
        {"joint_position": (7, "rad"), "tool_tip_position": (3, "m")},
        (("joint_position",),),
        ("tool_tip_position",),
        (300, 300, 300, 300, 300),
        2,
        2,
        "tool_tip_position",
    ),
    "kxr_humanoid": (
        {
            "joint_position": (4, "rad"),
            "center_of_gravity": (2, "m"),
            "tool_tip_position": (3, "m"),
            "tool_tip_pixel": (2, "px"),
        },
        (
            ("joint_position",),
            ("joint_position", "center_of_gravity"),
            ("joint_position", "tool_tip_position"),
            ("joint_position", "tool_tip_pixel"),
            ("joint_position", "center_of_gravity", "tool_tip_position"),
            ("joint_position", "center_of_gravity", "tool_tip_pixel"),
            ("joint_position", "tool_tip_position", "tool_tip_pixel"),
            ("center_of_gravity", "tool_tip_position", "tool_tip_pixel"),
        ),
        ("joint_position", "center_of_gravity", "tool_tip_position", "tool_tip_pixel"),
        (200, 100, 8, 100, 200),
        2,
        2,
        "tool_tip_position",
    ),
}
"""Robot -> signals, masks, x_out, widths, which of the widths is the latent state, length of p, what is hidden."""


def body(name: str) -> tuple[BodySchema, dict[str, np.ndarray]]:
    """A schema of a robot's size with random W, and a sample without the hidden signal."""
    signals, masks, x_out, widths, latent, bias, hidden = BODIES[name]
    random = np.random.default_rng(0)
    layout = Layout(tuple(Signal(signal, size, unit) for signal, (size, unit) in signals.items()))
    masks = tuple(frozenset(mask) for mask in masks)
    x_in = tuple(signal for signal in layout.names if any(signal in mask for mask in masks))
    ends = (len(layout.indices(x_in)) + len(x_in) + bias, *widths, len(layout.indices(x_out)))
    layers = tuple(
        Layer(
            (random.standard_normal((wide, narrow)) / np.sqrt(wide)).astype(np.float32),
            np.zeros(narrow, np.float32),
            "linear" if index in (latent, len(ends) - 2) else "tanh",
        )
        for index, (wide, narrow) in enumerate(pairwise(ends))
    )
    ones = np.ones(layout.size)
    size = len(layout.indices(x_out))
    schema = BodySchema(
        layout,
        x_in,
        x_out,
        masks,
        Scaler(0 * ones, ones, -ones, ones),
        Weights(layers[: latent + 1], layers[latent + 1 :]),
        errors={("mask", mask): random.uniform(0.1, 0.5, size) for mask in masks},
        bias=np.zeros(bias, np.float32),
    )
    values = {s.name: random.standard_normal(s.size) for s in layout.signals if s.name != hidden}
    return schema, values


def module_of(schema: BodySchema) -> nn.Sequential:
    """The same network in torch."""
    parts: list[nn.Module] = []
    for layer in schema.weights.whole:
        linear = nn.Linear(*layer.matrix.shape)
        linear.weight.data = torch.from_numpy(layer.matrix.T.copy())
        linear.bias.data = torch.from_numpy(layer.offset.copy())
        parts += [linear] if layer.activation == "linear" else [linear, nn.Tanh()]
    return nn.Sequential(*parts)


def rivals(schema: BodySchema, values: dict[str, np.ndarray], hidden: str) -> dict[str, Callable[[], object]]:
    """Three ways to the hidden signal."""
    mask = estimate(schema, values)[hidden].mask
    x = schema.network_input(schema.normalise(values), mask)
    chain, module = schema.weights.whole, module_of(schema)
    tail = np.concatenate([[name in mask for name in schema.x_in], schema.bias]).astype(np.float32)
    sizes = {name: schema.layout.signal(name).size for name in schema.x_in}
    out = schema.out_layout.slice(hidden)
    mean, std = schema.scaler.mean[schema.in_index], schema.scaler.std[schema.in_index]

    @torch.inference_mode()
    def by_module() -> np.ndarray:
        joined = [values[name] if name in mask else np.zeros(size) for name, size in sizes.items()]
        given = np.concatenate([((np.concatenate(joined) - mean) / std).astype(np.float32), tail])
        return module(torch.from_numpy(given)).numpy()[out]

    return {
        "gemuco.estimate": lambda: estimate(schema, values)[hidden].value,
        "bare chain": lambda: run(chain, x),
        "torch nn.Module": by_module,
    }


def median(call: Callable[[], object], calls: int) -> float:
    """Median time of one call [us]."""
    times = np.empty(calls)
    for index in range(calls):
        begun = time.perf_counter()
        call()
        times[index] = time.perf_counter() - begun
    return 1e6 * float(np.median(times))


def measure(rounds: int, calls: int) -> Iterator[tuple[str, str, float, float]]:
    """(robot, way, median [us], ratio to the bare chain of the same round)."""
    for name in BODIES:
        schema, values = body(name)
        ways = rivals(schema, values, BODIES[name][-1])
        times = np.array([[median(call, calls) for call in ways.values()] for _ in range(rounds)])
        for index, way in enumerate(ways):
            yield name, way, float(np.median(times[:, index])), float(np.median(times[:, index] / times[:, 1]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=15)
    parser.add_argument("--calls", type=int, default=400)
    options = parser.parse_args()
    torch.set_num_threads(1)
    table = Table("robot", "way", "median [us]", "x bare chain", title="one estimate by mask")
    for robot, way, microseconds, ratio in measure(options.rounds, options.calls):
        table.add_row(robot, way, f"{microseconds:.0f}", f"{ratio:.2f}")
    Console().print(table)


if __name__ == "__main__":
    main()
