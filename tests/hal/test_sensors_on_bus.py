"""Sensors and the robot: several channels, analogue inputs, tare, what is frozen, what an encoder's turns are."""

import math

import numpy as np
import pytest
from hal_bench import Bench, description, hardware

from hal.config import RobotConfig
from hal.errors import CommandRefused
from simulators.nodes.canopen.analog_input import AnalogConstants
from simulators.nodes.canopen.spec import CellConstants, EncoderConstants, NodeSpec

BICEPS, TRICEPS, ELBOW = "muscle_tension.biceps", "muscle_tension.triceps", "joint_position.elbow"


def sensing(kind, device, constants, **more):
    """The bench with one device in place of the two cells, on can0 as node 11."""
    body = description(**more)
    body["kinds"]["cells"] = kind
    body["signals"]["muscle_tension"]["plausible"] = {"low": -600, "rate": np.inf}  # set by the tests in no time
    for name in ("biceps_cell", "triceps_cell"):
        del body["devices"][name]
    body["devices"]["cells"] = {"kind": "cells", "bus": "can0", "node": 11, **device}
    nodes = [node for node in hardware() if not node.name.endswith("_cell")]
    nodes.append(NodeSpec("cells", "can0", 11, BICEPS, constants))
    return Bench(RobotConfig.model_validate(body), nodes=nodes)


def two_channels(driver, eds, constants, **settings):
    kind = {"driver": driver, "settings": {"eds": f"eds/{eds}.eds", "channels": [1, 2], **settings}}
    return sensing(kind, {"elements": {"force_1": BICEPS, "force_2": TRICEPS}}, constants)


@pytest.fixture
def opened():
    benches = []

    def open_(bench):
        benches.append(bench)
        return bench.open()

    yield open_
    for bench in benches:
        bench.close()


def tension(bench):
    sample, _ = bench.cycle()
    return np.where(sample.valid["muscle_tension"], sample.values["muscle_tension"], np.nan)


@pytest.mark.parametrize("preset", ["int32", "int16", "float32"])
def test_two_cells_on_one_amplifier(opened, preset):
    bench = opened(two_channels("cia404", "load_cell", CellConstants(more=(TRICEPS,)), preset=preset))
    bench.cycle(2)
    assert tension(bench) == pytest.approx([20.0, 30.0], abs=0.006)
    bench.world.tension[1] = 600.0
    assert tension(bench) == pytest.approx([20.0, math.nan], abs=0.006, nan_ok=True)
    assert "force_2: positive overload" in bench.device("cells")["text"]
    bench.world.tension[1] = -12.0
    assert tension(bench) == pytest.approx([20.0, -12.0], abs=0.006)
    assert not bench.device("cells")["text"]


@pytest.mark.parametrize(("preset", "gain"), [("counts32", 1 / 4000), ("counts16", 1 / 400)])
def test_raw_counts_and_a_gain(opened, preset, gain):
    constants = CellConstants(more=(TRICEPS,), counts_per_newton=1 / gain)
    bench = opened(two_channels("cia404", "load_cell", constants, preset=preset, gain=[gain, -gain], zero=[0.0, 1.0]))
    bench.cycle(2)
    assert tension(bench) == pytest.approx([20.0, -29.0], abs=0.003)


@pytest.mark.parametrize(("preset", "full"), [("int16", 2**15), ("int32", 2**31), ("float32", 10.0)])
def test_two_cells_behind_plain_converters(opened, preset, full):
    constants = AnalogConstants(full_scale=500.0, bits=24, more=(TRICEPS,))
    settings = {"preset": preset, "gain": 500.0 / full, "resolution": 24}
    bench = opened(two_channels("cia401", "analog_input", constants, **settings))
    bench.cycle(2)
    assert bench.rig.node("cells").objects.values[0x6423, 0]
    assert tension(bench) == pytest.approx([20.0, 30.0], abs=0.02)
    bench.world.tension[0] = 700.0
    found = tension(bench)
    if preset == "float32":
        assert found[0] == pytest.approx(500.0, abs=0.1), "ten volts are ten volts: only a status could tell"
    else:
        assert math.isnan(found[0])
    assert found[1] == pytest.approx(30.0, abs=0.02)


def test_a_makers_status_makes_a_value_bad(opened):
    constants = AnalogConstants(full_scale=500.0, more=(TRICEPS,))
    settings = {"preset": "float32", "gain": 50.0, "status": "2120h:0 uint16"}
    bench = opened(two_channels("cia401", "analog_input", constants, **settings))
    bench.cycle(2)
    assert tension(bench) == pytest.approx([20.0, 30.0], abs=0.05)
    bench.world.tension[0] = 700.0
    assert np.isnan(tension(bench)).all()
    assert "status 4h" in bench.device("cells")["text"]


def test_an_emergency_makes_every_value_bad_and_its_end_good(opened):
    bench = opened(two_channels("cia404", "load_cell", CellConstants(more=(TRICEPS,))))
    bench.cycle(2)
    bench.send("can0", 0x80 + 11, b"\x00\x50\x81\x00\x00\x00\x00\x00")
    assert np.isnan(tension(bench)).all()
    assert bench.device("cells")["state"] == "fault"
    bench.send("can0", 0x80 + 11, bytes(8))
    assert tension(bench) == pytest.approx([20.0, 30.0], abs=0.006)


def test_a_value_that_never_changes_by_a_bit_is_frozen(opened):
    bench = opened(two_channels("cia404", "load_cell", CellConstants(more=(TRICEPS,)), frozen_after=0.05))
    for cycle in range(30):
        bench.world.tension[0] = 20.0 + 0.01 * (cycle % 2)
        found = tension(bench)
    assert found == pytest.approx([20.0, math.nan], abs=0.02, nan_ok=True)
    assert "force_2: frozen" in bench.device("cells")["text"]
    bench.world.tension[1] = 30.01
    assert tension(bench)[1] == pytest.approx(30.01, abs=0.006)


