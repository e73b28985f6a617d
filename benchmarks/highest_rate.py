"""The highest rate at which estimates are published in time, by ours and by torch eager.

    python -m benchmarks.highest_rate [--seconds 0.2]

One loop of the service as it is (absolute grid, real-time scheduling where allowed) publishes estimates of an arm of
which one encoder is silent, from a sample that is another one at every tick. The peer's tick does the same with a torch
nn.Module: take the sample, infer, put what was measured over it, encode, publish. A rate is held if at most 0.1 % of
its ticks are skipped beyond those of a loop that does nothing at that rate, before it, in one of eight tries: a machine
that stands still for a moment says nothing of either. Rates go up by a quarter until two in a row are not held. A
thread that slept wakes 40 to 50 us late on the machines we know, which bounds both ways, and ours first: so what one
tick costs stands beside it.
"""

import argparse
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from benchmarks.bodies import MASKS, body, modules
from benchmarks.table import Row, faster
from gemuco.schema import BodySchema
from gemuco.warm import warm
from hal.by_signal import Numbers, Truths
from hal.clock import SystemClock
from hal.config import load_robot
from services.model.estimation import Estimation, Fresh, Freshness
from services.process.loop import Loop
from services.process.realtime import freeze, prepare_process
from services.wire.messages import Estimates, Sample
from services.wire.session import new_boot, open_session
from services.wire.streams import Publisher

ROBOT = Path("robots/musashi_arm.yaml")
SILENT = ("joint_position", 3)
RATES = [round(1000.0 * 1.25**step) for step in range(19)]
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
    import torch
    from torch import nn

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


def highest(tick: Callable[[], None], seconds: float) -> float:
    """The highest rate [Hz] that a tick holds; 0 if none."""
    best, misses = 0.0, 0
    for rate in RATES:
        if any(skipped(rate, lambda: None, seconds) + MISSED >= skipped(rate, tick, seconds) for _ in range(TRIES)):
            best, misses = rate, 0
        else:
            misses += 1
            if misses == 2:
                break
    return best


def rows(seconds: float = SECONDS) -> Iterator[Row]:
    """What one tick costs each way, and at which rate it can be done in time."""
    with ticks() as both:
        yield faster(
            "an estimation tick, one encoder silent, published", "the same with torch eager", both["ours"],
            both["torch"], 0.0, "no bar was named",
        )  # fmt: skip
        found = np.array([[highest(tick, seconds) for tick in both.values()] for _ in range(ROUNDS)])
    ours, theirs = np.median(found, axis=0)
    ratios = found[:, 0] / np.maximum(found[:, 1], RATES[0])
    told = ", ".join(f"{ratio:.1f}" for ratio in ratios)
    yield Row(
        "highest rate of estimation with 0.1 % missed", "the same with torch eager", float(ours), float(theirs), "Hz",
        float(np.median(ratios)), 4.0, note=f"rates tried are a quarter apart; {ROUNDS} rounds: {told} times",
    )  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=SECONDS, help="of a try")
    for row in rows(parser.parse_args().seconds):
        print(f"{row.what:60s} {row.ours:9.2f} {row.theirs:9.2f} {row.unit}  {row.value:6.2f} x  {row.note}")


if __name__ == "__main__":
    main()
