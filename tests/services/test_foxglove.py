"""A robot in Foxglove: a client written from the protocol's description reads the live server; files, scene, layout."""

import contextlib
import json
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Self

import numpy as np
import pytest
from mcap.reader import make_reader
from recorded_arm import ARM, a_sample, record
from ros_listener import eventually, free_port
from talking_robot import DESCRIBED, TalkingRobot, seen

from services.errors import RecordingError, ServiceError

pytest.importorskip("foxglove", reason="the extra `foxglove` is not installed")

import foxglove
from websockets.sync.client import connect

from services.foxglove.channels import RobotChannels, health
from services.foxglove.file import write_foxglove
from services.foxglove.layout import layout, write_layout
from services.foxglove.scene import RobotScene, rod_pose
from services.foxglove.serve import run_foxglove
from services.watch.fields import element
from services.watch.frames import Frames
from services.watch.shapes import AMBER, BLUE, GREY, UNKNOWN, Shapes
from services.watch.signal_rows import Kind, signal_rows
from services.watch.trouble import troubles

URDF = """<robot name="two">
  <link name="base"/> <link name="upper"/> <link name="lower"/> <link name="tool"/>
  <joint name="elbow" type="revolute"><parent link="upper"/><child link="lower"/>
    <origin xyz="0 0 0.4"/><axis xyz="0 1 0"/><limit lower="-1" upper="1" effort="1" velocity="1"/></joint>
  <joint name="shoulder" type="revolute"><parent link="base"/><child link="upper"/>
    <origin xyz="0 0 0.1"/><axis xyz="0 1 0"/><limit lower="-1" upper="1" effort="1" velocity="1"/></joint>
  <joint name="flange" type="fixed"><parent link="lower"/><child link="tool"/><origin xyz="0 0 0.3"/></joint>
</robot>"""
PLANE = {"elements": ["x", "y", "z"], "unit": "m", "source": "hal"}


@pytest.fixture
def frames(tmp_path: Path) -> Frames:
    (tmp_path / "two.urdf").write_text(URDF)
    return Frames(tmp_path / "two.urdf")


REFUSED = "Unknown channel ID: "
"""foxglove-sdk 0.30 advertises a new channel before it accepts subscriptions to it, and reports one that is earlier."""


ACCEPTED = 0.5
"""A subscription that was not refused within this time [s] is accepted; the server says nothing then."""


class Viewer:
    """A client of the WebSocket protocol `foxglove.sdk.v1`: JSON for control, binary opcode 1 for message data."""

    def __init__(self, url: str) -> None:
        self._socket = connect(url, subprotocols=["foxglove.sdk.v1"])  # type: ignore[list-item]
        self.channels: dict[str, dict[str, Any]] = {}
        self.newest: dict[str, bytes] = {}
        self.logged, self.count = b"", 0
        self._subscribed: dict[int, str] = {}
        self._asked = time.monotonic()
        self._stop = False
        self._thread = threading.Thread(target=self._listen, daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop = True
        self._socket.close()
        self._thread.join(5.0)

    def _listen(self) -> None:
        with contextlib.suppress(Exception):
            while not self._stop:
                frame = self._socket.recv()
                if isinstance(frame, str):
                    self._take(json.loads(frame))
                elif frame[0] == 1:
                    number, _ = struct.unpack_from("<IQ", frame, 1)
                    topic = self._subscribed[number]
                    self.count += 1
                    self.newest[topic] = frame[13:]
                    self.logged += frame[13:] if topic.endswith("/log") else b""

    def _take(self, control: dict[str, Any]) -> None:
        if control["op"] == "advertise":
            self.channels.update({channel["topic"]: channel for channel in control["channels"]})
            self._subscribe(control["channels"])
        elif control["op"] == "status" and control["message"].startswith(REFUSED):
            number = int(control["message"].removeprefix(REFUSED))
            self._subscribe([channel for channel in self.channels.values() if channel["id"] == number])

    def _subscribe(self, channels: list[dict[str, Any]]) -> None:
        wanted = []
        for channel in channels:
            number = len(self._subscribed) + 1
            self._subscribed[number] = channel["topic"]
            wanted.append({"id": number, "channelId": channel["id"]})
        self._asked = time.monotonic()
        self._socket.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))

    def is_subscribed(self, topic: str) -> bool:
        """Whether a channel was advertised, and no subscription was refused for half a second."""
        return topic in self.channels and time.monotonic() - self._asked > ACCEPTED

    def json(self, topic: str) -> dict[str, Any]:
        return json.loads(self.newest[topic]) if topic in self.newest else {}


