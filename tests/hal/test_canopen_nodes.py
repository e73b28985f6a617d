"""What is told of a CANopen node that is not what it should be: twins, no heartbeat, other layouts, wrong files."""

import re
import struct
from dataclasses import replace

import numpy as np
import pytest
from drive_bench import FIXED, NODE, RATE, SETTINGS, JointBench, refused, without
from hal_bench import ROBOTS

from hal.device import DeviceState


@pytest.fixture
def joint():
    benches = []

    def made(*args, **how):
        benches.append(JointBench(*args, **how))
        return benches[-1]

    yield made
    for bench in benches:
        bench.close()


def text(bench):
    return bench.device("elbow")["text"]


def test_a_cycle_needs_every_frame_of_it(joint):
    bench = joint("csp").open()
    assert bench.cycle(25)[0].complete
    before = bench.drive.read().received.copy()
    second = bench.node.pdos.transmit[1]
    second.type = 254
    sample, _ = bench.cycle()
    assert not sample.complete
    ages = bench.drive.read().received - before
    position, velocity = (bench.drive.measures.index(f"joint_{q}.elbow") for q in ("position", "velocity"))
    assert ages[position] > 0
    assert ages[velocity] == 0
    second.type = 1
    assert bench.cycle(2)[0].complete


def test_halves_of_two_cycles_are_not_one_answer(joint):
    bench = joint("csp").open()
    bench.cycle(3)
    pdos = bench.node.pdos.transmit
    for cycle in range(3):  # after four it is not waited for
        pdos[0].type, pdos[1].type = (1, 254) if cycle % 2 else (254, 1)
        assert not bench.cycle()[0].complete


def test_a_short_or_long_frame_is_counted_and_not_used(joint):
    bench = joint("csp").open()
    bench.cycle(3)
    before = bench.drive.read().values.copy()
    for size in (0, 1, 7):
        bench.send("can0", 0x180 + NODE, bytes(size))
    bench.send("can0", 0x280 + NODE, bytes(4))
    bench.flush()
    assert bench.device("elbow")["counters"]["malformed"] == 4
    np.testing.assert_array_equal(bench.drive.read().values, before)


@pytest.mark.parametrize(
    ("statusword", "report"), [(0x0050, "is controlled from its own panel"), (0x02D0, "warns (bit 7"), (0x0250, "")]
)
def test_bits_of_the_statusword_that_a_person_should_know(joint, statusword, report):
    bench = joint("csp", quantities=("position",)).open()
    bench.cycle(3)
    bench.rig.fault("sensor_silent elbow")
    bench.send("can0", 0x180 + NODE, struct.pack("<Hi", statusword, 0))
    bench.flush()
    assert report in text(bench) if report else not text(bench)


@pytest.mark.parametrize("timing", [{"every": 10}, {"event_time": 0.05}])
def test_a_slow_value_comes_as_often_as_it_was_asked_for(joint, timing):
    where = {"object": "2200h:1", "type": "int16", "scale": 0.1, **timing}
    bench = joint("csp", quantities=("position", "temperature"), temperature=where).open()
    bench.cycle(15)
    slot = bench.drive.measures.index("joint_temperature.elbow")
    stamps = []
    for _ in range(100):
        bench.cycle()
        stamps.append(float(bench.drive.read().received[slot]))
    assert len(set(stamps)) == pytest.approx(10, abs=1)
    assert bench.sample.complete


def test_two_nodes_that_answer_under_one_id_are_told(joint):
    bench = joint("csp", quantities=("position",)).open()
    bench.cycle(3)
    frame = struct.pack("<Hi", 0x0250, 1234)
    for _ in range(40):
        bench.cycle()
        bench.send("can0", 0x180 + NODE, frame)
        bench.flush()
        if bench.device("elbow")["state"] == "fault":
            break
    assert "answers each SYNC twice. Do two devices have this node id?" in text(bench)
    bench.cycle(20)
    assert bench.device("elbow")["state"] == "fault"
    bench.robot.reset()
    bench.cycle(20)
    assert bench.device("elbow")["state"] == "ready"


