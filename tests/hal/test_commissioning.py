"""What the nodes are told before they are used, and what is said when they are not what they should be."""

import math
from dataclasses import replace

import pytest
from hal_bench import DRIVE, Bench, description, hardware
from puppet import Puppet, driven

from hal.config import RobotConfig
from hal.drivers.canopen.cia406 import Cia406Encoder
from hal.errors import DeviceRefused
from simulators.nodes.canopen.spec import EncoderConstants


def test_nodes_are_configured_as_the_contract_says(bench):
    drive, cell, encoder = (
        bench.rig.node(f"{name}").objects.values for name in ("biceps_drive", "biceps_cell", "elbow_encoder")
    )
    assert [drive[0x1600, sub] for sub in range(3)] == [2, 0x60400010, 0x607A0020]
    assert [drive[0x1A00, sub] for sub in range(3)] == [2, 0x60410010, 0x60640020]
    assert [cell[0x1A00, sub] for sub in range(3)] == [2, 0x91300120, 0x61500108]
    assert [encoder[0x1A00, sub] for sub in range(4)] == [3, 0x60040020, 0x65030010, 0x65050010]
    assert drive[0x1400, 1] == 0x201
    assert drive[0x1800, 1] & 0x800007FF == 0x181
    assert drive[0x1800, 2] == cell[0x1800, 2] == encoder[0x1800, 2] == 1
    assert drive[0x1017, 0] == cell[0x1017, 0] == encoder[0x1017, 0] == 100
    assert drive[0x1016, 1] == 0x007F0096
    assert cell[0x1016, 1] == 0
    assert drive[0x6060, 0] == 8
    assert drive[0x6007, 0] == 3
    assert all(state == "operational" for state in bench.rig.stats()["nodes"].values())


def opened(**how):
    bench = Bench(**how)
    bench.open()
    bench.cycle(2)
    return bench


@pytest.fixture
def close_after():
    benches = []
    yield lambda bench: benches.append(bench) or bench
    for bench in benches:
        bench.close()


def swapped():
    nodes = hardware()
    nodes[2] = replace(nodes[2], element="joint_position.elbow", constants=EncoderConstants())
    return nodes


def test_another_device_at_the_address_is_told(close_after):
    bench = close_after(opened(nodes=swapped()))
    reason = "has device profile 406, not 404. Are two node ids swapped?"
    bench.until(
        lambda: reason in bench.device("biceps_cell")["text"], "on a busy machine a node may not answer at once"
    )
    assert bench.device("biceps_cell")["state"] == "opening"
    assert bench.sample.valid["muscle_tension"].tolist() == [False, True]


def test_another_makers_device_is_told(close_after, tmp_path):
    text = (description()["folder"] / "eds" / "load_cell.eds").read_text()
    other = tmp_path / "other.eds"
    other.write_text(text.replace("DefaultValue=1195724117", "DefaultValue=7").replace("0x47454D55", "0x7"))
    assert other.read_text() != text
    body = description()
    body["kinds"]["cell"]["settings"]["eds"] = str(other)
    bench = close_after(opened(config=RobotConfig.model_validate(body)))
    bench.until(lambda: "its EDS file says 7h" in bench.device("biceps_cell")["text"], "the other maker")


def test_a_setting_that_the_drive_refuses_is_told(close_after):
    body = description()
    body["kinds"]["encoder"]["settings"]["counts_per_turn"] = 262144
    body["kinds"]["drive"]["settings"] = {**DRIVE, "max_torque": 1000}
    bench = close_after(opened(config=RobotConfig.model_validate(body)))
    assert bench.rig.node("biceps_drive").objects.values[0x6072, 0] == 1000
    assert bench.states() == {"ready"}


def test_the_cells_own_digits_are_used(close_after):
    nodes = hardware()
    nodes[2] = replace(nodes[2], constants=replace(nodes[2].constants, decimal_digits=0))
    bench = close_after(opened(nodes=nodes))
    assert bench.sample.values["muscle_tension"][0] == pytest.approx(20.0, abs=0.5)
    assert bench.sample.values["muscle_tension"][1] == pytest.approx(30.0, abs=0.005)


class Misread(Puppet):
    """Its first answer on each of some objects has a wrong byte."""

    wrong: frozenset[str] = frozenset({"6501:0", "6502:0"})
    is_hopeless = False

    def _answer(self, request):
        answer = super()._answer(request)
        place = request[1:4]
        key = f"{place[1]:02X}{place[0]:02X}:{place[2]}"
        if request[0] == 0x40 and key in self.wrong:
            self.wrong = self.wrong if self.is_hopeless else self.wrong - {key}
            self.count = getattr(self, "count", 0) + 1
            return answer[:4] + bytes([answer[4] ^ self.count % 256]) + answer[5:]
        return answer


ENCODER = {
    "6000:0": "00 00", "6031:3": "01 00", "6031:4": "01 00", "6501:0": "00 00 04 00", "6502:0": "01 00",
}  # fmt: skip


@pytest.mark.parametrize("is_hopeless", [False, True])
def test_one_wrong_byte_while_it_is_opened_does_not_make_another_scale(monkeypatch, is_hopeless):
    monkeypatch.setattr("puppet.Puppet", Misread)
    monkeypatch.setattr(Misread, "is_hopeless", is_hopeless)
    settings = {"eds": "eds/joint_encoder.eds"}
    with driven(Cia406Encoder, {"position": "joint.one"}, settings, dict(ENCODER), is_open=False) as (device, _):
        if is_hopeless:
            with pytest.raises(DeviceRefused, match="6501h:0 reads differently each time"):
                device._calibrate()
        else:
            device._calibrate()
            assert device._scale == pytest.approx(2 * math.pi / 262144)
