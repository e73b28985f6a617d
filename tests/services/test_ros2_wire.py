"""The wire format of ROS 2 over zenoh: hashes, bytes, keys and tokens, against values of other implementations.

The bytes were written by rosbags 0.11.9, the hashes are those of ROS 2 Jazzy; `make test-ros2` compares anew.
"""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from services.ros2 import cdr, names
from services.ros2.cdr import BadBytes
from services.ros2.definitions import DEFINITIONS, UnknownType, type_hash
from services.ros2.names import Entity, Kind
from services.watch.frames import Frames

HASHES = {
    "sensor_msgs/msg/JointState": "a13ee3a330e346c9d87b5aa18d24e11690752bd33a0350f11c5882bc9179260e",
    "diagnostic_msgs/msg/DiagnosticArray": "5a8a36efb05fb25070fa0fb3810290c0e6cd4862b54a8fb975a1ee8dc55a333e",
    "geometry_msgs/msg/WrenchStamped": "8dc3deaf06b2ab281f9f9a742a8961c328ca7cec16e3fd6586d3a5c83fa78f77",
    "std_msgs/msg/Float64MultiArray": "1025ddc6b9552d191f89ef1a8d2f60f3d373e28b283d8891ddcc974e8c55397f",
    "geometry_msgs/msg/PointStamped": "4c0296af86e01e562e9e0405d138a01537247580076c58ea38d7923ac1045897",
    "trajectory_msgs/msg/JointTrajectory": "179b33eba59d676f6d967ac71fe35e7ca2f64b2f3928f4a018cec115e213796e",
    "tf2_msgs/msg/TFMessage": "e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087",
    "std_srvs/srv/Trigger": "eeff2cd6fa5ad9d27cdf4dec64818317839b62f212a91e6b5304b634b2062c5f",
}
HEADER = {"stamp": {"sec": 1, "nanosec": 2}, "frame_id": "f"}
DURATION = {"sec": 0, "nanosec": 5}
GOLDEN = {
    "std_msgs/msg/String": ({"data": "ab"}, "0001000003000000616200"),
    "sensor_msgs/msg/JointState": (
        {"header": HEADER, "name": ["a", "bcd"], "position": [0.5, -1.0], "velocity": [], "effort": [2.0, math.nan]},
        "0001000001000000020000000200000066000000020000000200000061000000040000006263640002000000000000000000e03f0000"
        "00000000f0bf00000000020000000000000000000040000000000000f87f",
    ),
    "std_msgs/msg/Float64MultiArray": (
        {"layout": {"dim": [{"label": "a,b", "size": 2, "stride": 2}], "data_offset": 0}, "data": [1.0, 2.0]},
        "000100000100000004000000612c62000200000002000000000000000200000000000000000000000000f03f0000000000000040",
    ),
    "geometry_msgs/msg/PointStamped": (
        {"header": HEADER, "point": {"x": 1.0, "y": 2.0, "z": 3.0}},
        "0001000001000000020000000200000066000000000000000000f03f00000000000000400000000000000840",
    ),
    "diagnostic_msgs/msg/DiagnosticArray": (
        {
            "header": HEADER,
            "status": [
                {
                    "level": 3, "name": "n", "message": "gone", "hardware_id": "",
                    "values": [{"key": "k", "value": "v"}],
                }
            ],
        },
        "00010000010000000200000002000000660000000100000003000000020000006e00000005000000676f6e6500000000010000000000"
        "000001000000020000006b000000020000007600",
    ),
    "trajectory_msgs/msg/JointTrajectory": (
        {
            "header": HEADER,
            "joint_names": ["a"],
            "points": [
                {"positions": [0.5], "velocities": [], "accelerations": [], "effort": [], "time_from_start": DURATION}
            ],
        },
        "0001000001000000020000000200000066000000010000000200000061000000010000000100000000000000000000000000e03f0000"
        "000000000000000000000000000005000000",
    ),
}  # fmt: skip


@pytest.mark.parametrize("kind", HASHES)
def test_hashes_are_computed_as_ros_does(kind: str):
    assert type_hash(kind) == f"RIHS01_{HASHES[kind]}"


def test_an_unknown_type_is_named_with_the_known_ones():
    with pytest.raises(UnknownType, match=r"'nav_msgs/msg/Odometry' is not known here\. Known types: .*JointState"):
        type_hash("nav_msgs/msg/Odometry")


@pytest.mark.parametrize("kind", GOLDEN)
def test_bytes_are_those_of_another_implementation(kind: str):
    message, golden = GOLDEN[kind]
    assert cdr.encode(kind, message).hex() == golden
    np.testing.assert_equal(plain(cdr.decode(kind, bytes.fromhex(golden))), message)


def plain(message: object) -> object:
    if isinstance(message, dict):
        return {name: plain(value) for name, value in message.items()}
    return message.tolist() if isinstance(message, np.ndarray) else message


