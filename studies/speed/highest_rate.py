"""The highest rate at which estimates are published in time, by ours and by torch eager.

    python -m studies.speed.highest_rate [--seconds 0.2]

One loop of the service as it is (absolute grid, real-time scheduling where allowed) publishes estimates of an arm of
which one encoder is silent, from a sample that is another one at every tick. The peer's tick does the same with a torch
nn.Module: take the sample, infer, put what was measured over it, encode, publish. A rate is held if at most 0.1 % of
its ticks are skipped beyond those of a loop that does nothing at that rate, before it, in one of eight tries: a machine
that stands still for a moment says nothing of either. Rates go up by a quarter until two in a row are not held.

First estimation has the process for itself, and that is all that `make bench` does. A thread that slept wakes 40 to
50 us late on the machines we know, which bounds both ways, and ours first: so what one tick costs stands beside it.
Then the other three loops of the service run in the same process, in the same kind of loop: a control search 100 times
a second (ours the default, the peer's the paper's descent, 20 x 30), an inference 200 times, a step on W 20 times.
"""

import argparse
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import torch
from torch import nn

from gemuco.adaption.config import UpdateConfig
from gemuco.adaption.update import Updater
from gemuco.schema import BodySchema
from gemuco.search.descent import NewtonConfig
from gemuco.warm import warm
from hal.by_signal import Numbers, Truths
from hal.clock import SystemClock
from hal.config import load_robot
from services.model.estimation import Estimation, Fresh, Freshness
from services.model.gemuco_service import OFFSETS, PRIORITIES
from services.process.loop import Loop
from services.process.realtime import freeze, prepare_process
from services.wire.messages import Estimates, Sample
from services.wire.session import new_boot, open_session
from services.wire.streams import Publisher
from studies.speed.bodies import MASKS, body, modules
from studies.speed.solvers import TERMS, Ours, torch_descent, torch_loss
from studies.speed.table import Row, faster
from studies.speed.updates import torch_step

ROBOT = Path("robots/musashi_arm.yaml")
SILENT = ("joint_position", 3)
RATES = [round(500.0 * 1.25**step) for step in range(22)]
BESIDE = {"control": 100.0, "anomaly": 200.0, "update": 20.0}
MISSED, TRIES, SECONDS, ROUNDS = 0.001, 8, 0.2, 3


def skipped(rate: float, tick: Callable[[], None], seconds: float) -> float:
    """Share of the ticks that were skipped at a rate [Hz]."""
    loop = Loop("estimation", rate, tick, priority=40)
    loop.start()
    time.sleep(seconds)
    counted = loop.statistics()
    loop.stop()
    return counted["skipped"] / max(counted["ticks"] + counted["skipped"], 1)


def samples(schema: BodySchema, clock: SystemClock) -> Callable[[], Fresh]:
    """Another sample every time."""
    random, number = np.random.default_rng(0), 0
    sizes = {one.name: one.size for one in schema.layout.signals}
    valid = {name: np.ones(size, bool) for name, size in sizes.items()}
    valid[SILENT[0]][SILENT[1]] = False
    age = {name: np.zeros(size) for name, size in sizes.items()}
    known = [
        Sample(
            cycle=cycle, source="can", complete=False, age=age, valid=valid,
            values={name: random.standard_normal(size) for name, size in sizes.items()},
        )
        for cycle in range(16)
    ]  # fmt: skip

    def newest() -> Fresh:
        nonlocal number
        number += 1
        return Fresh(known[number % len(known)], clock.monotonic())

    return newest


def torch_tick(
    schema: BodySchema, newest: Callable[[], Fresh], publish: Callable[[Estimates], None], clock: SystemClock
) -> Callable[[], None]:
    """What a user would write."""
    torch.set_num_threads(1)
    network = nn.Sequential(*modules(schema))
    layout, mean, std = schema.layout, schema.scaler.mean, schema.scaler.std
    gate, tail = schema.gate(MASKS[0])
    nothing = np.zeros(layout.size)
    names = layout.names

    @torch.inference_mode()
    def tick() -> None:
        sample = newest().sample
        x, there, elements = sample.values.flat, sample.valid.flat, sample.elements
        given = np.concatenate([np.where(gate > 0, (x - mean) / std, 0.0), tail]).astype(np.float32)
        told = network(torch.from_numpy(given)).numpy() * std + mean
        values = np.where(there, x, told)
        publish(
            Estimates(
                stamp_ns=clock.now_ns(), cycle=sample.cycle, elements=elements,
                values=Numbers(values, elements), estimated=Truths(~there, elements), std=Numbers(nothing, elements),
                method=dict.fromkeys(names, "mask"), mask=dict.fromkeys(names, ""), residual=dict.fromkeys(names, 0.0),
            )
        )  # fmt: skip

    return tick


