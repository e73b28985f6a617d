"""Cost of the test for lies: its share of a core, by body and by what happens.

    python -m studies.speed.trust_cost [--robots kxr_humanoid pr2_duster musashi_arm kuka pam_arm]

Bodies and motion are those of `studies.accuracy.lies`; a service judges ten blocks per second. `lie`: an element is
wrong by five of its standard deviations. `wrong body`: every sensor of one signal reads 5 % too much, on a body that is
not known to be as the model says. `flapping`: one to eight elements drop out at random in each block, while an element
lies. The bar is 5 % of a core.
"""

import argparse
import time
from collections.abc import Callable

import numpy as np
from rich.console import Console
from rich.table import Table

from gemuco.schema import BodySchema
from gemuco.trust.config import BLOCK
from gemuco.trust.monitor import TrustMonitor
from studies.accuracy.lies import BODIES, body_of, under

SAMPLES = 20
"""Samples of a block, at 200 Hz."""
BLOCKS, BEFORE = 300, 100
"""Blocks of a run, and those before something happens."""
LIE = 5.0
"""Size of the lie [standard deviations of the element]."""
Change = Callable[[np.ndarray, BodySchema, np.random.Generator], None]


def healthy(block: np.ndarray, schema: BodySchema, draw: np.random.Generator) -> None:
    """Leave the samples as they are."""


def lie(block: np.ndarray, schema: BodySchema, draw: np.random.Generator) -> None:
    """Let an element lie in samples [standard deviations], shape (n, size)."""
    block[:, 0] += LIE


def wrong_body(block: np.ndarray, schema: BodySchema, draw: np.random.Generator) -> None:
    """Let every sensor of the last signal read too much."""
    span = schema.layout.slice(schema.layout.names[-1])
    block[:, span] *= 1.05
    block[:, span] += 0.05 * schema.scaler.mean[span] / schema.scaler.std[span]


def flapping(block: np.ndarray, schema: BodySchema, draw: np.random.Generator) -> None:
    """Let some elements drop out, and one lie."""
    lie(block, schema, draw)
    count = min(int(draw.integers(1, 9)), block.shape[1] // 2)
    block[:, draw.choice(block.shape[1], count, replace=False)] = np.nan


CASES: dict[str, tuple[Change, bool]] = {
    "healthy": (healthy, True),
    "lie": (lie, True),
    "wrong body": (wrong_body, False),
    "flapping": (flapping, False),
}
"""What happens, and whether the body is known."""


def share(schema: BodySchema, motion: np.ndarray, change: Change, is_known: bool) -> tuple[float, float]:
    """Return the share of a core that the test takes after the change, and the longest time of one block [s]."""
    monitor, draw, times = TrustMonitor(schema), np.random.default_rng(0), []
    monitor.is_known = is_known
    whole = len(motion) // SAMPLES
    for number in range(BLOCKS):
        turn, place = divmod(number, whole)  # motion that ends goes on backwards, without a jump
        first = (place if turn % 2 == 0 else whole - 1 - place) * SAMPLES
        block = motion[first : first + SAMPLES][:: 1 if turn % 2 == 0 else -1].copy()
        if number >= BEFORE:
            change(block, schema, draw)
        begin = time.thread_time()
        monitor.add(block, number * BLOCK)
        times.append(time.thread_time() - begin)
    return float(np.mean(times[BEFORE:])) / BLOCK, max(times)


def row_of(name: str) -> tuple[str, ...]:
    """Return the row of one body."""
    body = body_of(name)
    condition, motion = next(iter(body.motion.items()))
    cells = []
    for change, is_known in CASES.values():
        mean, longest = share(under(body.schema, condition), motion, change, is_known)
        cells.append(f"{mean:.1%}, {1e3 * longest:.0f} ms")
    return (name, *cells)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    names = [name for name in BODIES if name != "car"]
    parser.add_argument("--robots", nargs="+", default=names, choices=list(BODIES))
    result = Table("robot", *(f"{case}: share, longest block" for case in CASES))
    for robot in parser.parse_args().robots:
        result.add_row(*row_of(robot))
    Console(width=160).print(result)
