"""`gemuco init` of a folder or a bus: the drafted robot file has the devices that are there, and runs on the bench."""

from pathlib import Path

import can
import numpy as np
import pytest
import yaml
from on_bench import arrives, cycle_until, running, states, virtual
from test_bench_dbc import SENSOR, SERVO
from test_bench_devices import DRIVE, UNSTATED, with_lines, without_defaults

from hal.config import BusConfig, load_robot
from hal.errors import ConfigError
from hal.finding.draft.draft import Draft, draft_bus, draft_folder
from hal.finding.draft.parts import Names
from hal.finding.scan import scan
from hal.finding.tap import Tap
from services.model.model_config import collect_config
from simulators.robots.bench import simulator

SHIPPED = Path(__file__).parents[2] / "robots"
ENCODER = (SHIPPED / "eds" / "joint_encoder.eds").read_text()


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Return a folder of vendors' files, one of them in a folder of its own."""
    folder = tmp_path / "vendors"
    (folder / "acme").mkdir(parents=True)
    modes = without_defaults(DRIVE, *UNSTATED[:-1]).replace("DefaultValue=993", "DefaultValue=0x21")
    (folder / "acme" / "Acme-Drive 3.EDS").write_text(modes)
    commissioned = "[DeviceComissioning]\nNodeID=9\n"
    (folder / "encoder.dcf").write_text(ENCODER + commissioned)
    (folder / "cells.dbc").write_text(SENSOR)
    return folder


def written(draft: Draft, folder: Path) -> Path:
    for place, path in draft.copies.items():
        (folder / place).parent.mkdir(parents=True, exist_ok=True)
        (folder / place).write_bytes(path.read_bytes())
    file = folder / f"{draft.robot}.yaml"
    file.write_text(draft.text)
    return file


def body_of(file: Path) -> dict:
    return yaml.safe_load(file.read_text()) | {"folder": file.parent}


def test_a_folder_becomes_devices_with_what_the_files_state(folder: Path, tmp_path: Path) -> None:
    draft = draft_folder(folder, "arm", tmp_path, SHIPPED)
    robot = load_robot(written(draft, tmp_path))
    drive, encoder, cell = (robot.devices[name] for name in ("acme_drive_3", "encoder", "cell"))
    assert robot.kinds["acme_drive_3"].settings["mode"] == "profile_position"
    assert robot.kinds["acme_drive_3"].settings["eds"] == "vendors/acme/Acme-Drive 3.EDS"
    assert drive.elements == {
        quantity: f"motor_{quantity}.acme_drive_3" for quantity in ("position", "effort", "velocity")
    }
    assert encoder.element == "joint_position.encoder"
    assert (drive.node, encoder.node) == (1, 9)
    assert cell.elements == {"force": "force.cell_force", "heat": "temperature.cell_heat", "angle": "angle.cell_angle"}
    settings = robot.kinds["cell"].settings
    assert settings["quantities"]["angle"]["scale"] == pytest.approx(np.pi / 180)
    assert settings["periods"] == {"Load": 0.1, "Pages": 0.1}
    assert "# set: counts_per_turn, gear" in draft.text or "# set: gear" in draft.text
    assert "# set: period of Load, Pages" in draft.text
    assert not draft.copies
    assert collect_config(robot).samples == 2000


def test_a_drive_that_cannot_watch_the_hal_has_a_line_to_set(folder: Path, tmp_path: Path) -> None:
    files = tmp_path / "files"
    files.mkdir()
    (files / "plain.eds").write_text(DRIVE.replace("[1016", "[2016"))
    draft = draft_folder(files, "arm", tmp_path, SHIPPED)
    assert draft.summary == "devices: 1, of them drives: 1, elements: 3; lines to set: 2."
    assert "allow_no_watchdog: true (without 1016h it goes on when the HAL is gone)" in draft.text
    assert "allow_no_watchdog: true (" not in draft_folder(folder, "arm", tmp_path, SHIPPED).text