@contextlib.contextmanager
def served(robot: str, frames: Frames | None = None) -> Iterator[str]:
    port, stop = free_port(), threading.Event()
    thread = threading.Thread(
        target=run_foxglove, args=(robot, "127.0.0.1", port, (), frames, None, 50.0, stop), daemon=True
    )
    thread.start()
    try:
        eventually(lambda: socket.socket().connect_ex(("127.0.0.1", port)) == 0)
        yield f"ws://127.0.0.1:{port}"
    finally:
        stop.set()
        thread.join(15.0)
        assert not thread.is_alive()


def test_a_viewer_sees_what_is_measured_and_what_is_estimated(robot: str, frames: Frames) -> None:
    joint, log = f"/{robot}/joint_position", f"/{robot}/log"
    with TalkingRobot(robot) as talking, served(robot, frames) as url, Viewer(url) as viewer:
        eventually(lambda: viewer.json(joint).get("elbow", {}).get("measured") == -0.5)
        assert viewer.json(joint)["elbow"]["kind"] == "measured"
        schemas = {topic: channel["schemaName"] for topic, channel in viewer.channels.items()}
        assert schemas[f"/{robot}/tf"] == "foxglove.FrameTransforms"
        assert schemas[f"/{robot}/scene"] == "foxglove.SceneUpdate"
        assert schemas[f"/{robot}/joint_states"] == "foxglove.JointStates"
        assert schemas[log] == "foxglove.Log"
        assert "rad" in viewer.channels[joint]["schema"]
        eventually(lambda: viewer.is_subscribed(log))  # each of its lines is sent once
        talking.silent = True
        eventually(lambda: viewer.json(joint)["elbow"].get("estimated") == -0.48)  # the sample came before it
        lost = viewer.json(joint)["elbow"]
        assert lost["kind"] == "estimated"
        assert "measured" not in lost
        assert (lost["estimated"], lost["std"]) == (-0.48, 0.02)
        assert (lost["low"], lost["high"]) == pytest.approx((-0.48 - 0.0329, -0.48 + 0.0329))
        eventually(lambda: b"joint_position.elbow is estimated; it was " in viewer.logged)
        # A look between the sample without a value and its estimate sees neither.
        changes = (
            b"joint_position.elbow is estimated; it was measured.",
            b"joint_position.elbow is masked; it was measured.",
        )
        assert any(change in viewer.logged for change in changes)
        eventually(lambda: b"elbow" not in viewer.newest[f"/{robot}/joint_states"])
        assert b"elbow" in viewer.newest[f"/{robot}/joint_states_estimated"]
        eventually(lambda: viewer.json(f"/{robot}/health").get("elements", {}).get("estimated") == 1)
        talking.end("hal")
        talking.end("model")
        eventually(lambda: viewer.json(joint)["elbow"]["kind"] in ("old", "masked"))
        assert "value" not in viewer.json(joint)["elbow"], "what is old is not shown as present"
        eventually(lambda: viewer.json(f"/{robot}/health").get("severity") == 5.0)


@pytest.mark.slow
def test_a_viewer_that_comes_late_gets_the_scene_and_one_that_never_reads_delays_none(
    robot: str, frames: Frames
) -> None:
    values = f"/{robot}/joint_position"
    with TalkingRobot(robot), served(robot, frames) as url, Viewer(url) as first, frozen(url):
        for _ in range(2):
            with Viewer(url) as viewer:
                eventually(lambda viewer=viewer: b"link lower" in viewer.newest.get(f"/{robot}/scene", b""))
                eventually(lambda viewer=viewer: values in viewer.newest)
        before = first.count
        eventually(lambda: first.count > before + 200)


@contextlib.contextmanager
def frozen(url: str) -> Iterator[None]:
    """A viewer that subscribes to everything and never reads again."""
    with connect(url, subprotocols=["foxglove.sdk.v1"], max_queue=1) as link:  # type: ignore[list-item]
        while "channels" not in (control := json.loads(link.recv())):
            pass
        wanted = [{"id": 1 + i, "channelId": channel["id"]} for i, channel in enumerate(control["channels"])]
        link.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))
        yield


