"""The bridge to ROS 2 against programs of other authors (`make test-ros2`); all of them are absent in `make test`."""

import json
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator

import numpy as np
import pytest
from others import OtherHands
from ros_arm import hal
from ros_listener import Listener, bridge, eventually, ros_network

from hal.config import RobotConfig
from services.client import Client
from services.process.service import Service
from services.ros2 import cdr
from services.ros2.definitions import type_hash
from services.ros2.node import Network
from services.wire import keys
from services.wire.messages import Sample, Status
from services.wire.streams import received_message

pytestmark = pytest.mark.long
COUNT = 1000
JOINTS = ["shoulder", "elbow"]


@pytest.fixture
def robot() -> str:
    return f"moving_arm_{time.time_ns() % 10**6}"


@pytest.fixture
def network() -> Iterator[Network]:
    with ros_network() as network:
        yield network


def port(network: Network) -> int:
    return int(network.router.rpartition(":")[2])


class MovingHal:
    """Publishes random angles and torques at 100 Hz, of which each is lost now and then."""

    def __init__(self, robot: str) -> None:
        self._robot = robot
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self) -> "MovingHal":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()

    def _run(self) -> None:
        about = {
            "signals": {
                "joint_position": {"unit": "rad", "elements": JOINTS, "source": "hal"},
                "joint_effort": {"unit": "N m", "elements": JOINTS, "source": "hal"},
            }
        }
        chance = np.random.default_rng(3)
        with Service(self._robot, "hal", describe=lambda: about) as service:
            publisher = service.publisher(keys.sample(self._robot), Sample)
            status = threading.Thread(target=service.run, args=(self._status, self._stop), daemon=True)
            status.start()
            cycle = 0
            while not self._stop.wait(0.01):
                cycle += 1
                values = {name: chance.normal(size=2) for name in about["signals"]}
                valid = {name: chance.random(2) < 0.9 for name in about["signals"]}
                values = {name: np.where(valid[name], value, np.nan) for name, value in values.items()}
                age = {name: np.zeros(2) for name in values}
                publisher.put(
                    Sample(
                        stamp_ns=time.time_ns(), cycle=cycle, source="can", complete=True, values=values, age=age,
                        valid=valid,
                    )
                )  # fmt: skip
            status.join()

    @staticmethod
    def _status():

        return Status(stamp_ns=time.time_ns(), service="hal", state="running")


def expected(sample: Sample) -> dict[str, object]:
    """The JointState of a sample: joints whose position is measured; a torque that is not measured is None."""
    position, effort = sample.values["joint_position"], sample.values["joint_effort"]
    there = np.isfinite(position)
    torques = [None if np.isnan(one) else float(one) for one in effort[there]]
    return {
        "stamp_ns": sample.stamp_ns,
        "name": [name for name, is_there in zip(JOINTS, there, strict=True) if is_there],
        "position": position[there].tolist(),
        "velocity": [],
        "effort": torques if any(one is not None for one in torques) else [],
    }


def test_a_thousand_messages_are_read_alike(robot: str, network: Network, other_hands: OtherHands):
    with MovingHal(robot), Client(robot) as client:
        samples: dict[int, dict[str, object]] = {}

        def keep(sample: object) -> None:
            message = received_message(sample, Sample)  # type: ignore[arg-type]
            samples[message.stamp_ns] = expected(message)

        subscriber = client.session.declare_subscriber(keys.sample(robot), keep)
        with bridge(robot, network, rate=200.0):
            listening = other_hands.script("listen", port(network), f"/{robot}/joint_states", COUNT)
            text, _ = listening.communicate(timeout=90)
        assert listening.returncode == 0
        subscriber.undeclare()
    first, *lines = text.splitlines()
    assert first == "listening"
    heard = [json.loads(line) for line in lines]
    assert len(heard) == COUNT
    assert all(one == samples[one["stamp_ns"]] for one in heard)
    assert len({len(one["name"]) for one in heard}) == 2, "joints were lost, and were back"


