"""A robot whose drivers are ROS 2 nodes: its signals, its commands behind the HAL's safety, and bad messages."""

import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from ros_arm import COMMANDS, JOINTS, Driver, config_of, description, hal
from ros_listener import eventually, free_port, ros_network
from typer.testing import CliRunner

from hal.clock import ManualClock
from hal.config import RobotConfig, load_robot
from hal.errors import CommandRefused, ConfigError
from services.cli import app
from services.client import Client
from services.process.router import routing
from services.ros2 import messages
from services.ros2.hardware import check_topics
from services.ros2.incoming import Topic
from services.ros2.node import Network, Node
from services.ros2.settings import SignalTopic, topics_of
from services.ros2.vision import run_ros_vision
from services.wire.messages import Sample

JOINT_STATE = messages.JOINT_STATE


@pytest.fixture
def network() -> Iterator[Network]:
    with ros_network() as network:
        yield network


def valid(client: Client) -> bool:
    sample = client.sample()
    return sample is not None and all(part.all() for part in sample.valid.values())


def mode(client: Client) -> str:
    applied = client.applied()
    return "" if applied is None else applied.mode


def enable(client: Client) -> None:
    """Enable as soon as the HAL has seen the subscriber of the commands."""

    def enabled() -> bool:
        try:
            client.enable()
        except CommandRefused as error:
            assert "has no subscriber" in str(error) or "No valid joint_position" in str(error)
            return False
        return True

    eventually(enabled)
    eventually(lambda: mode(client) == "hold")


def command(client: Client, values: np.ndarray) -> None:
    sample = client.next_sample()
    if sample is not None:
        client.command("joint_position", values, sample)


@pytest.mark.slow
def test_topics_are_signals_and_commands_move_the_driver_behind_the_limits(robot: str, network: Network):
    with Driver(network) as driver, hal(config_of(robot, network)), Client(robot) as client:
        samples: list[Sample] = []
        eventually(lambda: valid(client) and samples.append(client.sample()) is None and samples[-1] is not None)
        sample = samples[-1]
        assert sample.source == "ros2"
        assert sample.values["joint_position"].tolist() == [0.1, -0.2]
        assert sample.values["wrist_force"].tolist() == [7.0]
        assert sample.values["skin"].tolist() == [1.0, 2.0, 3.0]
        assert driver.commands == 0, "nothing is published before a client enables the robot"

        with client.lease():
            enable(client)
            begun, start = time.monotonic(), driver.position.copy()
            goal = np.array([0.5, 3.0])
            while abs(driver.position[0] - 0.5) > 0.01:
                command(client, goal)
                assert time.monotonic() - begun < 60.0, mode(client)
            slowest = abs(driver.position[0] - start[0]) / (time.monotonic() - begun)
            assert slowest <= 0.5 * 1.05, "the rate of the robot file is kept"
            while abs(driver.position[1] - 1.0) > 0.01:
                command(client, goal)
                assert time.monotonic() - begun < 60.0, mode(client)
            assert driver.position[1] <= 1.0 + 1e-9, "the range of the robot file is kept"
        eventually(lambda: mode(client) == "off")
        time.sleep(0.3)  # the last ones arrive
        count = driver.commands
        time.sleep(0.3)
        assert driver.commands == count, "without a command the HAL lets go and publishes nothing"


@pytest.mark.long
def test_a_driver_that_falls_silent_is_a_fault_and_its_values_are_not_fresh(robot: str, network: Network):
    with Driver(network) as driver, hal(config_of(robot, network)), Client(robot) as client:
        eventually(lambda: valid(client))
        with client.lease():
            enable(client)
            driver.change = lambda _: None

            def lost() -> bool:
                sample = client.next_sample()
                if sample is not None and sample.valid["joint_position"].any():
                    client.command("joint_position", np.array([0.1, -0.2]), sample)
                return sample is not None and np.isnan(sample.values["joint_position"]).all()

            eventually(lost)
            eventually(lambda: mode(client) in ("fault", "off"))
        eventually(lambda: (now := client.sample()) is not None and now.valid["skin"].all())  # other topics go on
        eventually(lambda: (now := client.status("hal")) is not None and "silent" in now.text)


def stamped(offset_ns: int) -> Callable[[dict[str, Any]], dict[str, Any]]:
    return lambda state: state | {"header": messages.header(time.time_ns() + offset_ns)}


BAD = {
    "size": (lambda state: state | {"position": [0.3]}, "a JointState has 2 names and 1 values of position"),
    "future": (stamped(5 * 10**9), "s in the future and is not used"),
    "late": (stamped(-5 * 10**9), "s in the past and is not used"),
    "not_finite": (lambda state: state | {"position": [np.nan, np.inf]}, "2 values are not finite"),
}


@pytest.mark.long
@pytest.mark.parametrize("counter", BAD)
def test_bad_messages_are_counted_said_and_not_used(counter: str, robot: str, network: Network):
    change, text = BAD[counter]
    with Driver(network) as driver, hal(config_of(robot, network)), Client(robot) as client:
        eventually(lambda: valid(client))
        driver.change = change

        def counted() -> bool:
            status = client.status("hal", timeout=2.0)
            if status is None:
                return False
            device = status.facts["devices"]["joint_position on /joint_states"]
            return device["counters"].get(counter, 0) > 3 and text in device["text"]

        eventually(counted)
        eventually(lambda: (now := client.sample()) is not None and np.isnan(now.values["joint_position"]).all())
        driver.change = dict
        eventually(lambda: valid(client))


