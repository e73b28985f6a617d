"""Limits follow what is usual for a healthy body, and not a lie that is not noticed yet."""

import pytest
from test_trust_second import blocks_of
from test_trust_tools import CHANGE, TOOLS, body, model, walk

from gemuco.trust.bench import WAITS
from gemuco.trust.config import BLOCK, TrustConfig
from gemuco.trust.monitor import TrustMonitor

__all__ = ["model"]
ELBOW = 1


def judge(monitor, blocks, begin):
    """Judge blocks; return the mean excess of large steps afterwards, shape (columns,)."""
    for number, block in enumerate(blocks):
        monitor.add(block, (begin + number) * BLOCK)
    return monitor._bench.healthy.tail.copy()


@pytest.mark.parametrize("is_hidden", [False, True])
def test_a_lie_raises_its_own_limit_only_if_it_is_not_hidden_in_time(model, is_hidden):
    """After ten seconds it counts as healthy, and all that was seen of it before it was hidden never does."""
    monitor = TrustMonitor(model, TrustConfig(size=100.0))  # no lie is noticed
    blocks = blocks_of(model, body(walk(CHANGE + 3 * WAITS, 71), TOOLS["short"]))
    before, noticed = judge(monitor, blocks[:CHANGE], 0), CHANGE + WAITS - 1
    column = monitor._bench.place[ELBOW]
    blocks[CHANGE:, :, ELBOW] += 12.0 * monitor._bench.error[column]
    soon = judge(monitor, blocks[CHANGE:noticed], CHANGE)
    assert soon[column] == pytest.approx(before[column], abs=0.02)
    if is_hidden:
        monitor.distrust(ELBOW, noticed * BLOCK)
    late = judge(monitor, blocks[noticed:], noticed)
    assert (late[column] > before[column] + 0.1) != is_hidden