def test_a_bus_that_doubles_every_fourth_frame_makes_no_twin(joint):
    bench = joint("csp").open()
    bench.cycle(3)
    for cycle in range(200):
        bench.cycle()
        if cycle % 4 == 0:
            bench.send("can0", 0x180 + NODE, struct.pack("<Hih", 0x0250, 0, 0))
            bench.send("can0", 0x280 + NODE, struct.pack("<ii", 0, 0))
            bench.flush()
    assert bench.device("elbow")["counters"]["doubled"] == 100
    assert bench.device("elbow")["state"] == "ready"


def test_late_answers_are_no_twin(joint):
    bench = joint("csp").open()
    bench.cycle(3)
    turn = bench.clock.turn
    for cycle in range(120):
        bench.clock.turn = (lambda: None) if cycle % 2 else turn
        bench.cycle()
        turn()
    assert bench.device("elbow")["state"] == "ready"


def test_one_that_falls_behind_for_seconds_and_catches_up_at_once_is_no_twin(joint):
    bench = joint("csp", quantities=("position",)).open()
    bench.cycle(3)
    bench.rig.fault("sensor_silent elbow")

    def cycle(answers: int) -> None:
        bench.cycle()
        for _ in range(answers):
            bench.send("can0", 0x180 + NODE, struct.pack("<Hi", 0x0250, 1234))
        bench.flush()
        assert bench.device("elbow")["state"] == "ready"

    for number in range(300):
        cycle(0 if number % 12 == 0 else 1)
    for _ in range(25):
        cycle(2)
    assert bench.device("elbow")["counters"]["doubled"] == 25


def test_a_boot_up_message_while_process_data_goes_on_is_another_node(joint):
    bench = joint("csp", quantities=("position",)).open()
    bench.cycle(3)
    with bench.drive._opening:  # nobody commissions it meanwhile
        bench.send("can0", 0x700 + NODE, b"\0")
        bench.cycle(6)
    bench.until(lambda: bench.device("elbow")["state"] == "fault", "telling twins", 2000)
    assert "sent process data on after it had booted. Do two devices have this node id?" in text(bench)


def test_a_node_without_a_heartbeat_is_lost_though_it_answers(joint):
    bench = joint("csp").open()
    bench.cycle(3)
    due = bench.drive._beat_due
    while bench.drive._beat_due == due:  # it has just sent one
        bench.cycle()
    bench.objects[0x1017, 0] = 0
    with bench.drive._opening:
        passed = 0
        while bench.drive.is_commissioned and passed < 80:
            bench.cycle()
            passed += 1
        assert bench.drive.health().state is DeviceState.OPENING
        assert "goes on sending process data without a heartbeat" in bench.drive.health().text
    assert 0.25 <= passed / RATE < 0.27
    bench.until(lambda: bench.device("elbow")["state"] == "ready", "commissioning again", 2000)
    assert bench.objects[0x1017, 0] == 100


def test_process_data_that_fails_is_silence_though_the_heart_beats(joint):
    bench = joint("csp").open()
    bench.cycle(3)
    bench.rig.fault("sensor_silent elbow")
    bench.cycle(31)
    assert "has not answered for 32 cycles" in text(bench)


def test_a_node_that_came_back_is_told_everything_again_and_not_enabled(joint):
    bench = joint("csp", max_torque=700).open()
    bench.enable()
    bench.follow([0.31], 5)
    bench.rig.fault("node_reboot elbow")
    bench.cycle(3)
    assert bench.robot.mode == "fault"
    bench.until(lambda: bench.device("elbow")["state"] == "ready", "coming back", 2000)
    assert bench.objects[0x6072, 0] == 700
    assert bench.device("elbow")["counters"]["boots"] >= 1
    bench.cycle(20)
    assert not bench.world.enabled


def test_identity_is_vendor_product_and_serial(joint):
    bench = joint("csp").open()
    assert bench.drive.identity == f"canopen:47454D55-00000402-{bench.node.spec.serial:08X}"


def inspected(bench):
    found = []
    bench.while_time_passes(lambda: found.extend(bench.drive.inspect()))
    return found


