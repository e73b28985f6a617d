"""Our simulated servos under masters of other authors: `make test-servos` installs them in build/servos.

What they see of our nodes is what they would see of the makers' hardware, so a misread document would show here.
"""

import json
import subprocess
import sys
import time
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
sys.path.append(str(ROOT / "tests" / "hal"))

from serial_bench import NODES, SerialBench, path, robot_file  # noqa: E402

from hal.config import RobotConfig  # noqa: E402
from simulators.nodes.canopen.spec import NodeSpec  # noqa: E402
from simulators.nodes.mit_drive import MitConstants  # noqa: E402
from simulators.rig import Rig  # noqa: E402
from simulators.robots.bench.world import BenchWorld  # noqa: E402

HANDS, LEROBOT = ROOT / "build" / "servos" / "bin" / "python", ROOT / "build" / "lerobot" / "bin" / "python"
STEP = 1
pytestmark = pytest.mark.long


def hand(*arguments, python=HANDS, **environment):
    """What a master of another author saw."""
    if not python.exists():
        pytest.skip(f"no '{python}': `make test-servos` installs it, for LeRobot `make test-lerobot`")
    done = subprocess.run(
        [str(python), str(Path(__file__).with_name("hands.py")), *map(str, arguments)],
        capture_output=True, text=True, timeout=120, env={"PATH": "/usr/bin:/bin", "HOME": "/tmp", **environment},
        check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-3000:]
    line = next(line for line in done.stdout.splitlines() if line.startswith("RESULT "))
    return json.loads(line.removeprefix("RESULT "))


@pytest.fixture
def line():
    """Servos on a terminal, with no master of ours."""
    benches = []

    def start(make, **over):
        bench = SerialBench(make, robot_file(make), **over)
        bench.plug()
        benches.append(bench)
        bench.set("pan", 0.3)
        time.sleep(0.1)  # the servos see the world in its next step
        return bench

    yield start
    for bench in benches:
        bench.unplug()


def start_counts(bench):
    return [bench.rig.node(f"{name}_servo").counts for name in ("pan", "lift", "elbow")]


def test_feetech_by_its_own_sdk(line):
    bench = line("feetech")
    counts = start_counts(bench)
    seen = hand("scservo", path(bench))
    assert [seen["pings"][str(node)][:2] for node in NODES] == [[777, 0]] * 3
    assert seen["pings"]["9"][1] != 0, "a servo that is not there answered"
    assert seen["before"] == pytest.approx(counts, abs=STEP)
    assert seen["result"] == 0
    for node, goal in zip(NODES, (2300, 1900, 2100), strict=True):
        position, voltage, temperature = seen["after"][str(node)]
        assert position == pytest.approx(goal, abs=STEP)
        assert (voltage, temperature) == (74, 31)
    assert not any(enabled for _, enabled in bench.world._servos.values())


def test_dynamixel_by_its_own_sdk(line):
    bench = line("dynamixel")
    counts = start_counts(bench)
    seen = hand("dynamixel", path(bench))
    assert seen["everybody"] == {str(node): 1020 for node in NODES}
    assert [seen["pings"][str(node)] for node in NODES] == [[1020, 0, 0]] * 3
    assert seen["pings"]["9"][1] != 0
    assert seen["before"] == pytest.approx(counts, abs=STEP)
    assert seen["on"] == [[0, 0]] * 3
    assert seen["locked"] == [0, 7], "access error"
    assert seen["beyond"] == [0, 6], "data limit error"
    assert seen["sync"] == 0
    for node, goal in zip(NODES, (2300, 1900, 2100), strict=True):
        position, voltage, temperature = seen["after"][str(node)]
        assert position == pytest.approx(goal, abs=STEP)
        assert (voltage, temperature) == (119, 34)
    assert seen["watch"] == [0, 0]
    assert seen["expired"] == [255, 0, 0]
    assert seen["refused"] == [0, 4], "data range error"
    assert seen["reboot"] == [0, 0]
    assert seen["alive"][:2] == [1020, 0]