@contextmanager
def ticks() -> Iterator[dict[str, Callable[[], None]]]:
    """One tick of both ways, published on a session of its own."""
    prepare_process()
    warm()
    robot, schema, clock = load_robot(ROBOT), body((200, 200)), SystemClock()
    with open_session(f"highest_rate_{new_boot()}", "model", ()) as session:
        publisher = Publisher(session, "gemuco/highest_rate/model/estimate", Estimates, new_boot())
        newest = samples(schema, clock)
        ours = Estimation(Freshness(robot, newest, clock), lambda: schema, publisher.put, clock).tick
        both = {"ours": ours, "torch": torch_tick(schema, newest, publisher.put, clock)}
        for tick in both.values():
            for _ in range(50):
                tick()
        freeze()
        yield both


def highest(tick: Callable[[], None], seconds: float, others: dict[str, Callable[[], object]]) -> tuple[float, float]:
    """The highest rate [Hz] that a tick holds beside others, 0 if none; and the share of control's ticks skipped."""
    best, misses, control = 0.0, 0, np.zeros(2)

    def is_held(rate: float) -> bool:
        bare = skipped(rate, lambda: None, seconds)
        with running(others) as loops:
            found = skipped(rate, tick, seconds)
        for loop in loops:
            if loop.name == "control":
                counted = loop.statistics()
                control[:] += counted["skipped"], counted["ticks"] + counted["skipped"]
        return found <= bare + MISSED

    for rate in RATES:
        if any(is_held(rate) for _ in range(TRIES)):
            best, misses = rate, 0
        else:
            misses += 1
            if misses == 2:
                break
    return best, float(control[0] / max(control[1], 1.0))


def beside(schema: BodySchema) -> dict[str, dict[str, Callable[[], object]]]:
    """One tick of each of the other loops, both ways."""
    torch.set_num_threads(1)
    network = nn.Sequential(*modules(schema)).requires_grad_(False)
    given, mask = np.zeros(schema.layout.size), MASKS[0]
    row = torch.from_numpy(schema.network_input(given, mask)[None])
    search, loss = Ours(schema, "f", TERMS), torch_loss(schema, "f", False)
    lived = np.random.default_rng(3).standard_normal((200, schema.layout.size))
    updater = Updater(schema, UpdateConfig(what="weights", steps=1, batch=50, replay=0, held_out=0, minimum=1))
    for line in lived:
        updater.add(schema.layout.split(line))
    return {
        "ours": {
            "control": lambda: search.solve(NewtonConfig()),
            "anomaly": lambda: schema.infer(given, mask),
            "update": lambda: updater._relearner.step(schema, True, False),
        },
        "torch": {
            "control": lambda: torch_descent(loss, search.start, False),
            "anomaly": lambda: network(row).numpy(),
            "update": torch_step(schema, lived, np.random.default_rng(3)),
        },
    }


@contextmanager
def running(ticks: dict[str, Callable[[], object]]) -> Iterator[list[Loop]]:
    """Loops beside the one that is measured."""
    loops = []
    for name, tick in ticks.items():
        tick()
        loops.append(Loop(name, BESIDE[name], tick, priority=PRIORITIES[name], offset=OFFSETS[name]))
    for loop in loops:
        loop.start()
    try:
        yield loops
    finally:
        for loop in loops:
            loop.stop()


def rows(seconds: float = SECONDS, is_whole: bool = False) -> Iterator[Row]:
    """What one tick costs each way, and at which rate it can be done in time; and if asked, beside the other loops."""
    with ticks() as both:
        yield faster(
            "an estimation tick, one encoder silent, published", "the same with torch eager", both["ours"],
            both["torch"], 0.0, "no bar was named",
        )  # fmt: skip
        nothing: dict[str, dict[str, Callable[[], object]]] = {"ours": {}, "torch": {}}
        yield _highest("highest rate of estimation with 0.1 % missed", both, nothing, seconds)
        if is_whole:
            others = beside(body((200, 200), anchors=300))
            yield _highest("the same beside three other loops", both, others, seconds)


def _highest(
    what: str,
    both: dict[str, Callable[[], None]],
    others: dict[str, dict[str, Callable[[], object]]],
    seconds: float,
) -> Row:
    measured = [[highest(tick, seconds, others[way]) for way, tick in both.items()] for _ in range(ROUNDS)]
    found, control = np.moveaxis(np.array(measured), 2, 0)  # (rounds, ways)
    ours, theirs = np.median(found, axis=0).tolist()
    ratios = found[:, 0] / np.maximum(found[:, 1], RATES[0])
    told = ", ".join(f"{one:.1f}" for one in ratios)
    note = f"rates tried are a quarter apart; {ROUNDS} rounds: {told} times"
    if others["ours"]:
        note += "; of control's ticks ours missed {:.1%}, torch {:.1%}".format(*control.mean(axis=0))
    return Row(what, "the same with torch eager", ours, theirs, "Hz", float(np.median(ratios)), 4.0, note=note)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=SECONDS, help="of a try")
    for row in rows(parser.parse_args().seconds, is_whole=True):
        print(f"{row.what:60s} {row.ours:9.2f} {row.theirs:9.2f} {row.unit}  {row.value:6.2f} x  {row.note}")


if __name__ == "__main__":
    main()
