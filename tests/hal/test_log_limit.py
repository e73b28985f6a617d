"""A storm of reports is counted, and not written down line by line."""

import logging
import time

import pytest
from hal_bench import Bench

from hal.clock import SystemClock
from hal.config import BusConfig
from hal.log_limit import LogLimit
from hal.protocols.error_frames import error_frame
from hal.wire.bus import Bus
from simulators.wire_faults import CONTROLLER, PASSIVE


def test_one_line_of_a_kind_per_second_and_the_number_of_the_others(caplog):
    limit = LogLimit(logging.getLogger("hal.test"))
    for millisecond in range(3001):
        limit.line(logging.WARNING, "a", 10.0 + 1e-3 * millisecond, f"report {millisecond}")
    limit.line(logging.WARNING, "b", 10.5, "another kind")
    lines = [record.getMessage() for record in caplog.records]
    assert lines[0] == "report 0"
    assert lines[1] == "report 1000 (999 more such lines in the last 1.0 s)"
    assert lines[-1] == "another kind"
    assert len(lines) in (4, 5)


@pytest.fixture
def bench():
    bench = Bench().open()
    yield bench
    bench.close()


def test_a_storm_of_emergencies_with_changing_codes_leaves_a_line_per_second(bench, caplog):
    bench.cycle(2)
    caplog.clear()
    for burst in range(40):
        for number in range(100):
            code = 0x5000 + (100 * burst + number) % 4096
            bench.send("can1", 0x080 + 21, [*code.to_bytes(2, "little"), 0x81, 0, 0, 0, 0, 0])
        bench.cycle(10)
    lines = [record for record in caplog.records if "elbow_encoder" in record.getMessage()]
    assert bench.device("elbow_encoder")["counters"]["emergencies"] >= 1000
    assert 1 <= len(lines) <= 4
    assert "more such lines" in lines[-1].getMessage()


def test_a_controller_that_changes_its_mind_with_each_frame_leaves_a_line_per_state(bench, caplog):
    bench.cycle(2)
    caplog.clear()
    watch = bench.buses["can0"]._watch

    for count in range(2000):
        watch.error(error_frame(CONTROLLER, bytes([0, PASSIVE if count % 2 else 0x40, *bytes(6)])), 10.0)
    lines = [record for record in caplog.records if "bus can0" in record.getMessage()]
    assert 1 <= len(lines) <= 6


def test_a_bus_that_never_opens_is_said_once(caplog):
    config = BusConfig(interface="hub", channel="nothing_serves_this")
    bus = Bus("can0", config, SystemClock())
    bus.open()
    deadline = time.monotonic() + 30.0
    while bus.counters["failures"] < 3 and time.monotonic() < deadline:
        time.sleep(0.02)
    bus.close()
    assert bus.counters["failures"] >= 3
    lines = [record.getMessage() for record in caplog.records if "bus can0 is gone" in record.getMessage()]
    assert len(lines) == 1
    assert "No server has the hub channel 'nothing_serves_this'" in lines[0]
    assert lines[0].endswith("Trying again.")