@pytest.mark.parametrize(
    ("modes", "sections", "mode"),
    [
        ("0x3E1", (), "csp"),
        ("0x62", (), "ip"),  # velocity, homing, interpolated position, as Schunk's modules
        ("0x21", (), "profile_position"),
        ("", ("607A",), "ip"),  # unstated, and no PDO can carry the other target
    ],
)
def test_a_drive_is_drafted_in_a_mode_that_it_has(
    tmp_path: Path, modes: str, sections: tuple[str, ...], mode: str
) -> None:
    text = with_lines(DRIVE, "6502", DefaultValue=modes)
    for section in sections:
        text = with_lines(text, section, PDOMapping="0")
    (tmp_path / "files").mkdir()
    (tmp_path / "files" / "drive.eds").write_text(text)
    file = written(draft_folder(tmp_path / "files", "arm", tmp_path, SHIPPED), tmp_path)
    assert load_robot(file).kinds["drive"].settings["mode"] == mode


@pytest.mark.long
def test_a_drafted_folder_runs_on_the_bench(folder: Path, tmp_path: Path) -> None:
    body = body_of(written(draft_folder(folder, "arm", tmp_path, SHIPPED), tmp_path))
    body["signals"]["joint_position"]["plausible"] = {"frozen_after": 1000.0}  # on this bench it follows no drive
    with running(virtual(body)) as (robot, rig):
        rig.fault("set force.cell_force 17")
        cycle_until(robot, arrives("motor_position", np.array([0.1])), np.array([0.1]))
        cycle_until(robot, arrives("force", np.array([17.0]), 0.02))
        cycle_until(robot, lambda sample: np.isfinite(sample.values["joint_position"]).all())


@pytest.mark.parametrize(
    ("gone", "quantities", "to_set"),
    [
        ((), ["position", "effort", "velocity"], "rated_torque if object 6076h is not in mN m"),
        (("6076",), ["position", "effort", "velocity"], ", rated_torque\n"),
        (("606C",), ["position", "effort"], "rated_torque if"),
        (("6077",), ["position"], "gear\n"),
    ],
)
def test_a_drive_measures_what_its_data_sheet_can_send(
    tmp_path: Path, gone: tuple[str, ...], quantities: list[str], to_set: str
) -> None:
    (tmp_path / "files").mkdir()
    text = DRIVE
    for index in gone:
        text = text.replace(f"[{index}]", f"[{int(index, 16) - 0x4000:04X}]").replace(f"=0x{index}", "=0x2FFF")
    (tmp_path / "files" / "drive.eds").write_text(text)
    draft = draft_folder(tmp_path / "files", "arm", tmp_path, SHIPPED)
    config = virtual(body_of(written(draft, tmp_path)))
    device = config.devices["drive"]
    assert [served.partition("_")[2].partition(".")[0] for served in device.served] == quantities
    assert to_set in draft.text
    assert ("rated_torque" in config.kinds["drive"].settings) == ("6076" in gone)
    with running(config) as (robot, _):
        assert states(robot) == {"drive": "ready"}


def test_files_without_a_drive_have_one_that_stands_in(tmp_path: Path) -> None:
    (tmp_path / "files").mkdir()
    (tmp_path / "files" / "unit.dbc").write_text(
        'VERSION ""\nBU_: X\nBO_ 5 Out: 8 Vector__XXX\n SG_ Pull : 0|16@1+ (1,0) [0|0] "" X\n'
        ' SG_ Counter : 16|8@1+ (1,0) [0|0] "" X\n SG_ Rate : 24|16@1+ (1,0) [0|0] "furlong" X\n'
    )
    draft = draft_folder(tmp_path / "files", "cells", tmp_path, SHIPPED)
    robot = load_robot(written(draft, tmp_path))
    assert list(draft.copies) == ["eds/servo_drive.eds"]
    assert robot.signals["value"].elements == ("unit_pull", "unit_rate")
    assert robot.command.signal == "joint_position"
    assert any("'stand_in' takes its place" in note for note in draft.notes)
    assert any("Pull, Rate have no unit that is known" in note for note in draft.notes)