@pytest.fixture
def loaded(opened):
    """Two cells that read 1.5 N too much."""
    bench = opened(two_channels("cia404", "load_cell", CellConstants(more=(TRICEPS,), unbalance=1.5)))
    bench.cycle(2)
    assert tension(bench) == pytest.approx([21.5, 31.5], abs=0.006)
    bench.world.tension[:] = 0.0
    bench.cycle(2)
    return bench


def tare(bench):
    bench.robot.tare("cells")
    bench.until(lambda: bench.device("cells")["counters"]["tared"] == 1, "tared")


def test_a_tare_takes_the_reading_as_zero(loaded):
    tare(loaded)
    loaded.cycle(2)
    assert tension(loaded) == pytest.approx([0.0, 0.0], abs=0.006)
    loaded.world.tension[:] = (50.0, 60.0)
    assert tension(loaded) == pytest.approx([50.0, 60.0], abs=0.006)


def test_a_tare_outlives_the_amplifier_s_power(loaded):
    tare(loaded)
    loaded.rig.fault("node_silent cells")
    loaded.until(lambda: loaded.device("cells")["state"] == "silent", "silent")
    loaded.rig.fault("node_back cells")
    loaded.until(lambda: loaded.sample.valid["muscle_tension"].all(), "back")
    assert tension(loaded) == pytest.approx([0.0, 0.0], abs=0.006)


def test_a_tare_that_the_amplifier_refuses_is_told(loaded):
    loaded.world.tension[:] = math.nan
    loaded.robot.tare("cells")
    loaded.until(lambda: "not tared" in loaded.device("cells")["text"], "refused")
    assert "not in this state of the device" in loaded.device("cells")["text"]
    assert loaded.device("cells")["counters"]["tared"] == 0


def test_a_tare_is_refused_while_the_robot_is_enabled(loaded):
    loaded.enable()
    with pytest.raises(CommandRefused, match="hold"):
        loaded.robot.tare("cells")
    with pytest.raises(CommandRefused, match="There is no device 'cell'"):
        loaded.robot.tare("cell")


def test_a_drive_and_an_input_have_no_tare(opened):
    bench = opened(two_channels("cia401", "analog_input", AnalogConstants(), gain=0.1))
    for name in ("biceps_drive", "cells"):
        with pytest.raises(CommandRefused, match="cannot be tared"):
            bench.robot.tare(name)


def turning(settings, constants):
    body = description()
    body["signals"]["joint_velocity"] = {"unit": "rad/s", "elements": ["elbow"]}
    body["kinds"]["encoder"] = {"driver": "cia406", "settings": {"eds": "eds/joint_encoder.eds", **settings}}
    body["devices"]["elbow_encoder"] = {
        **{key: value for key, value in body["devices"]["elbow_encoder"].items() if key != "element"},
        "elements": {"position": ELBOW, "velocity": "joint_velocity.elbow"},
    }
    nodes = [node for node in hardware() if node.name != "elbow_encoder"]
    nodes.append(NodeSpec("elbow_encoder", "can1", 21, ELBOW, constants))
    return Bench(RobotConfig.model_validate(body), nodes=nodes)


@pytest.mark.parametrize("direction", [1, -1])
@pytest.mark.parametrize("scaled_to", [None, 3600])
def test_an_encoder_of_many_turns_passes_the_end_of_its_counts(opened, direction, scaled_to):
    constants = EncoderConstants(4096, turns=16, direction=direction, zero=0.0, scaled_to=scaled_to)
    bench = opened(turning({"direction": direction, "around": 0.0}, constants))
    for angle in (-0.05, 0.0, 0.05, 7.9 * 2 * math.pi, -7.9 * 2 * math.pi):
        bench.world.angle[0] = angle
        sample, _ = bench.cycle()
        assert sample.values["joint_position"][0] == pytest.approx(angle, abs=0.004)  # two of 3600 counts


def test_an_encoder_tells_its_velocity(opened):
    constants = EncoderConstants(4096, direction=-1, zero=math.pi, speed_unit=(1, 2))
    bench = opened(turning({"direction": -1, "zero": math.pi}, constants))
    for _ in range(5):
        bench.world.angle[0] += 0.005 * 3.0
        sample, _ = bench.cycle()
    assert sample.values["joint_velocity"] == pytest.approx([3.0], abs=2 * 2 * math.pi / 4096 / 0.005)
    bench.world.angle[0] += 3.0
    sample, _ = bench.cycle()
    assert not sample.valid["joint_velocity"][0], "600 rad/s are beyond the end of sixteen bits"
    assert sample.valid["joint_position"][0]


def test_only_channels_that_the_robot_names_are_mapped(opened):
    kind = {"driver": "cia404", "settings": {"eds": "eds/load_cell.eds", "channels": [1, 2, 3]}}
    other = {"kind": "cells", "bus": "can1", "node": 12, "elements": {"force_2": TRICEPS}}
    body = description()
    body["kinds"]["cells"] = kind
    body["devices"]["triceps_cell"] = other
    nodes = [node for node in hardware() if node.name != "triceps_cell"]
    nodes.append(NodeSpec("triceps_cell", "can1", 12, BICEPS, CellConstants(more=(TRICEPS,))))
    bench = opened(Bench(RobotConfig.model_validate(body), nodes=nodes))
    bench.cycle(2)
    mapped = bench.rig.node("triceps_cell").objects.values
    assert [mapped[0x1A00, sub] for sub in range(3)] == [2, 0x91300220, 0x61500208]
    assert tension(bench) == pytest.approx([20.0, 30.0], abs=0.006)