def test_inspection_finds_all_well_on_a_drive_that_was_opened(joint):
    checks = inspected(joint("csp", limits={"low": -1, "high": 1}).open())
    assert all(check.is_good for check in checks), [check for check in checks if not check.is_good]
    found = {check.what: check.text for check in checks}
    assert found["device type"] == "00020192h, device profile 402."
    assert found["heartbeat"] == "100 ms (1017h:0)."
    assert found["watchdog"] == "stops 150 ms after the last heartbeat of node 127 (1016h:1)."
    assert found["mode"] == "The drive is in mode cyclic synchronous position."
    assert sum(check.what == "PDO mapping" for check in checks) == 4


def test_inspection_finds_what_somebody_changed(joint):
    bench = joint("csp", max_torque=700).open()
    bench.objects[0x1A00, 2] = 0x60620020
    bench.objects[0x1801, 2] = 5
    bench.objects[0x1017, 0] = 0
    bench.objects[0x1016, 1] = 0
    bench.objects[0x6072, 0] = 3000
    bench.objects[0x6060, 0] = 9
    wrong = [f"{check.what}: {check.text}" for check in inspected(bench) if not check.is_good]
    report = "\n".join(wrong)
    assert "TPDO1 carries 6041h:0 (16 bit), 6062h:0 (32 bit), 6077h:0 (16 bit), and should carry 6041h:0" in report
    assert "TPDO2 has transmission type 5, and should have 1." in report
    assert "heartbeat: 0 ms (1017h:0), and should be 100 ms." in report
    assert "watchdog: expects no heartbeat (1016h:1)" in report
    assert "object 6072h:0: 3000 (6072h:0), and should be 700." in report
    assert "mode: The drive is in mode cyclic synchronous velocity. Open it again" in report
    assert all(line[-1] == "." for line in wrong)


def write_protected(bench):
    """Make the drive one whose mapping cannot be changed."""
    entries = bench.node.objects.entries
    for key in list(entries):
        if 0x1600 <= key[0] <= 0x17FF or 0x1A00 <= key[0] <= 0x1BFF:
            entries[key] = replace(entries[key], access="ro")
    return bench


def test_a_fixed_mapping_is_compared_and_used(joint):
    bench = write_protected(joint("csp", quantities=("position", "effort"), pdo=FIXED)).open()
    bench.cycle(2)
    assert bench.device("elbow")["state"] == "ready"
    assert bench.value("position") == pytest.approx(0.3, abs=1e-4)


def test_another_fixed_mapping_is_refused_with_both_layouts(joint):
    forced = {**FIXED, "sends": [{"number": 1, "objects": ["6041h uint16", "6064h int32", "6061h int8"]}]}
    bench = write_protected(joint("csp", quantities=("position",), pdo=forced)).open()
    assert bench.device("elbow")["state"] == "opening"
    assert "TPDO1 carries 6041h:0 (16 bit), 6064h:0 (32 bit), 6077h:0 (16 bit), and should carry" in text(bench)
    assert "6061h:0 (8 bit)." in text(bench)


def fixed_sheet(tmp_path, bench=None):
    """A data sheet of a drive with fixed PDOs, as many simple drives have them; `bench`: its drive is that one."""
    fixed = {
        "1600": (0x60400010,),
        "1601": (0x60400010, 0x60600008),
        "1602": (0x60400010, 0x607A0020),
        "1603": (0x60400010, 0x60FF0020),
        "1A00": (0x60410010,),
        "1A01": (0x60410010, 0x60610008),
        "1A02": (0x60410010, 0x60640020),
        "1A03": (0x60410010, 0x606C0020),
    }
    text = (ROBOTS / SETTINGS["eds"]).read_text()
    for index, entries in fixed.items():
        for place, value in enumerate((len(entries), *entries, *(0,) * (8 - len(entries)))):
            head, section, rest = text.partition(f"[{index}sub{place:X}]")
            section_text, gap, rest = rest.partition("\n\n")
            section_text = re.sub("DefaultValue=.*", f"DefaultValue={value}", section_text)
            text = head + section + section_text.replace("AccessType=rw", "AccessType=ro") + gap + rest
            if bench is not None:
                bench.node.objects.power_on[int(index, 16), place] = value
    if bench is not None:
        write_protected(bench).rig.fault("node_reboot elbow")
    path = tmp_path / "fixed.eds"
    path.write_text(text)
    return path