@pytest.mark.slow
def test_another_type_and_a_missing_router_are_said_and_end(robot: str):
    network = Network(f"tcp/127.0.0.1:{free_port()}")

    def text() -> str:
        status = client.status("hal", timeout=2.0)
        return "" if status is None else status.text

    with hal(config_of(robot, network)), Client(robot) as client:
        eventually(lambda: "No router of ROS 2 answers" in text())
        with routing([network.router]):
            eventually(lambda: "Topic '/joint_states' has no publisher in ROS domain 0" in text())
            with Node("/wrong", network) as node:
                node.publisher("/joint_states", "std_msgs/msg/String").put({"data": "x"})
                eventually(lambda: "of node '/wrong' is of type std_msgs/msg/String, not sensor_msgs" in text())
            with Driver(network):
                eventually(lambda: valid(client))


class Wire:
    """Puts messages of a publisher into a topic, over a session, and waits until it is there."""

    def __init__(self, network: Network, topic: Topic) -> None:
        self._topic = topic
        self._arrived = 0
        self._reader = Node("/reader", network)
        self._writers = [Node(f"/writer{number}", network) for number in range(2)]

    def __enter__(self) -> "Wire":
        for node in (self._reader, *self._writers):
            node.__enter__()
        self._reader.subscribe(self._topic.name, self._topic.kind, self._take)
        self._publishers = [node.publisher(self._topic.name, self._topic.kind) for node in self._writers]
        return self

    def __exit__(self, *_: object) -> None:
        for node in (self._reader, *self._writers):
            node.__exit__()

    def _take(self, sample: Any) -> None:
        self._topic.put(sample)
        self._arrived += 1

    def send(self, message: dict[str, Any], writer: int = 0) -> None:
        before = self._arrived

        def arrived() -> bool:
            self._publishers[writer].put(message)
            return self._arrived > before

        eventually(arrived)
        count = -1
        while count != self._arrived:
            count = self._arrived
            time.sleep(0.05)
        self._topic.update()


def state(stamp_ns: int, **joints: float) -> dict[str, Any]:
    message = messages.joint_state(stamp_ns, {name: {"position": value} for name, value in joints.items()})
    assert message is not None
    return message


@pytest.mark.long
def test_joints_of_two_publishers_are_joined_and_none_is_taken_twice(network: Network):
    clock = ManualClock()
    signal = SignalTopic("q", "/joint_states", JOINT_STATE, "position", ("a", "b"))
    topic = Topic("/joint_states", JOINT_STATE, [signal], clock)
    target = topic.targets["q"]
    with Wire(network, topic) as wire:
        now = clock.now_ns() + 10**8
        wire.send(state(now, a=1.0, other=5.0))
        wire.send(state(now, b=2.0), writer=1)
        assert target.values.tolist() == [1.0, 2.0]
        wire.send(state(now + 10, a=9.0, b=3.0), writer=1)
        assert target.values.tolist() == [1.0, 3.0]
        assert topic.counters["doubled"] > 0
        assert "two publishers" in topic.news()
        first = target.received[0]
        wire.send(state(now, a=7.0))
        assert topic.counters["repeated"] > 0
        assert (target.values[0], target.received[0]) == (1.0, first), "what is not newer changes nothing"


@pytest.mark.parametrize(
    ("signal", "text"),
    [
        ({"field": "speed"}, r"signals.joint_position.field 'speed' is not known. Known: position"),
        ({"field": "effort"}, "ROS 2 has effort in N m or N, not in rad"),
        ({"field": "point", "unit": "m"}, "has the elements x, y, z, not shoulder, elbow"),
        ({"topic": ""}, "full name of its `topic`"),
        ({"source": "hal"}, "and only that, has the full name"),
    ],
)
def test_a_wrong_topic_in_a_robot_file_is_one_sentence(signal: dict[str, Any], text: str):
    position = {"unit": "rad", "elements": JOINTS, "source": "ros2", "topic": "/joint_states", "field": "position"}
    body = {"robot": "arm", "signals": {"joint_position": position | signal}, "command": {"signal": "joint_position"}}
    with pytest.raises(ValueError, match=text) if "full name" in text else pytest.raises(ConfigError, match=text):
        topics_of(RobotConfig.model_validate(body))


def test_only_positions_are_commanded(robot: str):
    network = Network()
    signals = config_of(robot, network).model_dump()["signals"]
    with pytest.raises(ConfigError, match="commanded in positions only"):
        topics_of(config_of(robot, network, signals=signals, limits={},
                            command={"signal": "joint_velocity", "topic": COMMANDS}))  # fmt: skip


