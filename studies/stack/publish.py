"""What one HAL cycle costs in messages: encode and put sample and applied, and decode them at the other end.

    python -m studies.stack.publish

A subscriber in a process of its own listens meanwhile, as the model service does. Medians over rounds of CPU time.
"""

import argparse
import multiprocessing
import os
import statistics
import time
from collections.abc import Callable
from multiprocessing.synchronize import Event
from pathlib import Path

import numpy as np

from hal.config import RobotConfig, load_robot
from services.client import Client
from services.process.service import Service
from services.wire import keys, messages
from services.wire.messages import Applied, Sample

ROUNDS = 15
TURNS = 2000


def listen(robot: str, stop: Event) -> None:
    """Read the newest sample and applied, until told to stop."""
    with Client(robot) as client:
        client.sample()
        client.applied()
        stop.wait()


def examples(config: RobotConfig) -> tuple[Sample, Applied]:
    """A sample and an applied of this robot's size."""
    random = np.random.default_rng(0)
    values = {name: random.normal(size=signal.size) for name, signal in config.signals.items()}
    valid = {name: np.ones(value.shape, bool) for name, value in values.items()}
    command = values[config.command.signal]
    sample = Sample(
        stamp_ns=time.time_ns(), cycle=1, source="can", complete=True, values=values, age=values, valid=valid
    )
    applied = Applied(
        stamp_ns=time.time_ns(),
        cycle=1,
        mode="follow",
        signal=config.command.signal,
        desired=command,
        values=command,
        limited_by=["rate"],
        sender=1,
    )
    return sample, applied


def cost(act: Callable[[], object]) -> float:
    """CPU time of this thread per call [us], median over rounds."""
    rounds = []
    for _ in range(ROUNDS):
        start = time.thread_time()
        for _ in range(TURNS):
            act()
        rounds.append((time.thread_time() - start) / TURNS * 1e6)
    return statistics.median(rounds)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robot", type=Path, default=Path("robots/musashi_arm.yaml"))
    config = load_robot(parser.parse_args().robot)
    name = f"publish_{os.getpid()}"
    sample, applied = examples(config)
    spawn = multiprocessing.get_context("spawn")
    stop = spawn.Event()
    listener = spawn.Process(target=listen, args=(name, stop))
    with Service(name, "hal") as service:
        samples = service.publisher(keys.sample(name), Sample)
        applieds = service.publisher(keys.applied(name), Applied)
        listener.start()
        while not (samples.has_listener and applieds.has_listener):
            time.sleep(0.05)
        wire = messages.encode(sample)
        print(f"sample of {len(wire)} bytes, applied of {len(messages.encode(applied))} bytes; CPU time per call:")
        print(f"  encode a sample      {cost(lambda: messages.encode(sample)):6.1f} us")
        print(f"  decode a sample      {cost(lambda: messages.decode(wire, Sample)):6.1f} us")
        print(f"  publish a sample     {cost(lambda: samples.put(sample)):6.1f} us")
        print(f"  publish an applied   {cost(lambda: applieds.put(applied)):6.1f} us")
        stop.set()
        listener.join()


if __name__ == "__main__":
    main()
