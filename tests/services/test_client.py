"""A remote client: light to import, told what a robot is even by half of it, and readable without anything of ours."""

import json
import os
import statistics
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from services.client import Client
from services.errors import ServiceUnavailable
from services.process.service import Service
from services.verbs.ask import ask_robot
from services.wire import keys
from services.wire.messages import VERSION, Sample
from services.wire.session import endpoint

HEAVY = (
    "torch",
    "pybullet",
    "can",
    "canopen",
    "cantools",
    "pydantic",
    "yaml",
    "rich",
    "typer",
    "cryptography",
    "scipy",
)


def cpu_time(statement: str, compiled: Path) -> float:
    """CPU time [s] that a fresh interpreter needs for a statement; it does not grow with what others do."""
    program = f"import time; begun = time.process_time(); {statement}; print(time.process_time() - begun)"
    environment = {**os.environ, "PYTHONPYCACHEPREFIX": str(compiled)}
    environment.pop("PYTHONDONTWRITEBYTECODE", None)
    done = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True, check=True)
    return float(done.stdout)


@pytest.mark.long
def test_importing_the_client_costs_little_more_than_what_it_stands_on(tmp_path: Path) -> None:
    """docs/results_running.md has its duration; here is what it is made of, compiled as at its second start."""
    bare, ours = [], []
    for _ in range(4):
        bare.append(cpu_time("import numpy, zenoh, msgpack", tmp_path))
        ours.append(cpu_time("import services.client", tmp_path))
    bare, ours = bare[1:], ours[1:]
    assert statistics.median(ours) < 2.5 * statistics.median(bare)


