"""Cost of the running service beside its loops: messages, a remote question, and a tick of the estimation.

python -m studies.speed.service_cost
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import msgpack
import numpy as np
import torch
from torch import nn

from gemuco.schema import BodySchema
from gemuco.warm import warm
from hal.by_signal import Numbers, Truths
from hal.clock import SystemClock
from hal.config import load_robot
from services.model.estimation import Estimation, Freshness
from services.process.realtime import freeze, prepare_process
from services.wire import keys, messages
from services.wire.messages import Estimates, Sample
from services.wire.session import new_boot, open_session
from services.wire.streams import Arrival, Publisher
from studies.speed.bodies import MASKS, body, modules
from studies.speed.table import Row, faster, show
from studies.stack import estimate_latency
from studies.stack.message_sizes import examples
from studies.stack.remote_client import BARE, VERB, measure, robot_and_client

ROBOT = Path("robots/musashi_arm.yaml")
QUESTIONS = 400
SILENT = ("joint_position", 3)


def codec() -> Row:
    """Measure a published sample, and the same content as lists of numbers."""
    sample, _ = examples(load_robot(ROBOT))[keys.sample("*")]
    assert isinstance(sample, Sample)
    parts = ("values", "age", "valid")

    def ours() -> Sample:
        return messages.decode(messages.encode(sample), Sample)

    def lists() -> dict[str, dict[str, np.ndarray]]:
        content: dict[str, object] = {
            part: {name: values.tolist() for name, values in getattr(sample, part).items()} for part in parts
        }
        content |= {"type": "sample", "v": 1, "stamp_ns": sample.stamp_ns, "cycle": 1, "source": "can"}
        decoded = msgpack.unpackb(msgpack.packb(content | {"complete": True}))
        return {part: {name: np.array(values) for name, values in decoded[part].items()} for part in parts}

    return faster(
        "encode and decode a sample of 25 elements: value, age, valid",
        "msgpack with lists",
        ours,
        lists,
        4.0,
        "ours checks every field; lists check nothing",
    )


def question() -> Row:
    """Measure how much longer a remote client waits for an estimate than for a bare query with the same bytes."""
    with robot_and_client(False) as (client, connect):
        times = measure(client, connect, QUESTIONS)
    ours, bare = (1e3 * float(np.median(times[what])) for what in (VERB, BARE))
    return Row(
        "an estimate asked for by a remote client, beyond a bare query", "zenoh query, same bytes", ours, bare, "ms",
        ours - bare, 0.15, is_most=True, note="the difference is compared",
    )  # fmt: skip


def tick() -> Row:
    """Measure one tick of the estimation loop with a silent encoder, and the same with a torch nn.Module."""
    with ticks() as (ours, by_torch):
        return faster(
            "an estimation tick, one encoder silent, published",
            "the same with torch eager",
            ours,
            by_torch,
            0.0,
            "no bar was named",
        )


@contextmanager
def ticks() -> Iterator[tuple[Callable[[], None], Callable[[], None]]]:
    """Yield the service's tick and torch's; both publish on the same session."""
    prepare_process()
    warm()
    robot, schema, clock = load_robot(ROBOT), body((200, 200)), SystemClock()
    with open_session(f"estimation_tick_{new_boot()}", "model", ()) as session:
        publisher = Publisher(session, "gemuco/estimation_tick/model/estimate", Estimates, new_boot())
        newest = samples(schema, clock)
        ours = Estimation(Freshness(robot, newest, clock), lambda: schema, publisher.put, clock).tick
        by_torch = torch_tick(schema, newest, publisher.put, clock)
        for _ in range(50):
            ours()
            by_torch()
        freeze()
        yield ours, by_torch


def samples(schema: BodySchema, clock: SystemClock) -> Callable[[], Arrival[Sample]]:
    """Return a source of sixteen different samples in turn, in which one encoder is silent."""
    random, number = np.random.default_rng(0), 0
    sizes = {signal.name: signal.size for signal in schema.layout.signals}
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

    def newest() -> Arrival[Sample]:
        nonlocal number
        number += 1
        return Arrival(known[number % len(known)], clock.monotonic())

    return newest


def torch_tick(
    schema: BodySchema, newest: Callable[[], Arrival[Sample]], publish: Callable[[Estimates], None], clock: SystemClock
) -> Callable[[], None]:
    """Return a tick as a user would write it: take the sample, infer, keep the measured values, publish."""
    torch.set_num_threads(1)
    network = nn.Sequential(*modules(schema))
    layout, mean, std = schema.layout, schema.scaler.mean, schema.scaler.std
    gate, _, tail, _ = schema.gate(MASKS[0])
    zeros = np.zeros(layout.size)
    names = layout.names

    @torch.inference_mode()
    def tick() -> None:
        sample = newest().message
        x, valid, elements = sample.values.flat, sample.valid.flat, sample.elements
        given = np.concatenate([np.where(gate > 0, (x - mean) / std, 0.0), tail]).astype(np.float32)
        prediction = network(torch.from_numpy(given)).numpy() * std + mean
        values = np.where(valid, x, prediction)
        publish(
            Estimates(
                stamp_ns=clock.now_ns(), cycle=sample.cycle, elements=elements,
                values=Numbers(values, elements), estimated=Truths(~valid, elements), std=Numbers(zeros, elements),
                method=dict.fromkeys(names, "mask"), mask=dict.fromkeys(names, ""), residual=dict.fromkeys(names, 0.0),
            )
        )  # fmt: skip

    return tick


def rows() -> Iterator[Row]:
    """Measure all of them."""
    yield codec()
    yield question()
    yield estimate_latency.row()
    yield tick()


if __name__ == "__main__":
    show(rows())