def test_big_endian_bytes_are_read():
    point = cdr.decode("geometry_msgs/msg/Point", b"\0\0\0\0" + np.array([1.0, 2.0, 3.0], ">f8").tobytes())
    assert point == {"x": 1.0, "y": 2.0, "z": 3.0}


@pytest.mark.parametrize("kind", GOLDEN)
def test_cut_bytes_are_refused(kind: str):
    data = bytes.fromhex(GOLDEN[kind][1])
    for size in range(len(data)):
        with pytest.raises(BadBytes, match=kind):
            cdr.decode(kind, data[:size])
    with pytest.raises(BadBytes, match="left over"):
        cdr.decode(kind, data + bytes(8))


@settings(max_examples=300, deadline=None)
@given(st.sampled_from(sorted(DEFINITIONS)), st.binary(max_size=200))
def test_any_bytes_are_a_message_or_one_error(kind: str, data: bytes):
    for header in (b"", cdr.LITTLE):
        try:
            cdr.decode(kind, header + data)
        except BadBytes as error:
            assert kind in str(error)


def test_keys_and_tokens_read_as_rmw_zenoh_writes_them():
    key = names.data_key(0, "/arm/joint_states", "sensor_msgs/msg/JointState", names.NO_HASH)
    assert key == "0/arm/joint_states/sensor_msgs::msg::dds_::JointState_/TypeHashNotSupported"
    assert names.node_token(7, "ab12", 0, "/arm/gemuco") == "@ros2_lv/7/ab12/0/0/NN/%/%arm/gemuco"
    assert names.node_token(7, "ab12", 0, "/gemuco") == "@ros2_lv/7/ab12/0/0/NN/%/%/gemuco"
    hash_ = names.hash_of("std_msgs/msg/String", "jazzy")
    entity = Entity(Kind.PUBLISHER, "/arm/gemuco", "/arm/text", "std_msgs/msg/String", hash_, names.LATCHED, "ab12")
    token = names.endpoint_token(0, 0, 3, entity)
    assert token == (
        f"@ros2_lv/0/ab12/0/3/MP/%/%arm/gemuco/%arm%text/std_msgs::msg::dds_::String_/{hash_}/1:1:1,1:,:,:,,"
    )
    assert names.read_token(token) == entity
    assert entity.is_latched


@pytest.mark.parametrize("key", ["", "@ros2_lv/0/ab/0/0/XX/%/%/n", "@ros2_lv/0/ab/0/1/MP/%/%/n", "a/b/c"])
def test_other_keys_are_no_tokens(key: str):
    assert names.read_token(key) is None


def test_humble_has_no_hashes():
    assert names.hash_of("std_msgs/msg/String", "humble") == "TypeHashNotSupported"
    assert names.hash_of("std_msgs/msg/String", "kilted").startswith("RIHS01_")


def test_an_attachment_has_33_bytes():
    data = names.attachment(5, 6, bytes(range(16)))
    assert len(data) == 33
    assert names.read_attachment(data) == (5, 6, bytes(range(16)))
    with pytest.raises(ValueError, match="32 bytes, not 33"):
        names.read_attachment(data[:-1])


@pytest.mark.parametrize(
    ("text", "name"), [("left-knee", "left_knee"), ("2nd", "_2nd"), ("a__b", "a_b"), ("élan", "_lan")]
)
def test_names_become_names_of_ros(text: str, name: str):
    assert names.ros_name(text) == name


def test_frames_are_where_the_urdf_says(tmp_path):
    path = tmp_path / "arm.urdf"
    path.write_text(
        """<robot name="arm"><link name="a"/><link name="b"/><link name="c"/><link name="d"/>
        <joint name="turn" type="revolute"><parent link="a"/><child link="b"/>
          <origin xyz="1 2 3" rpy="0 0 1.5707963267948966"/><axis xyz="0 0 2"/></joint>
        <joint name="slide" type="prismatic"><parent link="b"/><child link="c"/>
          <origin rpy="0 0 1.5707963267948966"/><axis xyz="1 0 0"/></joint>
        <joint name="fast" type="fixed"><parent link="c"/><child link="d"/></joint></robot>"""
    )
    frames = Frames(path)
    (fast,) = frames.fixed()
    assert (fast["parent"], fast["child_frame_id"]) == ("c", "d")
    assert list(frames.moved({})) == []
    turn, slide = frames.moved({"turn": math.pi / 2, "slide": 0.5})
    assert turn["transform"]["translation"] == {"x": 1.0, "y": 2.0, "z": 3.0}
    assert turn["transform"]["rotation"] == pytest.approx({"x": 0.0, "y": 0.0, "z": 1.0, "w": 0.0}, abs=1e-9)
    assert slide["transform"]["translation"] == pytest.approx({"x": 0.0, "y": 0.5, "z": 0.0}, abs=1e-9)