def test_a_data_sheet_that_an_earlier_draft_copied_is_no_device(tmp_path: Path) -> None:
    (tmp_path / "cells.dbc").write_text(SENSOR)
    first = draft_folder(tmp_path, "cells", tmp_path, SHIPPED)
    written(first, tmp_path)
    sheet = tmp_path / "eds" / "servo_drive.eds"
    assert sheet.exists(), "a drive stands in for one"
    again = draft_folder(tmp_path, "cells", tmp_path, SHIPPED)
    assert load_robot(written(again, tmp_path)) == load_robot(written(first, tmp_path))
    assert any("'eds/servo_drive.eds' was copied there by an earlier draft" in note for note in again.notes)
    sheet.write_text(sheet.read_text() + "\n")
    other = draft_folder(tmp_path, "cells", tmp_path, SHIPPED)
    assert "stand_in" not in other.text, "a file with another content is the user's"


def test_data_sheets_of_this_package_that_the_user_names_are_devices(tmp_path: Path) -> None:
    (tmp_path / "eds").mkdir()
    (tmp_path / "eds" / "servo_drive.eds").write_bytes((SHIPPED / "eds" / "servo_drive.eds").read_bytes())
    for name in ("first", "second"):
        draft = draft_folder(tmp_path / "eds", name, tmp_path, SHIPPED)
        assert list(load_robot(written(draft, tmp_path)).devices) == ["servo_drive"]
        assert "stand_in" not in draft.text and not any("earlier draft" in note for note in draft.notes)


def test_a_drive_keeps_off_the_identifiers_of_a_dbc_file(tmp_path: Path) -> None:
    """Node 1 would send 081h, 181h and 581h, which are messages of the file."""
    (tmp_path / "files").mkdir()
    (tmp_path / "files" / "drive.eds").write_text(DRIVE)
    messages = [f'BO_ {number} M{number}: 8 X\n SG_ S{number} : 0|16@1+ (1,0) [0|0] "V" X\n'
                for number in (0x81, 0x182, 0x583)]  # fmt: skip
    (tmp_path / "files" / "unit.dbc").write_text('VERSION ""\nBU_: X\n' + "".join(messages))
    file = written(draft_folder(tmp_path / "files", "cells", tmp_path, SHIPPED), tmp_path)
    assert load_robot(file).devices["drive"].node == 4
    with running(virtual(body_of(file))) as (robot, _):
        assert set(states(robot)) == {"drive", "unit"}


def test_a_node_id_that_a_dcf_file_states_is_kept_beside_a_dbc_file(folder: Path, tmp_path: Path) -> None:
    (folder / "unit.dbc").write_text(
        'VERSION ""\nBU_: X\nBO_ 393 Out: 8 X\n SG_ Pull : 0|16@1+ (1,0) [0|0] "V" X\n'  # 189h, as node 9 sends
    )
    robot = load_robot(written(draft_folder(folder, "arm", tmp_path, SHIPPED), tmp_path))
    assert robot.devices["encoder"].node == 9


def test_contradictory_messages_are_left_out_and_said(tmp_path: Path) -> None:
    (tmp_path / "files").mkdir()
    (tmp_path / "files" / "unit.dbc").write_text(
        'VERSION ""\nBU_: X\nBO_ 5 Right: 8 X\n SG_ Pull : 0|16@1+ (1,0) [0|0] "V" X\n'
        'BO_ 6 Twice: 8 X\n SG_ A : 0|16@1+ (1,0) [0|0] "V" X\n SG_ B : 8|16@1+ (1,0) [0|0] "V" X\n'
        'BO_ 7 Long: 1 X\n SG_ C : 0|16@1+ (1,0) [0|0] "V" X\n'
    )
    draft = draft_folder(tmp_path / "files", "cells", tmp_path, SHIPPED)
    assert load_robot(written(draft, tmp_path)).signals["voltage"].elements == ("unit_pull",)
    assert any(note.startswith("'unit.dbc': Twice, Long left out") and "overlapping" in note for note in draft.notes)