@pytest.mark.parametrize(("make", "what"), [("feetech", "rustypot_sts"), ("dynamixel", "rustypot_xl330")])
def test_both_by_rustypot(line, make, what):
    bench = line(make)
    counts = start_counts(bench)
    seen = hand(what, path(bench))
    assert seen["pings"] == [True] * 3
    assert [int.from_bytes(bytes(raw), "little") for raw in seen["before"]] == pytest.approx(counts, abs=STEP)
    assert seen["after"] == pytest.approx([2300, 1900, 2100], abs=STEP)


@pytest.mark.parametrize("make", ["feetech", "dynamixel"])
def test_both_by_lerobot(line, make):
    bench = line(make)
    counts = start_counts(bench)
    seen = hand(f"lerobot_{make}", path(bench), python=LEROBOT)
    assert seen["before"] == pytest.approx(counts, abs=STEP)
    assert seen["after"] == pytest.approx([2300, 1900, 2100], abs=STEP)
    assert {int(node) for node in seen["seen"]} == set(NODES)
    assert seen["delay"] == 0
    assert not any(enabled for _, enabled in bench.world._servos.values())


def mit_rig(interface, channel):
    """One Damiao drive that answers under 14h."""
    config = RobotConfig.model_validate(
        {
            "robot": "one_drive",
            "signals": {"joint_position": {"unit": "rad", "elements": ["elbow"]}},
            "command": {"signal": "joint_position"},
            "buses": {"can0": {"interface": interface, "channel": channel}},
            "kinds": {"drive": {"driver": "mit", "settings": {"motor": "DM4310", "stiffness": 40, "damping": 2}}},
            "devices": {"elbow_drive": {"kind": "drive", "bus": "can0", "node": 4, "element": "joint_position.elbow"}},
        }
    )
    return Rig(config, BenchWorld(config), [NodeSpec("drive", "can0", 4, "joint_position.elbow", MitConstants())])


def test_damiao_motor_drives_our_node_on_the_hub():
    """In our own interpreter, because the hub is our interface of python-can; their package is beside it."""
    packages = next((ROOT / "build" / "servos" / "lib").glob("python3*/site-packages"), None)
    if packages is None:
        pytest.skip("no 'build/servos': `make test-servos` installs it")
    rig = mit_rig("hub", "test_hands")
    rig.start()
    try:
        hands = str(Path(__file__).with_name("hands.py"))
        runner = (
            "import runpy, sys; sys.path.append(sys.argv.pop(1)); sys.argv[0] = 'hands.py'; "
            f"runpy.run_path({hands!r}, run_name='__main__')"
        )
        done = subprocess.run(
            [sys.executable, "-c", runner, str(packages), "damiao", "test_hands", "hub"],
            capture_output=True, text=True, timeout=60, cwd=ROOT, check=False,
        )  # fmt: skip
        assert done.returncode == 0, done.stderr[-3000:]
        seen = json.loads(next(text for text in done.stdout.splitlines() if "RESULT" in text).removeprefix("RESULT "))
    finally:
        rig.stop()
    _is_driven(seen["ranges"], seen["moved"]["pos"])
    assert seen["moved"]["status_code"] == 1
    assert seen["off"]["status_code"] == 0


def test_motorbridge_drives_our_node_on_vcan():
    if not Path("/sys/class/net/vcan0").exists():
        pytest.skip("no vcan0 here: `make test-servos` boots a kernel that has one")
    rig = mit_rig("socketcan", "vcan0")
    rig.start()
    try:
        seen = hand("motorbridge", "vcan0")
    finally:
        rig.stop()
    _is_driven(seen["ranges"], seen["position"])
    assert seen["status"] == 1


def _is_driven(ranges, position):
    assert ranges == pytest.approx([12.5, 30.0, 10.0])
    assert position == pytest.approx(0.5, abs=0.02)