def test_a_taken_port_is_one_sentence(robot: str) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(ServiceError, match=rf"cannot be served at 127.0.0.1:{port}: .*Address already in use"):
            run_foxglove(robot, "127.0.0.1", port, (), stop=threading.Event())


def test_links_have_the_color_of_what_is_known_of_their_joints(frames: Frames) -> None:
    scene = Shapes(frames)
    for snapshot, upper, lower in (
        (seen(), BLUE, BLUE), (seen(silent=True), BLUE, AMBER), (seen(age=3.0), UNKNOWN, UNKNOWN)
    ):  # fmt: skip
        colors = scene.colors(signal_rows(snapshot))
        assert (colors["base"], colors["upper"], colors["lower"]) == (GREY, upper, lower)
        assert colors["tool"] is lower, "a fixed link is carried by the joints below it"


def test_a_joint_that_is_not_known_stays_where_it_was(frames: Frames) -> None:
    scene = RobotScene(frames)
    scene.shapes.follow(signal_rows(seen()))
    before = repr(scene.transforms(1))
    scene.shapes.follow(signal_rows(seen(age=3.0)))
    assert repr(scene.transforms(1)) == before
    scene.shapes.follow(signal_rows(seen(silent=True)))
    assert repr(scene.transforms(1)) != before


def test_poses_follow_the_tree_of_the_urdf_in_any_order(frames: Frames) -> None:
    poses = frames.poses({"shoulder": 0.3, "elbow": 0.5})
    upper = np.array([0.0, 0.0, 0.1]) + 0.4 * np.array([np.sin(0.3), 0.0, np.cos(0.3)])
    tip = upper + 0.3 * np.array([np.sin(0.8), 0.0, np.cos(0.8)])
    np.testing.assert_allclose(poses["lower"][0], upper, atol=1e-12)
    np.testing.assert_allclose(poses["tool"][0], tip, atol=1e-12)
    np.testing.assert_allclose(frames.point(poses, "lower", (0.0, 0.0, 0.3)), tip, atol=1e-12)
    assert frames.carriers()["tool"] == {"shoulder", "elbow"}
    assert frames.links[0] == "base"


@pytest.mark.parametrize("end", [(0.0, 0.0, 0.3), (0.0, 0.0, -0.3), (0.2, -0.1, 0.05)])
def test_a_rod_points_from_the_origin_to_its_end(end: tuple[float, float, float]) -> None:
    place, (x, y, z, w), length = rod_pose(end)
    axis = np.array([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)])  # z, turned
    np.testing.assert_allclose(np.array(place) + 0.5 * length * axis, end, atol=1e-9)
    np.testing.assert_allclose(np.array(place) - 0.5 * length * axis, np.zeros(3), atol=1e-9)


def test_wires_need_links_of_the_urdf(frames: Frames) -> None:
    wires = {"biceps": [("upper", 0.0, 0.0, 0.0), ("hand", 0.0, 0.0, 0.1)]}
    with pytest.raises(ServiceError, match=r"A wire is on link 'hand', which the URDF lacks\. Links: base, "):
        RobotScene(frames, wires)
    scene = RobotScene(frames, {"biceps": [("base", 0.0, 0.0, 0.0), ("lower", 0.0, 0.0, 0.1)]})
    assert b"wires" in scene.update(signal_rows(seen()), 5, {}).encode()


def test_fields_of_an_element_and_health_fit_what_the_page_says() -> None:
    snapshot = seen(silent=True)
    rows = signal_rows(snapshot)
    for row in rows:
        fields = element(row)
        assert ("measured" in fields) is (row.kind is Kind.MEASURED)
        assert ("estimated" in fields) is (row.kind is Kind.ESTIMATED)
    about = health(snapshot, rows)
    assert about["troubles"] == [str(trouble) for trouble in troubles(snapshot, rows)]
    assert about["elements"] == {"measured": 2, "estimated": 1, "masked": 0, "old": 0}
    json.dumps(about, allow_nan=False)