def test_a_drive_with_fixed_pdos_measures_what_these_carry(tmp_path: Path) -> None:
    """Its RPDO has the mode of operation too, which the driver may send."""
    fixed = {"1600": (0x60400010, 0x60600008, 0x607A0020), "1A00": (0x60410010, 0x60640020, 0x60770010)}
    text = DRIVE
    for index in (*(f"160{n}" for n in range(4)), *(f"1A0{n}" for n in range(4))):
        entries = fixed.get(index, ())
        for place, value in enumerate((len(entries), *entries, *(0,) * (8 - len(entries)))):
            text = with_lines(text, f"{index}sub{place:X}", AccessType="ro", DefaultValue=str(value))
    (tmp_path / "files").mkdir()
    (tmp_path / "files" / "drive.eds").write_text(text)
    file = written(draft_folder(tmp_path / "files", "arm", tmp_path, SHIPPED), tmp_path)
    assert set(load_robot(file).devices["drive"].elements) == {"position", "effort"}
    with running(virtual(body_of(file))) as (robot, _):
        assert states(robot) == {"drive": "ready"}


def dbc_of(*messages: tuple[int, str], size: int = 8, sender: str = "X") -> str:
    """Return a DBC file of messages with one signal each."""
    lines = (f'BO_ {number} {name}: {size} {sender}\n SG_ {name} : 0|16@1+ (0.01,0) [0|600] "N" X\n'
             for number, name in messages)  # fmt: skip
    return f'VERSION ""\nBU_: {sender}\n' + "".join(lines)


def test_files_whose_identifiers_collide_are_on_buses_of_their_own(tmp_path: Path) -> None:
    files = tmp_path / "files"
    files.mkdir()
    (files / "a_drive.dcf").write_text(DRIVE + "[DeviceComissioning]\nNodeID=1\n")
    (files / "b_first.dbc").write_text(dbc_of((0x311, "Pull")))
    (files / "c_second.dbc").write_text(dbc_of((0x311, "Push")))
    (files / "d_third.dbc").write_text(dbc_of((0x302, "Press"), (0x303, "Lift")))
    (files / "e_drive.dbc").write_text(dbc_of((0x181, "Bend")))  # as the drive's first TPDO
    (files / "f_sync.dbc").write_text(dbc_of((0x080, "Tear")))
    draft = draft_folder(files, "cells", tmp_path, SHIPPED)
    config = virtual(body_of(written(draft, tmp_path)))
    buses = {name: device.bus for name, device in config.devices.items()}
    others = {"c_second": "can1", "e_drive": "can1", "f_sync": "can1"}
    assert buses == {"a_drive": "can0", "b_first": "can0", "d_third": "can0", **others}
    assert sum("so it is on another bus" in note for note in draft.notes) == 3
    with running(config) as (robot, _):
        assert set(states(robot)) == set(buses)


def test_a_bus_with_messages_of_can_fd_has_a_bit_rate_of_their_data_to_be_set(tmp_path: Path) -> None:
    """What does not fit into a frame of CAN FD either is left out."""
    (tmp_path / "files").mkdir()
    messages = [dbc_of((5, "Long"), size=60), dbc_of((6, "Short")), dbc_of((7, "Endless"), size=65)]
    text = messages[0] + "".join(message.partition("X\n")[2] for message in messages[1:])
    (tmp_path / "files" / "fd.dbc").write_text(text)
    (tmp_path / "files" / "classic.dbc").write_text(dbc_of((6, "Other")))  # on a bus of its own
    draft = draft_folder(tmp_path / "files", "cells", tmp_path, SHIPPED)
    config = virtual(body_of(written(draft, tmp_path)))
    assert set(config.signals["force"].elements) == {"classic_other", "fd_long", "fd_short"}
    assert {name: bus.data_bitrate for name, bus in config.buses.items()} == {"can0": None, "can1": 2_000_000}
    assert any("Endless left out" in note and "at most 64" in note for note in draft.notes)
    assert "fd.dbc: frames of CAN FD. Set data_bitrate to the bit rate of their data." in draft.notes
    with running(config) as (robot, _):
        cycle_until(robot, lambda one: np.isfinite(one.values["force"]).all())


def test_a_file_of_a_whole_car_gives_some_signals_of_every_node(tmp_path: Path) -> None:
    (tmp_path / "files").mkdir()
    nodes = [dbc_of(*((16 * node + number, f"F{node}_{number}") for number in range(9)), sender=f"Node{node:02d}")
             for node in range(12)]  # fmt: skip
    text = 'VERSION ""\nBU_: ' + " ".join(f"Node{node:02d}" for node in range(12)) + "\n"
    text += "".join(node.split("\n", 2)[2] for node in nodes)
    (tmp_path / "files" / "car.dbc").write_text(text)
    draft = draft_folder(tmp_path / "files", "car", tmp_path, SHIPPED)
    robot = load_robot(written(draft, tmp_path))
    assert [len(robot.devices[f"node{node:02d}"].served) for node in range(12)] == [5] * 12
    assert "'car.dbc': 48 of 108 signals left out; add those you need." in draft.notes


