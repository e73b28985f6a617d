"""Run a light robot, and LeRobot's own programs on it; `make test-lerobot` makes their environment.

    python tests/lerobot/record_proof.py FOLDER

FOLDER has a Python with lerobot, lerobot-doctor, lerobot-lint and this plugin. Prints what each program said, and ends
with an error if one of them is not satisfied.
"""

import os
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

from services.client import Client
from services.process.supervisor import Supervisor
from studies.stack.light_robot import JOINTS
from studies.stack.soak.robot import Robot, client_of

TELEOPERATOR = '''
"""A teleoperator that waves both joints."""
import math, time
from dataclasses import dataclass
from lerobot.teleoperators.config import TeleoperatorConfig
from lerobot.teleoperators.teleoperator import Teleoperator

@TeleoperatorConfig.register_subclass("waver")
@dataclass
class WaverConfig(TeleoperatorConfig):
    signal: str = ""

class Waver(Teleoperator):
    config_class, name = WaverConfig, "waver"
    def __init__(self, config):
        super().__init__(config)
        self.config = config
    action_features = property(lambda self: {f"{self.config.signal}.{j}": float for j in ("shoulder", "elbow")})
    feedback_features = property(lambda self: {})
    is_connected = is_calibrated = property(lambda self: True)
    def connect(self, calibrate=True): pass
    def calibrate(self): pass
    def configure(self): pass
    def disconnect(self): pass
    def send_feedback(self, feedback): pass
    def get_action(self):
        now = time.monotonic()
        angles = {"shoulder": 0.4 * math.sin(now), "elbow": 0.3 * math.sin(1.7 * now)}
        return {f"{self.config.signal}.{joint}": angle for joint, angle in angles.items()}
'''
READ = """
import sys
import numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset
data = LeRobotDataset("gemuco/proof", root=sys.argv[1])
names = data.features["observation.state"]["names"]
rows = np.array([data[i]["observation.state"].numpy() for i in range(len(data))])
lost = rows[:, names.index("joint_position.elbow.estimated")]
std = rows[:, names.index("joint_position.elbow.std")]
print("episodes", data.num_episodes, "frames", len(data), "estimated", int(lost.sum()))
print("expected error there", float(std[lost > 0].mean()))
moved = np.ptp(rows[:, names.index("joint_position.shoulder")])
assert data.num_episodes == 3 and len(data) > 150, "three episodes"
assert 10 < lost.sum() < len(data), "the encoder was lost for a part of the time, and marked"
assert (std[lost > 0] > 0).all() and (std[lost == 0] == 0).all(), "only an estimate has an expected error"
assert moved > 0.3, "the arm moved"
"""


def main(folder: Path) -> None:
    """Play the proof."""
    with tempfile.TemporaryDirectory() as place:
        work = Path(place)
        plug = work / "lerobot_teleoperator_waver"
        plug.mkdir()
        (plug / "__init__.py").write_text(TELEOPERATOR)
        about = work / "lerobot_teleoperator_waver-0.1.dist-info"
        about.mkdir()
        (about / "METADATA").write_text("Metadata-Version: 2.1\nName: lerobot_teleoperator_waver\nVersion: 0.1\n")
        with Supervisor(work / "services") as supervisor:
            robot = Robot(supervisor, f"lerobot_{os.getpid()}", work / "model")
            robot.start_router()
            with client_of(robot.name, robot.router) as client:
                robot.start(client)
                _prove(folder, work, robot, client)


def _prove(folder: Path, work: Path, robot: Robot, client: Client) -> None:
    signal = robot.config.command.signal
    ends = threading.Event()
    loser = threading.Thread(target=_lose, args=(client, ends), daemon=True)
    loser.start()
    try:
        _run(
            work, folder / "bin" / "lerobot-record", "--robot.type=gemuco", f"--robot.robot={robot.name}",
            f"--robot.connect=[{robot.router}]", "--robot.id=proof", "--teleop.type=waver",
            f"--teleop.signal={signal}", "--dataset.repo_id=gemuco/proof", f"--dataset.root={work / 'recorded'}",
            "--dataset.num_episodes=3", "--dataset.episode_time_s=4", "--dataset.reset_time_s=1", "--dataset.fps=20",
            "--dataset.single_task=wave", "--dataset.push_to_hub=false", "--play_sounds=false",
        )  # fmt: skip
    finally:
        ends.set()
        loser.join()
    _run(work, folder / "bin" / "python", "-c", READ, work / "recorded")
    time.sleep(1.0)
    robot.supervisor.stop("recorder")
    recordings = sorted(robot.recordings.glob("*.mcap"))
    exported = work / "exported"
    _run(work, sys.executable, "-m", "services.cli", "export", *recordings, "--out", exported, "--format", "lerobot")
    for dataset in (work / "recorded", exported):
        _run(work, folder / "bin" / "lerobot-doctor", "check", dataset, forbidden="[FAIL]")
    # lerobot-record puts all numbers into one state, and lelint takes each mark for a joint that never moves.
    _run(work, folder / "bin" / "lelint", "check", exported, codes=(0, 1), wanted="Summary: 0 errors, 0 warnings")
    count = (
        "import sys; from lerobot.datasets.lerobot_dataset import LeRobotDataset as D;"
        "d = D('gemuco/exported', root=sys.argv[1]); print(d.num_episodes, len(d), d[0]['observation.state'])"
    )
    _run(work, folder / "bin" / "python", "-c", count, exported)


def _lose(client: Client, ends: threading.Event) -> None:
    """Silence the elbow's encoder for two seconds of every eight."""
    assert "elbow" in JOINTS
    while not ends.wait(6.0):
        client.fault("sensor_silent elbow_encoder")
        ends.wait(2.0)
        client.fault("node_back elbow_encoder")


def _run(work: Path, *command: object, forbidden: str = "", wanted: str = "", codes: tuple[int, ...] = (0,)) -> None:
    """Run a program and print its last lines.

    Raises:
        SystemExit: It fails, or says what it should not.
    """
    words = [str(word) for word in command]
    environment = {**os.environ, "HF_HUB_OFFLINE": "1", "HF_HOME": str(work / "hf")}
    if "lerobot" in words[0]:
        environment["PYTHONPATH"] = str(work)
    answer = subprocess.run(words, cwd=work, env=environment, capture_output=True, text=True, check=False, timeout=300)
    text = answer.stdout + answer.stderr
    shown = answer.stdout.splitlines() or text.splitlines()
    print(f"== {Path(words[0]).name} {' '.join(words[1:3])[:60]}: {answer.returncode}")
    print("\n".join(shown[-12:]))
    if answer.returncode not in codes or (forbidden and forbidden in text) or wanted not in text:
        print("\n".join(shown[-60:]))
        raise SystemExit(f"{Path(words[0]).name} is not satisfied.")


if __name__ == "__main__":
    main(Path(sys.argv[1]).resolve())
