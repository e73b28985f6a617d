"""The live server under Foxglove's own client and protobufjs: `make test-foxglove` installs them in build/foxglove."""

import json
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
sys.path.append(str(ROOT / "tests" / "services"))
MODULES = ROOT / "build" / "foxglove" / "node_modules"
pytest.importorskip("foxglove", reason="the extra `foxglove` is not installed")

from talking_robot import TalkingRobot  # noqa: E402
from test_foxglove import URDF, served  # noqa: E402

from services.watch.frames import Frames  # noqa: E402

pytestmark = pytest.mark.long


def seen_by_client(url: str, seconds: float) -> dict:
    """What the client saw of all topics."""
    done = subprocess.run(
        ["node", str(Path(__file__).with_name("client.cjs")), url, str(seconds)],
        capture_output=True, text=True, timeout=60, env={**os.environ, "NODE_PATH": str(MODULES)}, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-2000:]
    return json.loads(done.stdout.partition("RESULT ")[2])


def test_foxgloves_own_client_sees_every_topic_and_value(tmp_path: Path) -> None:
    if not MODULES.exists() or shutil.which("node") is None:
        pytest.skip(f"no '{MODULES}' or no node: `make test-foxglove` installs it")
    (tmp_path / "two.urdf").write_text(URDF)
    robot = f"seen_by_others_{os.getpid()}"
    with TalkingRobot(robot) as talking, served(robot, Frames(tmp_path / "two.urdf")) as url:
        talking.silent = True
        time.sleep(1.0)
        seen = seen_by_client(url, 3.0)
    schemas, newest = seen["schemas"], {topic: about["message"] for topic, about in seen["newest"].items()}
    assert schemas[f"/{robot}/tf"] == "foxglove.FrameTransforms"
    assert {"foxglove.JointStates", "foxglove.SceneUpdate", "foxglove.Log"} <= set(schemas.values())
    elbow = newest[f"/{robot}/joint_position"]["elbow"]
    assert elbow["kind"] == "estimated" and elbow["estimated"] == -0.48 and "measured" not in elbow
    measured = {joint["name"] for joint in newest[f"/{robot}/joint_states"]["joints"]}
    estimated = {joint["name"]: joint["position"] for joint in newest[f"/{robot}/joint_states_estimated"]["joints"]}
    assert "elbow" not in measured
    assert estimated["elbow"] == pytest.approx(-0.48)
    frames = {one["child_frame_id"]: one["parent_frame_id"] for one in newest[f"/{robot}/tf"]["transforms"]}
    assert frames == {"lower": "upper", "upper": "base", "tool": "lower"}
    entities = {one["id"]: one for one in newest[f"/{robot}/scene"]["entities"]}
    assert entities["link lower"]["spheres"][0]["color"]["r"] > entities["link upper"]["spheres"][0]["color"]["r"]
    assert newest[f"/{robot}/health"]["elements"]["estimated"] == 1
    assert seen["counts"][f"/{robot}/joint_position"] > 20
    assert abs(seen["newest"][f"/{robot}/tf"]["stamp"] * 1e-6 - time.time()) < 10