def test_messages_of_the_host_are_left_out_and_said(tmp_path: Path) -> None:
    (tmp_path / "files").mkdir()
    (tmp_path / "files" / "servo.dbc").write_text(SERVO.replace("Demand: 4", "SetDemand: 4"))
    draft = draft_folder(tmp_path / "files", "servo", tmp_path, SHIPPED)
    assert any("the host sends SetDemand, Order. If a node is a servo" in note for note in draft.notes)
    assert set(load_robot(written(draft, tmp_path)).kinds["drive"].settings["periods"]) == {"Status"}


@pytest.mark.parametrize(
    ("files", "words"),
    [
        ({}, "has no EDS, DCF or DBC file. Give the folder with the files of your devices"),
        ({"a.eds": "hello"}, "None of 1 files in"),
        ({"a.eds": without_defaults(DRIVE, "1000", value="DefaultValue=0x195\n")}, "has device profile 405"),
        ({"a.dbc": 'VERSION ""\nBU_: X\n'}, "has a measured value"),
        ({"a.dbc": "nonsense"}, "is not a DBC file that cantools can read"),
    ],
)
def test_a_folder_of_which_nothing_can_be_used_is_refused(tmp_path: Path, files: dict[str, str], words: str) -> None:
    for name, text in files.items():
        (tmp_path / name).write_text(text)
    with pytest.raises(ConfigError) as caught:
        draft_folder(tmp_path, "none", tmp_path, SHIPPED)
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.long
def test_a_bus_becomes_the_devices_that_answer(folder: Path, tmp_path: Path) -> None:
    (folder / "axis.dbc").write_text((SHIPPED / "dbc" / "odrive_cansimple.dbc").read_text())
    file = written(draft_folder(folder, "arm", tmp_path, SHIPPED), tmp_path)
    config = virtual(body_of(file))
    channel = config.buses["can0"].channel
    rig = simulator.rig(config, "bench", 0)
    rig.start()
    try:
        with Tap("can0", BusConfig(interface="virtual", channel=channel)) as tap:
            result = scan(tap, listen=1.0)
    finally:
        rig.stop()
    draft = draft_bus(
        result,
        "interface: socketcan, channel: can0",
        BusConfig(channel="can0", bitrate=500_000),
        folder,
        "again",
        tmp_path,
        SHIPPED,
    )
    robot = load_robot(written(draft, tmp_path))
    nodes = {name: (robot.kinds[device.kind].driver, device.node) for name, device in robot.devices.items()}
    assert nodes.pop("cell")[0] == "dbc"
    assert nodes == {"drive_1": ("cia402", 1), "encoder_9": ("cia406", 9), "axis_3": ("odrive", 3)}
    assert robot.kinds["drive_1"].settings["eds"] == "vendors/acme/Acme-Drive 3.EDS"
    assert robot.kinds["cell"].settings["periods"]["Load"] == pytest.approx(0.1, rel=0.3)
    assert robot.buses["can0"].bitrate == 500_000


def test_a_silent_bus_is_refused(tmp_path: Path) -> None:
    config = BusConfig(interface="virtual", channel="nothing_here")
    with can.Bus(interface="virtual", channel="nothing_here"), Tap("can0", config) as tap:
        result = scan(tap, listen=0.05, ask=False)
    with pytest.raises(
        ConfigError, match=r"No node on can0 has a driver \(0 nodes, 0 other identifiers\)\. Are they.*Only listened"
    ):
        draft_bus(result, "", BusConfig(channel="can0"), None, "none", tmp_path, SHIPPED)


def test_a_name_is_a_text_in_yaml() -> None:
    names = Names()
    assert [names.new(text) for text in ("On", "8 a", "PanAxis", "Pan axis")] == [
        "node_on",
        "node_8_a",
        "pan_axis",
        "pan_axis_2",
    ]