def test_of_pdos_that_are_fixed_by_the_data_sheet_the_right_ones_are_used(joint, tmp_path):
    sheet = fixed_sheet(tmp_path)
    bench = joint("csp", quantities=("position", "velocity"), eds=str(sheet))
    fixed_sheet(tmp_path, bench)
    bench.open()
    bench.cycle(3)
    assert text(bench) == ""
    assert [pdo.number for pdo in bench.drive.pdos.receives] == [3]
    assert [pdo.number for pdo in bench.drive.pdos.sends] == [3, 4]
    assert [bench.objects[0x1800 + n, 1] >> 31 for n in range(4)] == [1, 1, 0, 0]
    bench.enable()
    bench.follow([0.35], 20)
    assert bench.world.position == pytest.approx(0.35, abs=1e-3)


def test_what_fixed_pdos_do_not_carry_is_told(tmp_path):
    sheet = fixed_sheet(tmp_path)
    report = refused(sheet=sheet, quantities=("position", "effort"))
    assert "cannot send 6077h:0 (16 bit): its mapping is fixed by its data sheet. Its PDOs: 1: 6041h:0" in report
    report = refused("cst", sheet=sheet, quantities=("effort",))
    assert "cannot receive 6071h:0 (16 bit): its mapping is fixed" in report


def test_a_mapping_that_is_not_taken_is_told_with_both_layouts(joint):
    bench = write_protected(joint("csv", quantities=("velocity",))).open()
    assert "does not take RPDO1 as 6040h:0 (16 bit), 60FFh:0 (32 bit); it has 6040h:0 (16 bit), 607Ah:0" in text(bench)
    assert "with `fixed: true`" in text(bench)


def test_a_forced_layout_is_written(joint):
    forced = {
        "receives": [
            {"number": 2, "objects": ["607Ah int32"]},
            {"number": 3, "objects": ["6040h uint16", "6060h int8"]},
        ],
        "sends": [
            {"number": 2, "objects": ["6064h int32"]},
            {"number": 4, "objects": ["6041h uint16", "60FDh uint32"]},
            {"number": 1, "objects": ["2200h:1 int16"], "transmission": 254, "event_time": 0.05},
        ],
    }
    bench = joint("csp", quantities=("position", "temperature"), pdo=forced).open()
    bench.cycle(20)
    assert bench.objects[0x1801, 1] & 0x7FF == 0x285
    assert bench.objects[0x1800, 5] == 50
    assert bench.value("temperature") == pytest.approx(25.0)
    bench.enable()
    bench.follow([0.35], 20)
    assert bench.world.position == pytest.approx(0.35, abs=1e-3)


def test_a_mode_that_the_drive_does_not_have_is_told(joint):
    bench = joint("cst", hardware={"modes": (1, 8)}).open()
    assert (
        "does not have the mode cyclic synchronous torque. By its object 6502h it has profile position, cyclic"
        in text(bench)
    )
    assert not bench.world.enabled


def test_a_drive_without_a_watchdog_is_used_only_on_demand_and_told(joint, tmp_path):
    sheet = without(tmp_path, "1016")
    bench = joint("csp", quantities=("position",), eds=str(sheet), allow_no_watchdog=True).open()
    bench.cycle(3)
    assert bench.device("elbow")["state"] == "ready"
    assert "does not detect the loss of the HAL (no 1016h)" in text(bench)
    assert bench.objects[0x1016, 1] == 0
    bad = [check for check in inspected(bench) if not check.is_good]
    assert [check.what for check in bad] == ["watchdog"]
    assert "the loss of the HAL (no 1016h). Cut its power by other means." in bad[0].text


def test_a_drive_that_was_never_opened_can_be_inspected(joint):
    bench = joint("csp", quantities=("position",))
    bench.rig.step(0.0)
    for bus in bench.buses.values():
        bus.open()
    bad = [check.what for check in inspected(bench) if not check.is_good]
    for bus in bench.buses.values():
        bus.close()
    assert {"identity", "PDO mapping", "heartbeat", "watchdog", "mode"} <= {*bad}


def test_a_velocity_unit_that_is_not_known_is_told(joint):
    bench = joint("csv", hardware={"velocity_unit": 0x00410300}).open()
    assert "has velocities in the unknown unit 00410300h (60A9h). Give velocity_unit: counts/s" in text(bench)
