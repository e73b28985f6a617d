"""The same robot file on the vcan of a real Linux kernel: processes, frames, and a stranger who decodes them.

`make test-socketcan` runs this in a kernel that has vcan0 and vcan1; elsewhere it is skipped.
"""

import ctypes
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import canopen
import numpy as np
import pytest
import yaml

from hal.config import load_robot
from services.client import Client

ROOT = Path(__file__).parents[2]
ROBOT = "arm_on_vcan"
CYCLES = 10.0
"""Cycles per second [Hz]: what a kernel in user mode carries without loss. Every time limit follows from it, for such a
kernel also stands still for a tenth of a second now and then."""

pytestmark = [
    pytest.mark.skipif(
        not all(Path("/sys/class/net", name).exists() for name in ("vcan0", "vcan1")),
        reason="no vcan0 and vcan1 on this machine; `make test-socketcan` boots a kernel that has them",
    ),
    pytest.mark.timeout(240),
]


@pytest.fixture(scope="module")
def robot_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    raw = yaml.safe_load((ROOT / "robots" / "musashi_arm.yaml").read_text())
    raw["robot"] = ROBOT
    raw["simulator"] = "simulators.robots.bench:simulator"  # physics would take the one CPU from the HAL
    raw["rates"]["hal"] = CYCLES
    for signal in raw["signals"].values():
        signal["stale_after"] = 4 / CYCLES
    raw["command"]["time_to_live"] = 0.5
    for kind in raw["kinds"].values():
        kind["settings"]["silent_after"] = 2.0
        kind["settings"]["eds"] = str(ROOT / "robots" / kind["settings"]["eds"])
    raw["kinds"]["muscle_drive"]["settings"]["watch_time"] = 2.0
    for channel, bus in zip(("vcan0", "vcan1"), raw["buses"].values(), strict=True):
        bus.update(interface="socketcan", channel=channel)
    path = tmp_path_factory.mktemp("robot") / f"{ROBOT}.yaml"
    path.write_text(yaml.safe_dump(raw))
    return path


def _without_real_time() -> None:
    """Drop CAP_SYS_NICE: on one CPU a HAL with real-time scheduling starves what stands in for the hardware."""
    drop_from_bounding_set, sys_nice = 24, 23  # linux/prctl.h, linux/capability.h
    ctypes.CDLL(None).prctl(drop_from_bounding_set, sys_nice, 0, 0, 0)


@pytest.fixture(scope="module")
def client(robot_file: Path) -> Iterator[Client]:
    commands = (("simulate", str(robot_file)), ("hal", str(robot_file)))
    processes = [
        subprocess.Popen([sys.executable, "-m", "services.cli", *command], preexec_fn=_without_real_time)
        for command in commands
    ]
    try:
        with Client(ROBOT) as opened:
            yield opened
    finally:
        for process in processes:
            process.terminate()
        for process in processes:
            process.wait(20)


def _sample(client: Client, complete: bool = True, within: float = 90.0):  # type: ignore[no-untyped-def]
    deadline = time.monotonic() + within
    while time.monotonic() < deadline:
        sample = client.sample()
        if sample is not None and all(np.all(valid) for valid in sample.valid.values()) >= complete:
            return sample
        time.sleep(0.05)
    raise AssertionError(f"no sample with every element valid within {within:g} s; last: {client.sample()}")


def test_every_signal_is_measured_over_the_kernel(client: Client) -> None:
    sample = _sample(client)
    assert sample.source == "can"
    assert {name: values.size for name, values in sample.values.items()} == {
        "joint_position": 5,
        "muscle_tension": 10,
        "muscle_length": 10,
    }


def test_a_stranger_decodes_the_wire_with_canopen_and_the_eds(client: Client) -> None:
    sample = _sample(client)
    network = canopen.Network()
    network.connect(interface="socketcan", channel="vcan0")
    try:
        encoder = network.add_node(22, str(ROOT / "robots" / "eds" / "joint_encoder.eds"))
        encoder.sdo.RESPONSE_TIMEOUT = 5.0
        encoder.tpdo.read()
        assert encoder.tpdo[1].wait_for_reception(10.0) is not None
        turn = encoder.sdo[0x6001].raw
        settings = load_robot(ROOT / "robots" / "musashi_arm.yaml").settings_of("shoulder_pitch_encoder")
        angle = settings["zero"] + settings["direction"] * encoder.tpdo[1][0x6004].raw / turn * 2 * np.pi
        assert angle == pytest.approx(sample.values["joint_position"][1], abs=0.02)  # rad
        drive = network.add_node(1, str(ROOT / "robots" / "eds" / "servo_drive.eds"))
        drive.sdo.RESPONSE_TIMEOUT = 5.0
        drive.tpdo.read()
        assert drive.tpdo[1].wait_for_reception(10.0) is not None
        assert isinstance(drive.tpdo[1][0x6064].raw, int)
    finally:
        network.disconnect()


def test_the_arm_follows_and_stops(client: Client) -> None:
    _sample(client)
    client.enable()
    deadline = time.monotonic() + 90
    while time.monotonic() < deadline:
        applied = client.applied()
        if applied is not None and applied.mode == "hold":
            break
        time.sleep(0.05)
    else:
        raise AssertionError("not enabled within 90 s")
    client.stop()
