"""ROS 2 over zenoh by other authors: zenoh-ros2-sdk, rosbags, ros2-pyterfaces. Runs in their environment, not in ours.

python other_hands.py listen PORT TOPIC COUNT     JointStates as JSON lines, each decoded by both readers
python other_hands.py publish PORT TOPIC SECONDS  JointStates of the joints a and b at 100 Hz, from the SDK's publisher
python other_hands.py types                       hashes and bytes of random messages, for comparison with ours
"""

import json
import math
import random
import sys
import tempfile
import time
from pathlib import Path

import zenoh
from ros2_pyterfaces.cydr import all_msgs, all_srvs
from rosbags.typesys import Stores, get_typestore
from zenoh_ros2_sdk import ROS2Publisher, ROS2Subscriber
from zenoh_ros2_sdk.message_registry import get_registry
from zenoh_ros2_sdk.session import ZenohSession

STORE = get_typestore(Stores.ROS2_JAZZY)
JOINT_STATE = "sensor_msgs/msg/JointState"
HASHED = (
    "sensor_msgs/msg/JointState", "std_msgs/msg/Float64MultiArray", "geometry_msgs/msg/WrenchStamped",
    "geometry_msgs/msg/PointStamped", "diagnostic_msgs/msg/DiagnosticArray", "std_msgs/msg/String",
    "tf2_msgs/msg/TFMessage", "trajectory_msgs/msg/JointTrajectory",
)  # fmt: skip
SOURCES = {
    "builtin_interfaces/msg/Time": "int32 sec\nuint32 nanosec\n",
    "std_msgs/msg/Header": "builtin_interfaces/Time stamp\nstring frame_id\n",
    "sensor_msgs/msg/JointState": (
        "std_msgs/Header header\nstring[] name\nfloat64[] position\nfloat64[] velocity\nfloat64[] effort\n"
    ),
    "std_msgs/msg/MultiArrayDimension": "string label\nuint32 size\nuint32 stride\n",
    "std_msgs/msg/MultiArrayLayout": "MultiArrayDimension[] dim\nuint32 data_offset\n",
    "std_msgs/msg/Float64MultiArray": "MultiArrayLayout layout\nfloat64[] data\n",
}
"""The SDK reads these files; by itself it would clone their repository."""


def definitions() -> None:
    folder = Path(tempfile.mkdtemp())
    for kind, text in SOURCES.items():
        path = folder / f"{kind}.msg"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    get_registry(str(folder))


def numbers(values) -> list[float | None]:
    return [None if math.isnan(value) else float(value) for value in values]


def fields(message) -> dict:
    stamp = message.header.stamp
    return {
        "stamp_ns": int(stamp.sec) * 10**9 + int(stamp.nanosec),
        "name": [name.decode() if isinstance(name, bytes) else str(name) for name in message.name],
        "position": numbers(message.position), "velocity": numbers(message.velocity), "effort": numbers(message.effort),
    }  # fmt: skip


def listen(port: int, topic: str, count: int) -> None:
    definitions()
    by_sdk: list[dict] = []
    raw: list[bytes] = []
    ZenohSession.get_instance("127.0.0.1", port)
    subscriber = ROS2Subscriber(topic, JOINT_STATE, lambda message: by_sdk.append(fields(message)), router_port=port)
    session = ZenohSession.get_instance().session
    key = f"0{topic}/sensor_msgs::msg::dds_::JointState_/*"
    other = session.declare_subscriber(key, lambda sample: raw.append(sample.payload.to_bytes()))
    print("listening", flush=True)
    while len(by_sdk) < count or len(raw) < count:
        time.sleep(0.05)
    other.undeclare()
    subscriber.close()
    sdk = {message["stamp_ns"]: message for message in by_sdk}
    compared = 0
    for data in raw[:count]:
        one = fields(STORE.deserialize_cdr(data, JOINT_STATE))
        assert one == fields(all_msgs.JointState.deserialize(data))
        if one["stamp_ns"] in sdk:
            assert one == sdk[one["stamp_ns"]]
            compared += 1
        print(json.dumps(one))
    assert compared > 0.9 * count, f"the SDK's subscriber read {compared} of {count}"


def publish(port: int, topic: str, seconds: float) -> None:
    definitions()
    ZenohSession.get_instance("127.0.0.1", port)
    header, clock = STORE.types["std_msgs/msg/Header"], STORE.types["builtin_interfaces/msg/Time"]
    publisher = ROS2Publisher(topic, JOINT_STATE, router_port=port)
    import numpy as np

    end = time.time() + seconds
    while (now := time.time()) < end:
        stamp = clock(sec=int(now), nanosec=int(now % 1 * 1e9))
        nothing = np.zeros(0)
        place = np.array([0.3 * math.sin(now), 0.3 * math.cos(now)])
        publisher.publish(
            header=header(stamp=stamp, frame_id=""), name=["a", "b"], position=place, velocity=nothing, effort=nothing
        )
        time.sleep(0.01)
    publisher.close()


def types() -> None:
    hashes = {kind: STORE.hash_rihs01(kind) for kind in HASHED}
    hashes |= {"std_srvs/srv/Trigger": all_srvs.Trigger.hash_rihs01()}
    joints = []
    chance = random.Random(1)
    for _ in range(200):
        size = chance.randrange(5)
        values = [[chance.gauss(0, 10) for _ in range(chance.choice((0, size)))] for _ in range(3)]
        names = ["j" * chance.randrange(9) for _ in range(size)]
        message = {"sec": chance.randrange(2**31), "nanosec": chance.randrange(10**9), "names": names, "values": values}
        joints.append(message | {"bytes": serialized(message).hex()})
    print(json.dumps({"hashes": hashes, "joints": joints}))


def serialized(message: dict) -> bytes:
    import numpy as np

    kinds = STORE.types
    stamp = kinds["builtin_interfaces/msg/Time"](sec=message["sec"], nanosec=message["nanosec"])
    header = kinds["std_msgs/msg/Header"](stamp=stamp, frame_id="frame")
    arrays = [np.array(values, float) for values in message["values"]]
    return bytes(STORE.serialize_cdr(kinds[JOINT_STATE](header, message["names"], *arrays), JOINT_STATE))


if __name__ == "__main__":
    what, *rest = sys.argv[1:]
    zenoh.init_log_from_env_or("error")
    if what == "types":
        types()
    elif what == "listen":
        listen(int(rest[0]), rest[1], int(rest[2]))
    else:
        publish(int(rest[0]), rest[1], float(rest[2]))