def test_importing_the_client_loads_nothing_of_the_robot() -> None:
    program = (
        "import sys, services.client, services.client.live, services.wire.history\n"
        f"print([name for name in {HEAVY!r} if name in sys.modules], *(n for n in sys.modules if 'hal.' in n))"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    loaded, *hal = done.stdout.split()
    assert loaded == "[]"
    assert set(hal) == {"hal.errors", "hal.clock", "hal.by_signal"}


HAL = {
    "description": "a small arm",
    "signals": {"joint_position": {"unit": "rad", "elements": ["elbow"], "source": "hal"},
                "motor_temperature": {"unit": "degC", "elements": ["elbow"], "source": "hal"}},
    "command": {"signal": "joint_position"},
    "conditions": ["bare"],
    "limits": {"joint_position": {"rate": 1.0}},
    "rates": {"hal": 200.0},
    "devices": {},
}  # fmt: skip
MODEL = {
    "signals": {"joint_position": {"unit": "rad", "elements": ["elbow"]}},
    "x_in": ["joint_position"],
    "x_out": ["joint_position"],
    "masks": ["joint_position"],
    "conditions": {"bare": [0.0]},
    "model_version": 3,
}


@pytest.mark.long
def test_a_robot_is_described_as_far_as_it_is_there(robot: str, capsys: pytest.CaptureFixture[str]) -> None:
    with Client(robot) as client:
        with pytest.raises(ServiceUnavailable, match=f"Robot '{robot}' has no service now"):
            client.describe()
        with Service(robot, "hal", describe=lambda: HAL) as hal:
            half = client.describe()
            assert half["limits"] == HAL["limits"]
            assert half["signals"]["joint_position"]["source"] == "hal"
            assert "x_in" not in half
            assert half["missing"] == [
                "'model' gives no description: there is no 'model' service. Is `gemuco serve` running?"
            ]
            with Service(robot, "model", describe=lambda: MODEL) as model:
                found = client.describe()
                assert found["missing"] == []
                assert (found["x_in"], found["masks"]) == (["joint_position"], ["joint_position"])
                assert [one["is_in_model"] for one in found["signals"].values()] == [True, False]
                assert found["versions"]["wire"] == VERSION
                assert found["versions"]["model"] == 3
                assert found["versions"]["package"].keys() == {"hal", "model"}
                assert {name: one["boot"] for name, one in found["services"].items()} == {
                    "hal": hal.boot, "model": model.boot,
                }  # fmt: skip
                assert ask_robot(robot, "describe", [], (), False, ()) == 0
                assert "x_in:" in capsys.readouterr().out
                assert client.describe("hal")["limits"] == HAL["limits"]


def test_verbs_and_readers_may_be_used_from_several_threads(robot: str) -> None:
    with Client(robot) as client, Service(robot, "model") as service:
        service.verb("echo", lambda arguments: arguments)
        failed: list[object] = []

        def use(number: int) -> None:
            for turn in range(20):
                report = {"n": number, "turn": turn}
                if client.ask("model", "echo", report, timeout=20.0) != report:
                    failed.append(report)
                client.sample(), client.status("hal"), client.alive()

        threads = [threading.Thread(target=use, args=(number,)) for number in range(4)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert not failed
        names = [thread.name for thread in threading.enumerate()]
        assert names.count(f"newest {keys.sample(robot)}") == 1


PLAIN_READER = """
import json, struct, sys
sys.path.extend(json.loads(sys.argv[3]))
import msgpack, zenoh

try:
    import services
    sys.exit("our package can be imported here; the test would prove nothing")
except ImportError:
    config = zenoh.Config.from_json5(json.dumps({
        "mode": "client", "connect": {"endpoints": [sys.argv[1]], "timeout_ms": 20000},
        "scouting": {"multicast": {"enabled": False}},
    }))
with zenoh.open(config) as session, session.declare_subscriber(f"gemuco/{sys.argv[2]}/hal/sample") as samples:
    message = samples.recv()
    body = msgpack.unpackb(message.payload.to_bytes())
    doubles = lambda binary: list(struct.unpack(f"<{len(binary) // 8}d", binary))

    def by_signal(numbers):
        rest = iter(numbers)
        return {signal: [next(rest) for _ in range(count)] for signal, count in body["elements"].items()}

    print(json.dumps({
        "encoding": str(message.encoding),
        "header": [body[name] for name in ("type", "v", "seq", "boot", "cycle", "source", "complete")],
        "values": by_signal(doubles(body["values"])),
        "valid": by_signal(map(bool, body["valid"])),
        "age": by_signal(doubles(body["age"])),
    }))
"""


def _age(values: np.ndarray) -> np.ndarray:
    return np.full(values.shape, 0.001)


def test_a_sample_is_read_with_nothing_of_ours(robot: str, tmp_path: Path) -> None:
    """As docs/keys.md says: zenoh, msgpack, and doubles in little-endian order."""
    packages = [path for path in sys.path if path.endswith("-packages")]
    sent: dict[str, Any] = {"joint_position": np.array([0.5, -1.25]), "muscle_tension": np.array([np.nan, 20.0])}
    with Service(robot, "hal") as service:
        reader = subprocess.Popen(
            [sys.executable, "-I", "-S", "-c", PLAIN_READER, endpoint(robot, "hal"), robot, json.dumps(packages)],
            cwd=tmp_path, stdout=subprocess.PIPE, text=True,
        )  # fmt: skip
        publisher = service.publisher(keys.sample(robot), Sample)
        age, valid = ({name: made(value) for name, value in sent.items()} for made in (_age, np.isfinite))
        sample = Sample(cycle=4, source="simulated", complete=False, values=sent, age=age, valid=valid)
        while reader.poll() is None:
            publisher.put(sample)
            time.sleep(0.01)
        said = reader.communicate()[0]
        assert reader.returncode == 0
        found = json.loads(said)
        assert found["encoding"] == "application/msgpack;gemuco.sample.v2"
        kind, version, seq, boot, *rest = found["header"]
        assert (kind, version, boot, rest) == ("sample", 2, service.boot, [4, "simulated", False])
        assert seq >= 0
        assert found["values"]["joint_position"] == [0.5, -1.25]
        assert found["values"]["muscle_tension"][1] == 20.0
        assert np.isnan(found["values"]["muscle_tension"][0])
        assert found["valid"] == {"joint_position": [True, True], "muscle_tension": [False, True]}
        assert found["age"]["joint_position"] == [0.001, 0.001]
