"""A robot in ROS 2: what is measured, what is estimated, what is gone, and what others see of it."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import zenoh
from ros_listener import Listener, bridge, eventually, free_port, ros_network
from talking_robot import TalkingRobot

from services.process.router import routing
from services.ros2 import cdr, draft, names
from services.ros2.bridge import run_bridge
from services.ros2.names import Kind, read_token
from services.ros2.node import NameTaken, Network, Node
from services.watch.frames import Frames

JOINT_STATE = "sensor_msgs/msg/JointState"
DIAGNOSTICS = "diagnostic_msgs/msg/DiagnosticArray"
WRENCH = "geometry_msgs/msg/WrenchStamped"
URDF = """<robot name="arm"><link name="base"/><link name="upper"/><link name="lower"/>
<joint name="shoulder" type="revolute"><parent link="base"/><child link="upper"/><axis xyz="0 0 1"/></joint>
<joint name="elbow" type="revolute"><parent link="upper"/><child link="lower"/><axis xyz="0 0 1"/></joint></robot>"""


@pytest.fixture
def network() -> Iterator[Network]:
    with ros_network() as network:
        yield network


@pytest.fixture
def frames(tmp_path: Path) -> Frames:
    (tmp_path / "arm.urdf").write_text(URDF)
    return Frames(tmp_path / "arm.urdf")


def test_a_urdf_with_extensions_of_other_programs_is_read(tmp_path: Path) -> None:
    limit = "<limit drake:acceleration='2' lower='-1' upper='1' velocity='3'/><drake:gear ratio='9'/>"
    text = URDF.replace("<axis", f"{limit}<axis")
    (tmp_path / "arm.urdf").write_text(text)
    frames = Frames(tmp_path / "arm.urdf")
    assert [joint.name for joint in frames.joints] == ["shoulder", "elbow"]
    assert frames.text == text
    assert {name: limit.rate for name, limit in draft._limits(text).items()} == {"shoulder": 3.0, "elbow": 3.0}


def statuses(message: dict[str, Any]) -> dict[str, tuple[int, str]]:
    return {one["name"].partition(": ")[2]: (one["level"], one["message"]) for one in message["status"]}


@pytest.mark.slow
def test_a_lost_joint_is_absent_where_it_is_not_measured(robot: str, network: Network, frames: Frames):
    with Listener(network) as ros, TalkingRobot(robot) as talking:
        measured = ros.listen(f"/{robot}/joint_states", JOINT_STATE)
        everything = ros.listen(f"/{robot}/joint_states_estimated", JOINT_STATE)
        cell = ros.listen(f"/{robot}/muscle_tension/biceps", WRENCH)
        diagnostics = ros.listen("/diagnostics", DIAGNOSTICS)
        moved = ros.listen("/tf", "tf2_msgs/msg/TFMessage")
        with bridge(robot, network, frames):
            eventually(lambda: measured and everything and cell and moved)
            state, _ = measured[-1]
            assert state["name"] == ["shoulder", "elbow"]
            assert state["position"].tolist() == [0.25, -0.5]
            assert len(state["velocity"]) == len(state["effort"]) == 0
            assert cell[-1][0]["wrench"]["force"]["x"] == 20.0
            assert cell[-1][0]["header"]["frame_id"] == "biceps"
            assert [one["child_frame_id"] for one in moved[-1][0]["transforms"]] == ["upper", "lower"]

            talking.silent = True
            eventually(lambda: measured[-1][0]["name"] == ["shoulder"])
            eventually(lambda: everything[-1][0]["position"].tolist() == [0.25, -0.48])
            assert everything[-1][0]["name"] == ["shoulder", "elbow"]
            eventually(lambda: [one["child_frame_id"] for one in moved[-1][0]["transforms"]] == ["upper"])
            lost = (1, "estimated from muscle_tension")
            eventually(lambda: diagnostics and statuses(diagnostics[-1][0]).get("joint_position.elbow") == lost)
            assert statuses(diagnostics[-1][0])["joint_position.shoulder"] == (0, "measured")
            assert statuses(diagnostics[-1][0])["hal loop hal"] == (0, "in time")

            talking.end("model")
            talking.end("hal")
            eventually(lambda: statuses(diagnostics[-1][0]).get("joint_position.shoulder", (0,))[0] == 3)
            count = len(measured)
            eventually(lambda: statuses(diagnostics[-1][0])["robot"][0] == 3)
            assert len(measured) == count, "nothing old is published as if it were new"


@pytest.mark.long
def test_messages_are_numbered_and_come_from_one_source(robot: str, network: Network):
    with Listener(network) as ros, TalkingRobot(robot):
        heard = ros.listen(f"/{robot}/joint_states", JOINT_STATE)
        with bridge(robot, network):
            eventually(lambda: len(heard) >= 10)
    numbers, times, sources = zip(*(attachment for _, attachment in heard), strict=True)
    assert list(numbers) == sorted(set(numbers)), "a busy machine may drop messages, but none comes twice or late"
    assert len(set(sources)) == 1
    stamps = [message["header"]["stamp"]["sec"] * 10**9 + message["header"]["stamp"]["nanosec"] for message, _ in heard]
    assert stamps == sorted(set(stamps))
    assert all(0 <= sent - stamp < 60 * 10**9 for sent, stamp in zip(times, stamps, strict=True))


@pytest.mark.long
def test_tokens_describe_the_node_and_go_with_it(robot: str, network: Network, frames: Frames):
    with Listener(network) as ros, TalkingRobot(robot):
        with bridge(robot, network, frames):
            eventually(lambda: any("joint_states_estimated" in token for token in ros.tokens))
            entities = [read_token(token) for token in ros.tokens]
            assert all(one is not None and one.node == f"/{robot}/gemuco" for one in entities)
            assert [one.kind for one in entities if one and not one.topic] == [Kind.NODE]
            latched = {one.topic for one in entities if one and one.is_latched}
            assert latched == {f"/{robot}/robot_description"}
        eventually(lambda: not ros.tokens)


def test_the_description_waits_for_late_subscribers(robot: str, network: Network, frames: Frames):
    texts: list[zenoh.Sample] = []
    with Listener(network) as ros, bridge(robot, network, frames):
        eventually(lambda: any("robot_description" in token for token in ros.tokens))
        subscriber = zenoh.ext.declare_advanced_subscriber(
            ros.session,
            f"0/{robot}/robot_description/**",
            texts.append,
            history=zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=1),
        )
        eventually(lambda: texts)
        assert URDF.encode() in texts[0].payload.to_bytes()
        subscriber.undeclare()


@pytest.mark.long
def test_humble_reads_a_key_without_a_hash(robot: str):
    with ros_network("humble") as network, Listener(network) as ros, TalkingRobot(robot):
        heard = ros.listen(f"/{robot}/joint_states", JOINT_STATE)
        with bridge(robot, network):
            eventually(lambda: heard)
            assert all("RIHS01" not in token for token in ros.tokens)


@pytest.mark.slow
def test_a_name_that_is_taken_is_refused(robot: str, network: Network):
    with Node(f"/{robot}/gemuco", network), pytest.raises(NameTaken, match=f"a node '/{robot}/gemuco' already"):
        run_bridge(robot, network)


@pytest.mark.slow
def test_a_topic_of_another_node_is_left_to_it(robot: str, network: Network):
    topic = f"/{robot}/joint_states"
    with Listener(network) as ros, TalkingRobot(robot), Node("/driver", network) as driver:
        publisher = driver.publisher(topic, JOINT_STATE)
        diagnostics = ros.listen("/diagnostics", DIAGNOSTICS)
        heard = ros.listen(topic, JOINT_STATE)

        def said() -> tuple[int, str]:
            return statuses(diagnostics[-1][0])["ros2 bridge"] if diagnostics else (0, "")

        with bridge(robot, network):
            eventually(lambda: said() == (1, f"Topic '{topic}' is published by node '/driver' and is left to it."))
            assert not heard
            publisher.close()
            eventually(lambda: heard)
            eventually(lambda: said() == (0, "running"))


@pytest.mark.long
def test_a_router_that_restarts_finds_the_bridge_again(robot: str):
    place = f"tcp/127.0.0.1:{free_port()}"
    network = Network(place)
    with TalkingRobot(robot), bridge(robot, network):  # the router may also start later
        for _ in range(2):
            with routing([place]), Listener(network) as ros:
                heard = ros.listen(f"/{robot}/joint_states", JOINT_STATE)
                eventually(lambda heard=heard: heard)
                eventually(lambda ros=ros: any("joint_states" in token for token in ros.tokens))


def call(ros: Listener, name: str, kind: str) -> dict[str, Any]:
    key = names.data_key(0, name, kind, names.hash_of(kind, "jazzy"))
    request = cdr.encode(f"{kind}_Request", {"structure_needs_at_least_one_member": 0})
    gid = bytes(range(16))
    for reply in ros.session.get(key, payload=request, attachment=names.attachment(7, 1, gid), timeout=5.0):
        assert reply.ok is not None, reply.err
        assert names.read_attachment(reply.ok.attachment.to_bytes())[::2] == (7, gid)
        return cdr.decode(f"{kind}_Response", reply.ok.payload.to_bytes())
    return {}


@pytest.mark.long
def test_services_answer(robot: str, network: Network):
    estimate, stop = (f"/{robot}/estimate", "diagnostic_msgs/srv/SelfTest"), (f"/{robot}/stop", "std_srvs/srv/Trigger")
    with Listener(network) as ros, TalkingRobot(robot) as talking, bridge(robot, network):
        eventually(lambda: call(ros, *estimate).get("passed") == 1)
        talking.silent = True

        def value() -> tuple[int, str]:
            by_name = {one["name"]: one for one in call(ros, *estimate)["status"]}
            elbow = by_name[f"{robot}: joint_position.elbow"]
            return elbow["level"], {one["key"]: one["value"] for one in elbow["values"]}.get("value", "")

        eventually(lambda: value() == (1, "-0.48"))
        assert call(ros, *stop) == {"success": True, "message": "The robot's mode is 'off'."}
        assert talking.asked == ["stop"]
