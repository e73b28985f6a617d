"""Compilation of all code before the first tick of a loop.

    python -m gemuco.warm [--without-p]

On a new machine this takes a minute. The compiled code is saved (`gemuco.compiled.jit`) and later loaded within two
seconds. To compile everything, all functions that a service uses are called once with a small body.
"""

import argparse
import time
from collections.abc import Callable, Iterator, Mapping
from itertools import chain, pairwise

import numpy as np

from gemuco.adaption.config import UpdateConfig
from gemuco.adaption.gradient import mean_error
from gemuco.adaption.update import Updater
from gemuco.anomaly.healthy import learn_normal
from gemuco.anomaly.score import score
from gemuco.compiled.jit import FOLDER, let_compiler_go
from gemuco.compiled.usable import usable
from gemuco.controller import Controller
from gemuco.estimation import estimate
from gemuco.intervals.calibration import calibrate
from gemuco.layers import Layer, Weights
from gemuco.scaler import Scaler
from gemuco.schema import BodySchema
from gemuco.search.descent import DescentConfig
from gemuco.search.losses import Match
from gemuco.search.torque import TorqueBalance
from gemuco.signals import Layout, Signal

SIGNALS = {"position": (1, "rad"), "tension": (2, "N"), "length": (2, "m"), "hidden": (1, "m")}
MASKS = (frozenset({"position", "tension"}), frozenset({"tension", "length", "hidden"}))
OUTPUTS = ("position", "tension", "length")
STEPS = {"running": 8, "p": 1, "learning": 2}


def body(outputs: tuple[str, ...] = OUTPUTS) -> BodySchema:
    """Return an untrained body with every kind of signal."""
    random = np.random.default_rng(0)
    layout = Layout(tuple(Signal(name, size, unit) for name, (size, unit) in SIGNALS.items()))
    sizes = (layout.size + len(SIGNALS) + 2, 4, 3, 4, layout.subset(outputs).size)
    layers = tuple(
        Layer(
            random.normal(size=(wide, narrow)).astype(np.float32),
            np.zeros(narrow, np.float32),
            "tanh" if index % 2 == 0 else "linear",
        )
        for index, (wide, narrow) in enumerate(pairwise(sizes))
    )
    zeros, ones = np.zeros(layout.size), np.ones(layout.size)
    return BodySchema(
        layout=layout,
        x_in=layout.names,
        x_out=outputs,
        masks=MASKS,
        scaler=Scaler(zeros, ones, -ones, ones),
        weights=Weights(layers[:2], layers[2:]),
        anchors=random.normal(size=(4, layout.size)).astype(np.float32),
        anchor_conditions=np.array([0, 0, 1, 1]),
        bias=np.zeros(2, np.float32),
        biases={"one": np.zeros(2, np.float32), "other": np.ones(2, np.float32)},
    )


def running(schema: BodySchema, has_p: bool) -> Iterator[str]:
    """Call all functions that a service uses, of a body with p or without; yield the name of each step before it."""
    schema = sure(schema)
    whole = {name: np.zeros(size) for name, (size, _) in SIGNALS.items()}
    yield "samples"
    received = np.frombuffer(bytes(8), "<f8"), np.frombuffer(bytes(1), bool), np.frombuffer(bytes(8), "<f8")
    usable(*received, np.zeros(1, int), np.zeros(1, int), np.ones(1), np.empty(1))
    yield "estimation by mask"
    estimate(schema, {name: whole[name] for name in ("position", "tension")})
    yield "estimation by descent"
    estimate(schema, {"length": whole["length"]})
    yield "anomaly"
    samples = np.random.default_rng(0).normal(size=(200, schema.layout.size))
    score(schema.with_normal(learn_normal(schema, samples)), whole)
    target = {"position": np.full(1, 0.1)}
    terms = (Match("position"), TorqueBalance(np.sin, 1.0, "position", "tension", "length"))
    yield "control"
    Controller(schema, terms, "tension").solve(target, whole)
    if has_p:
        yield "recognition of p"
        for method in ("ekf", "gauss_newton"):
            follow(schema, whole, UpdateConfig(what="bias", bias_method=method))
    for optimiser in ("adam", "sgd"):
        yield f"update of W and p by {optimiser}"
        follow(schema, whole, UpdateConfig(what="both", optimiser=optimiser, minimum=1, batch=4, repeats=1))
    yield "judging an update"
    mean_error(schema, np.zeros((1, schema.layout.size), np.float32))


