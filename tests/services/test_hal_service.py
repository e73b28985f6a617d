import os
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bad_commands import bad_commands
from small_arm import Processes, eventually

from hal.config import load_robot
from hal.errors import CommandRefused, ConfigError
from services.errors import RemoteError
from services.hardware.hal_service import run_hal
from services.hardware.simulator_service import run_simulator
from services.wire import keys, messages


@pytest.fixture(scope="module")
def arm(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Processes]:
    with Processes(f"small_arm_{os.getpid()}", tmp_path_factory.mktemp("robot")) as processes:
        yield processes


def _enable(arm: Processes) -> None:
    arm.client.disable()
    eventually(lambda: arm.mode() in ("off", "fault"))
    arm.client.reset()
    eventually(lambda: _takes_enable(arm))
    eventually(lambda: arm.mode() == "hold")


def _takes_enable(arm: Processes) -> bool:
    """A drive needs a moment to leave its fault."""
    try:
        arm.client.enable()
    except CommandRefused:
        return False
    return True


def _follow(arm: Processes, values: np.ndarray, until: Any) -> None:
    def command() -> bool:
        sample = arm.client.next_sample()
        assert sample is not None
        arm.client.command("muscle_length", values, sample)
        return bool(until())

    eventually(command)


@pytest.mark.long
def test_every_cycle_is_published_with_age_and_validity(arm: Processes) -> None:
    samples = [arm.client.next_sample() for _ in range(20)]
    assert all(sample is not None for sample in samples)
    first, last = samples[0], samples[-1]
    assert first is not None
    assert last is not None
    assert last.cycle - first.cycle == last.seq - first.seq >= 19
    assert last.source == "simulated"
    assert last.values["joint_position"] == pytest.approx([0.3], abs=0.01)
    assert all((age >= 0).all() and (age < 0.02).all() for age in last.age.values())
    assert {name: value.shape for name, value in last.values.items()} == {
        "joint_position": (1,),
        "muscle_tension": (2,),
        "muscle_length": (2,),
    }


@pytest.mark.long
def test_status_and_description_tell_what_runs(arm: Processes) -> None:
    def is_well() -> bool:
        status = arm.client.status("hal", timeout=10.0)
        return status is not None and (status.state, status.text) == ("running", "")

    eventually(is_well)  # a busy machine is late at times, and says so for a moment
    status = arm.client.status("hal", timeout=10.0)
    assert status is not None
    assert status.loops["hal"]["rate_wanted"] == 200.0
    assert {name: bus["state"] for name, bus in status.facts["buses"].items()} == {"can0": "ok", "can1": "ok"}
    who = arm.client.describe("hal")
    assert who["pid"] == arm.pid("hal")
    assert who["signals"]["muscle_length"] == {"unit": "m", "elements": ["biceps", "triceps"], "source": "hal"}
    assert arm.client.alive() == {"hal", "simulator"}


def test_a_commanded_muscle_moves_and_a_silent_client_is_not_followed(arm: Processes) -> None:
    _enable(arm)
    goal = np.array([0.01, -0.01])

    def arrived() -> bool:
        sample = arm.client.sample()
        return sample is not None and np.allclose(sample.values["muscle_length"], goal, atol=1e-3)

    _follow(arm, goal, arrived)
    applied = arm.client.applied()
    assert applied is not None
    assert (applied.mode, applied.sender) == ("follow", arm.client.boot)
    eventually(lambda: arm.mode() == "hold")
    applied = arm.client.applied()
    assert applied is not None
    assert applied.sender == 0
    assert applied.values == pytest.approx(goal)
    eventually(lambda: arm.mode() == "off")


_COMMANDER = """
import sys, numpy as np
from services.client import Client
with Client(sys.argv[1]) as client:
    client.next_sample()
    print("ready", flush=True)
    while client.applied(timeout=1.0).mode != "hold":
        pass
    while True:
        sample = client.next_sample()
        if sample: client.command("muscle_length", np.zeros(2), sample)
"""


@pytest.mark.long
def test_a_killed_commander_is_followed_no_longer_than_its_time_to_live(arm: Processes) -> None:
    commander = subprocess.Popen([sys.executable, "-c", _COMMANDER, arm.robot], stdout=subprocess.PIPE, text=True)
    assert commander.stdout is not None
    commander.stdout.readline()
    _enable(arm)
    eventually(lambda: arm.mode() == "follow")
    commander.kill()
    commander.wait()
    eventually(lambda: arm.mode() == "hold")
    eventually(lambda: arm.mode() == "off")


@pytest.mark.long
def test_bad_commands_are_counted_and_move_nothing(arm: Processes) -> None:
    before = arm.refused()
    _enable(arm)
    sample = arm.client.next_sample()
    assert sample is not None
    wrong = bad_commands(sample)
    for data, _, _ in wrong.values():
        arm.client.session.put(keys.command(arm.robot), data)
        arm.client.next_sample()
    counted = Counter(counter for _, counter, _ in wrong.values())

    def all_counted() -> bool:
        now = arm.refused()
        return all(now[counter] - before[counter] == times for counter, times in counted.items())

    eventually(all_counted)
    assert arm.refused()["accepted"] == before["accepted"]
    status = arm.client.status("hal")
    assert status is not None
    assert status.text == status.facts["commands"]["text"] != ""
    now = arm.client.sample()
    assert now is not None
    assert now.values["muscle_length"] == pytest.approx(sample.values["muscle_length"], abs=1e-3)


def test_commands_while_off_are_refused(arm: Processes) -> None:
    arm.client.disable()
    eventually(lambda: arm.mode() == "off")
    before = arm.refused()["refused"]
    _follow(arm, np.zeros(2), lambda: arm.refused()["refused"] > before)
    assert "mode 'off'" in arm.refused()["text"]