def test_node_topics_types_hashes_and_qos_are_seen_and_go(robot: str, network: Network, other_hands: OtherHands):
    command = [sys.executable, "-m", "services.cli", "ros2", robot, "--ros-router", network.router]
    with MovingHal(robot):
        running = subprocess.Popen(command, stdout=subprocess.DEVNULL)
        try:
            topic = f"/{robot}/joint_states"
            eventually(lambda: topic in other_hands.cli(port(network), "topic", "list", "-t"), 40.0)
            listed = other_hands.cli(port(network), "topic", "list", "-t", timeout=1.0)
            assert f"{topic} [sensor_msgs/msg/JointState]" in listed
            assert "/diagnostics [diagnostic_msgs/msg/DiagnosticArray]" in listed
            info = other_hands.cli(port(network), "topic", "info", "-v", topic, timeout=1.0)
            assert re.search(r"Publisher count: 1\b", info)
            assert "Node name: gemuco" in info
            assert f"Node namespace: /{robot}" in info
            assert f"Type hash: {type_hash('sensor_msgs/msg/JointState')}" in info
            assert "QoS: 1:2:1,10:,:,:,," in info
            served = other_hands.cli(port(network), "service", "list", "-t", timeout=1.0)
            assert f"/{robot}/estimate [diagnostic_msgs/srv/SelfTest]" in served
            assert f"/{robot}/stop [std_srvs/srv/Trigger]" in served
        finally:
            running.send_signal(signal.SIGKILL)
            running.wait()
        time.sleep(3.0)
        assert robot not in other_hands.cli(port(network), "topic", "list", "-t")


def test_hashes_and_bytes_are_those_of_others(other_hands: OtherHands):
    text, _ = other_hands.script("types").communicate(timeout=60)
    others = json.loads(text)
    assert {kind: type_hash(kind) for kind in others["hashes"]} == others["hashes"]
    for one in others["joints"]:
        header = {"stamp": {"sec": one["sec"], "nanosec": one["nanosec"]}, "frame_id": "frame"}
        position, velocity, effort = one["values"]
        message = {
            "header": header, "name": one["names"], "position": position, "velocity": velocity, "effort": effort,
        }  # fmt: skip
        assert cdr.encode("sensor_msgs/msg/JointState", message).hex() == one["bytes"]


def test_what_the_sdk_publishes_moves_the_signals(robot: str, network: Network, other_hands: OtherHands):
    position = {
        "unit": "rad", "elements": ["b", "a"], "source": "ros2", "topic": "/sdk_states", "field": "position",
        "stale_after": 0.3,
    }  # fmt: skip
    config = RobotConfig.model_validate(
        {
            "robot": robot, "signals": {"joint_position": position}, "command": {"signal": "joint_position"},
            "rates": {"hal": 100}, "ros2": {"router": network.router},
        }
    )  # fmt: skip
    publishing = other_hands.script("publish", port(network), "/sdk_states", 12)
    with hal(config), Client(robot) as client:
        seen: list[np.ndarray] = []

        def moves() -> bool:
            sample = client.next_sample()
            if sample is not None and sample.valid["joint_position"].all():
                seen.append(sample.values["joint_position"])
            return len(seen) > 200

        eventually(moves, 60.0)
        places = np.array(seen)
        assert np.allclose(np.hypot(*places.T), 0.3, atol=1e-9), "a is 0.3 sin t, b is 0.3 cos t"
        assert np.ptp(places, axis=0).min() > 0.01
        listed = other_hands.cli(port(network), "topic", "info", "-v", "/sdk_states")
        assert "Subscription count: 1" in listed
        assert "Node name: hal" in listed
        publishing.wait(60)
        eventually(lambda: (now := client.sample()) is not None and not now.valid["joint_position"].any())


def test_a_frozen_bridge_changes_nothing_for_the_robot(robot: str, network: Network):
    command = [sys.executable, "-m", "services.cli", "ros2", robot, "--ros-router", network.router]
    with MovingHal(robot), Client(robot) as client, Listener(network) as ros:
        cycles: list[int] = []
        heard = ros.listen(f"/{robot}/joint_states", "sensor_msgs/msg/JointState")
        client.session.declare_subscriber(
            keys.sample(robot), lambda sample: cycles.append(received_message(sample, Sample).cycle)
        )
        running = subprocess.Popen(command, stdout=subprocess.DEVNULL)
        try:
            eventually(lambda: heard, 40.0)
            running.send_signal(signal.SIGSTOP)
            count = len(cycles)
            eventually(lambda: len(cycles) > count + 300, 60.0)
            running.send_signal(signal.SIGCONT)
            before = len(heard)
            eventually(lambda: len(heard) > before + 20)
            newest = heard[-1][0]["header"]["stamp"]
            assert time.time() - newest["sec"] < 5.0, "what was old when the bridge went on is not published"
        finally:
            running.kill()
            running.wait()
        count = len(cycles)
        eventually(lambda: len(cycles) > count + 100, 60.0)
        assert np.all(np.diff(cycles) == 1), "no sample was lost for another client"