@pytest.mark.slow
def test_topics_beside_a_bus_come_from_a_process_of_their_own(robot: str, network: Network):
    signals = description(robot, network)["signals"]
    signals = {"angle": {"unit": "rad", "elements": ["knee"]}, "skin": signals["skin"]}
    config = config_of(
        robot, network, signals=signals, limits={}, command={"signal": "angle"},
        buses={"can0": {"interface": "virtual", "channel": robot}},
    )  # fmt: skip
    assert config.measured == ("angle",)
    assert config.seen == ("skin",)
    stop = threading.Event()
    thread = threading.Thread(target=run_ros_vision, args=(config, (), stop), daemon=True)
    thread.start()
    with Client(robot) as client:

        def text() -> str:
            status = client.status("vision", timeout=2.0)
            return "" if status is None else status.text

        eventually(lambda: "Topic '/skin' has no publisher" in text())
        with Driver(network):
            eventually(lambda: (now := client.vision()) is not None and now.values["skin"].tolist() == [1.0, 2.0, 3.0])
            eventually(lambda: text() == "")
        eventually(lambda: client.vision() is None)
        eventually(lambda: "Topic '/skin' has no publisher" in text())
    stop.set()
    thread.join(20.0)
    assert not thread.is_alive()


@pytest.mark.slow
def test_a_drafted_robot_file_runs(robot: str, network: Network, tmp_path: Path):
    urdf = """<robot name="arm"><link name="a"/><link name="b"/>
    <joint name="shoulder" type="revolute"><parent link="a"/><child link="b"/><axis xyz="0 0 1"/>
    <limit lower="-0.7" upper="0.9" velocity="1.5" effort="1"/></joint></robot>"""
    file = tmp_path / f"{robot}.yaml"
    options = ["init", "--ros2", "--ros-router", network.router, "--out", str(file), "--ros-distro", "jazzy"]
    with Driver(network), Node("/describer", network) as node:
        node.publisher("/robot_description", "std_msgs/msg/String", is_latched=True).put({"data": urdf})
        eventually(lambda: len(node.graph.publishers("/skin")) == 1)
        result = CliRunner().invoke(app, options)
        assert result.exit_code == 0, result.output
        assert "Commands go to /arm_controller/joint_trajectory, which node /arm_driver reads" in result.output
        assert "No limits are known of elbow" in result.output
        config = load_robot(file)
        assert (tmp_path / f"{robot}.urdf").read_text() == urdf
        limit = config.limits["joint_position"]
        assert (limit.low, limit.high, limit.rate) == ((-0.3, -0.7), (-0.1, 0.9), 0.2)
        assert config.signals["joint_position"].elements == ("elbow", "shoulder")
        assert {name: signal.field for name, signal in config.signals.items()} == {
            "joint_position": "position", "joint_velocity": "velocity", "skin": "data",
            "wrist_force": "force", "wrist_torque": "torque",
        }  # fmt: skip
        with hal(config), Client(robot) as client:
            eventually(
                lambda: (now := client.sample()) is not None and now.values["joint_position"].tolist() == [-0.2, 0.1]
            )
    assert CliRunner().invoke(app, options).exit_code == 1, "an existing file is not replaced"


def test_init_takes_a_urdf_or_ros2():
    result = CliRunner().invoke(app, ["init"])
    assert result.exit_code == 1
    assert result.stderr.endswith("a folder with EDS, DCF and DBC files, --scan can0, or --ros2.\n")
    result = CliRunner().invoke(app, ["init", "arm.urdf", "--ros2"])
    assert result.exit_code == 1
    assert result.stderr == ("gemuco: --ros2 reads the topics of a network; give neither a file nor --scan with it.\n")


def test_a_robot_without_a_bus_has_nothing_to_scan(tmp_path: Path):
    file = tmp_path / "ros_arm.yaml"
    file.write_text(yaml.safe_dump(description("ros_arm", Network())))
    result = CliRunner().invoke(app, ["scan", str(file)])
    assert result.exit_code == 1
    assert result.stderr.startswith("gemuco: Robot 'ros_arm' has no bus.")


@pytest.mark.slow
def test_the_doctor_checks_topics(robot: str, network: Network):
    config = config_of(robot, network)

    def findings() -> dict[str, tuple[str, str]]:
        return {one.what: (one.verdict.value, one.text) for one in check_topics(config)}

    names = ["router of ROS 2", "topic /joint_states", "topic /wrist", "topic /skin", f"topic {COMMANDS}"]
    with Driver(network):
        eventually(lambda: {verdict for verdict, _ in findings().values()} == {"ok"})
        assert list(findings()) == names
    with Node("/other", network) as node:
        node.publisher("/skin", "std_msgs/msg/String")
        assert findings()["topic /skin"] == (
            "bad", "Topic '/skin' of node '/other' is of type std_msgs/msg/String, not std_msgs/msg/Float64MultiArray.",
        )  # fmt: skip
        assert findings()[f"topic {COMMANDS}"][1].startswith(f"Topic '{COMMANDS}' has no subscriber")
    nowhere = config_of(robot, Network(f"tcp/127.0.0.1:{free_port()}"))
    ((what, finding),) = {one.what: one for one in check_topics(nowhere)}.items()
    assert (what, finding.verdict.value) == ("router of ROS 2", "bad")