@pytest.mark.long
def test_a_sensor_is_tared_while_the_robot_is_off_and_only_then(arm: Processes) -> None:
    cell = next(name for name in arm.client.describe("hal")["devices"] if name.endswith("_cell"))

    def tared() -> int:
        return int(arm.client.status("hal").facts["devices"][cell]["counters"]["tared"])

    arm.client.disable()
    eventually(lambda: arm.mode() == "off")
    before = tared()
    arm.client.tare(cell)
    eventually(lambda: tared() == before + 1)
    _enable(arm)
    with pytest.raises(CommandRefused):
        arm.client.tare(cell)


def test_reset_of_an_enabled_robot_comes_back_as_what_it_was(arm: Processes) -> None:
    _enable(arm)
    with pytest.raises(CommandRefused):
        arm.client.reset()
    arm.client.disable()


def test_a_second_hal_is_refused_in_one_sentence(arm: Processes) -> None:
    second = arm.popen("hal")
    said = second.communicate(timeout=30.0)[1].strip()
    assert second.returncode == 1
    assert said == (
        f"Robot '{arm.robot}' already has a 'hal' service: process {arm.pid('hal')} on this machine. "
        "Stop that one first."
    )
    assert arm.all_valid()


def test_a_silent_sensor_becomes_invalid_and_the_rest_goes_on(arm: Processes) -> None:
    assert "elbow_encoder" in arm.client.fault("sensor_silent elbow_encoder")["text"]

    def elbow_invalid() -> bool:
        sample = arm.client.sample()
        return sample is not None and not sample.valid["joint_position"].any()

    eventually(elbow_invalid)
    sample = arm.client.sample()
    assert sample is not None
    assert np.isnan(sample.values["joint_position"]).all()
    assert sample.valid["muscle_length"].all()
    arm.client.fault("node_reboot elbow_encoder")
    eventually(arm.all_valid)


def test_an_unknown_fault_lists_the_known_ones(arm: Processes) -> None:
    with pytest.raises(RemoteError, match="sensor_silent NODE"):
        arm.client.fault("meteor")
    with pytest.raises(messages.MessageError, match=r"takes \{text"):
        arm.client.ask("simulator", "fault", {"txet": 1})


def test_truth_comes_from_the_simulator(arm: Processes) -> None:
    truth = arm.client.truth(timeout=10.0)
    assert truth is not None
    assert truth.source == "truth"
    assert truth.values["joint_position"].tolist() == [0.3]


@pytest.mark.long
def test_a_killed_hal_is_missed_at_once_and_comes_back_disabled(arm: Processes) -> None:
    _enable(arm)
    before = arm.client.next_sample()
    assert before is not None
    arm.kill("hal")
    time.sleep(0.3)
    assert arm.client.sample() is None
    assert "hal" not in arm.client.alive()
    arm.start("hal")
    eventually(arm.all_valid)
    after = arm.client.next_sample()
    assert after is not None
    assert after.boot != before.boot
    assert arm.mode() == "off"


@pytest.mark.long
def test_a_killed_simulator_makes_all_invalid_and_comes_back_without_a_restart_of_the_hal(arm: Processes) -> None:
    _enable(arm)
    boot = arm.client.describe("hal")["boot"]
    arm.kill("simulator")

    def nothing_valid() -> bool:
        sample = arm.client.sample()
        return sample is not None and not any(valid.any() for valid in sample.valid.values())

    eventually(nothing_valid)
    eventually(lambda: arm.mode() in ("fault", "off"))
    arm.start("simulator")
    eventually(arm.all_valid)
    assert arm.mode() in ("fault", "off")
    assert arm.client.describe("hal")["boot"] == boot
    _enable(arm)
    arm.client.disable()


@pytest.mark.long
def test_a_hal_that_is_told_to_end_lets_the_drives_go_first(arm: Processes) -> None:
    """Were the drives only left alone, they would fault, and not take `enable` from the next HAL."""
    _enable(arm)
    code, said = arm.terminate("hal")
    assert code == 0
    assert "Traceback" not in said
    assert "hal" not in arm.client.alive()
    arm.start("hal")
    eventually(arm.all_valid)
    arm.client.enable()
    eventually(lambda: arm.mode() == "hold")
    arm.client.disable()


@pytest.mark.long
def test_a_simulator_that_is_told_to_end_does(arm: Processes) -> None:
    code, said = arm.terminate("simulator")
    assert code == 0
    assert "Traceback" not in said
    arm.start("simulator")
    eventually(arm.all_valid)


def test_a_simulator_that_is_not_there_is_told(arm: Processes) -> None:
    config = load_robot(arm.file)
    with pytest.raises(ConfigError, match=r"has no variant 'broken'\. Known variants: plain"):
        run_simulator(config, "broken", stop=threading.Event())
    with pytest.raises(ConfigError, match="names no simulator; add `simulator: module:name`"):
        run_simulator(config.model_copy(update={"simulator": None}), "plain", stop=threading.Event())


@pytest.mark.long
def test_run_until_told_from_a_thread(robot: str, tmp_path: Path) -> None:
    """Without signals, as the demo and the tests use it: a HAL whose nodes are not there runs, degraded."""
    lonely = Processes(robot, tmp_path)
    stop, codes = threading.Event(), []
    thread = threading.Thread(target=lambda: codes.append(run_hal(load_robot(lonely.file), stop=stop)))
    thread.start()
    with lonely.client as client:
        sample = client.sample(timeout=20.0)
        assert sample is not None
        assert not any(valid.any() for valid in sample.valid.values())
        eventually(lambda: (status := client.status("hal")) is not None and status.state == "degraded")
    stop.set()
    thread.join()
    assert codes == [0]