def sure(schema: BodySchema) -> BodySchema:
    """Return a schema with a calibrated std of its estimates."""
    random, size = np.random.default_rng(0), schema.layout.size
    rows, p = random.normal(size=(60, size)), np.zeros((60, len(schema.bias)))
    errors = {("mask", mask): rows[:, schema.out_index] for mask in schema.masks}
    expected = {way: np.ones(len(schema.out_index)) for way in errors}
    schema = schema.with_weights(schema.weights, expected)
    return schema.with_certainty(calibrate(schema, (rows, p), rows, errors))


def follow(schema: BodySchema, values: Mapping[str, np.ndarray], config: UpdateConfig) -> None:
    """Update a schema by one sample, twice."""
    updater = Updater(schema, config)
    for _ in range(2):
        updater.add(values)
        updater.step()


def learning(schema: BodySchema) -> Iterator[str]:
    """Call all functions of training and of the paper's experiments; yield the name of each step before it."""
    from gemuco.structure.mask_errors import MaskErrors
    from gemuco.structure.mask_judge import Judge, Thresholds

    yield "the paper's descent"
    search = DescentConfig(iterations=2)
    Controller(schema, [Match("position")], "tension", search=search).solve({"position": np.full(1, 0.1)}, {})
    yield "structure determination"
    schema, rows, size = body(tuple(SIGNALS)), 100, schema.layout.size
    counts, whole = np.ones((rows, size), bool), np.ones((rows, len(SIGNALS)), bool)
    x, p = np.zeros((rows, size), np.float32), np.zeros((rows, len(schema.bias)), np.float32)
    ones = np.ones(size)
    errors = MaskErrors(schema.layout, schema.weights.whole, schema.path, x, counts, whole, p, ones, ones)
    Judge(schema.layout.names, (errors,), Thresholds()).measure(np.eye(len(SIGNALS), dtype=bool))


def warm(report: Callable[[float, str], None] | None = None, is_service: bool = False, has_p: bool = True) -> float:
    """Compile everything.

    Args:
        report: Called with the finished share, 0 to 1, and the name of the next step.
        is_service: Whether to leave out code that a service never uses and to unload the compiler, to save memory.
        has_p: Whether to compile the recognition of p, a quarter of all.

    Returns:
        Duration [s].
    """
    start, schema = time.monotonic(), body()
    count = STEPS["running"] + STEPS["p"] * has_p + STEPS["learning"] * (not is_service)
    for index, step in enumerate(chain(running(schema, has_p), () if is_service else learning(schema))):
        if report is not None:
            report(index / count, step)
    if is_service:
        let_compiler_go()
    return time.monotonic() - start


def main() -> None:
    """Compile everything and show a progress bar; lines if the output is no terminal."""
    from rich.progress import BarColumn, Progress, TextColumn

    parser = argparse.ArgumentParser(prog="python -m gemuco.warm", description="Compile everything.")
    parser.add_argument("--without-p", action="store_true", help="leave out the recognition of p")
    has_p = not parser.parse_args().without_p
    with Progress(TextColumn("compiling"), BarColumn(), TextColumn("{task.description}"), transient=True) as bar:
        task, is_terminal = bar.add_task("", total=1.0), bar.console.is_terminal

        def show(share: float, step: str) -> None:
            bar.update(task, completed=share, description=step)
            if not is_terminal:
                print(f"Compiling, {share:.0%}: {step}", flush=True)

        duration = warm(show, has_p=has_p)
    print(f"Compiled code is ready after {duration:.1f} s, {f'saved in {FOLDER}' if FOLDER else 'not saved'}.")


if __name__ == "__main__":
    main()