def test_a_layout_names_topics_and_fields_that_exist(tmp_path: Path) -> None:
    context, names = foxglove.Context(), set()
    file = tmp_path / "now.mcap"
    with foxglove.open_mcap(file, context=context):
        RobotChannels("arm", context).publish(seen(silent=True), 10**18)
    with file.open("rb") as stream:
        messages = list(make_reader(stream).iter_messages())
    topics = {channel.topic: schema for schema, channel, _ in messages}
    for topic, schema in topics.items():
        if topic.startswith(("/arm/joint_position", "/arm/muscle_tension")):
            for part, fields in json.loads(schema.data)["properties"].items():
                names |= {f"{topic}.{part}.{field}" for field in fields["properties"]}
    signals = {name: (about["unit"], about["elements"]) for name, about in DESCRIBED["signals"].items()}
    made = layout("arm", signals, "base")
    paths = [path["value"] for panel in made["configById"].values() for path in panel.get("paths", [])]
    assert len(paths) == 2 + 4 * 3 and set(paths) <= names
    assert made["configById"]["3D!robot"]["topics"].keys() <= topics.keys() | {"/arm/scene"}
    assert made["configById"]["RosOut!log"]["topicToRender"] in topics
    assert made["configById"]["RawMessages!health"]["topicPath"] in topics
    placed = json.dumps(made["layout"])
    assert all(f'"{panel}"' in placed for panel in made["configById"])
    write_layout(tmp_path / "arm.json", "arm", signals, "base")
    assert json.loads((tmp_path / "arm.json").read_text()) == made
    with pytest.raises(ServiceError, match=r"arm.json' exists and is not replaced"):
        write_layout(tmp_path / "arm.json", "arm", signals, "base")


def test_a_recording_has_the_same_channels(tmp_path: Path, frames: Frames) -> None:
    files = record(tmp_path / "walk.mcap", "arm", 300)
    path, count = write_foxglove(files, tmp_path / "out", frames)
    assert path == tmp_path / "out" / "walk.foxglove.mcap"
    assert 80 <= count <= 100, "3 s, at most 30 times a second"
    true = {a_sample(number).stamp_ns: a_sample(number).values["joint_position"][1] for number in range(300)}
    with path.open("rb") as stream:
        messages = [(channel.topic, message) for _, channel, message in make_reader(stream).iter_messages()]
    topics = {topic for topic, _ in messages}
    assert {"/arm/tf", "/arm/scene", "/arm/joint_states", "/arm/log", "/arm/health", "/arm/joint_position"} <= topics
    name = ARM.signals["joint_position"].elements[1]
    compared = 0
    for topic, message in messages:
        if topic == "/arm/joint_position":
            fields = json.loads(message.data)[name]
            stamp = max(at for at in true if at + 200_000 <= message.log_time)
            assert fields["measured"] in (true[stamp], true.get(stamp - 10_000_000))
            compared += 1
    assert compared >= 80
    with pytest.raises(RecordingError, match=r"walk.foxglove.mcap' exists and is not replaced"):
        write_foxglove(files, tmp_path / "out", frames)
    with pytest.raises(RecordingError, match="is not a recording of `gemuco record`"):
        write_foxglove([path], tmp_path / "again", frames)


def test_a_gap_in_a_recording_is_shown_as_old(tmp_path: Path) -> None:
    first = record(tmp_path / "a.mcap", "arm", 100)
    later = record(tmp_path / "b.mcap", "arm", 100, begin=500)
    path, _ = write_foxglove([*first, *later], tmp_path)
    with path.open("rb") as stream:
        kinds = [
            json.loads(message.data)[ARM.signals["joint_position"].elements[0]]["kind"]
            for _, channel, message in make_reader(stream).iter_messages(topics=["/arm/joint_position"])
        ]
    assert kinds[0] == kinds[-1] == "measured"
    assert "old" in kinds


@pytest.mark.slow
def test_the_verbs_write_a_layout_and_a_file(tmp_path: Path) -> None:
    answer = gemuco("foxglove", "pr2_duster", "--layout", str(tmp_path / "pr2.json"))
    assert answer.returncode == 0, answer.stderr
    assert "/pr2_duster/scene" in (tmp_path / "pr2.json").read_text()
    record(tmp_path / "walk.mcap", "arm", 50)
    answer = gemuco("export", str(tmp_path / "walk.mcap"), "--out", str(tmp_path), "--format", "foxglove")
    assert answer.returncode == 0, answer.stderr
    assert (tmp_path / "walk.foxglove.mcap").exists()


def gemuco(*words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "services.cli", *words], capture_output=True, text=True, timeout=100, check=False
    )
