import struct

import can
import canopen
import pytest
from bench import CELL, DRIVE, ENCODER, SPECS, SpringWorld, bench, config
from canopen.objectdictionary import ODVariable

from simulators.nodes.canopen.objects import STRING_LIMIT, Abort
from simulators.rig import Rig


@pytest.fixture(scope="module")
def bus_with_master():
    """canopen as a master of its own, beside a rig in real time."""
    settings = config()
    rig = Rig(settings, SpringWorld(), SPECS)
    rig.start()
    network = canopen.Network(can.Bus(interface="virtual", channel=settings.buses["can0"].channel))
    network.connect()
    for spec in SPECS:
        node = network.add_node(spec.node, str(spec.eds))
        node.sdo.RESPONSE_TIMEOUT = 10.0
    yield network
    network.disconnect()
    rig.stop()


@pytest.fixture
def network(bus_with_master):
    bus_with_master.nmt.send_command(0x81)
    return bus_with_master


@pytest.mark.parametrize("node", [DRIVE, CELL, ENCODER])
def test_an_independent_master_reads_every_object_of_the_sheet(network, node):
    remote = network[node]
    read = 0
    for item in remote.object_dictionary.values():
        for variable in [item] if isinstance(item, ODVariable) else item.subindices.values():
            if variable.access_type == "wo":
                with pytest.raises(canopen.SdoAbortedError) as refusal:
                    remote.sdo.upload(variable.index, variable.subindex)
                assert refusal.value.code == Abort.WRITE_ONLY
                continue
            data = remote.sdo.upload(variable.index, variable.subindex)
            if variable.fixed_size:
                assert len(data) == len(variable) // 8
            variable.decode_raw(data)
            read += 1
    assert read > 60


def test_identity_and_strings(network):
    for spec in SPECS:
        sdo = network[spec.node].sdo
        assert sdo[0x1018]["Serial number"].raw == spec.serial
        assert sdo["Label"].raw == spec.name
        assert sdo["Manufacturer software version"].raw == "1.0"
        assert sdo["Manufacturer device name"].raw == f"gemuco {spec.kind.replace('_', ' ')}"


@pytest.mark.parametrize("label", ["a", "four", "seven77", "a label of more than seven bytes", "x" * STRING_LIMIT])
def test_segmented_download_and_upload_agree(network, label):
    sdo = network[CELL].sdo
    sdo["Label"].raw = label
    assert sdo["Label"].raw == label


@pytest.mark.parametrize("node", [DRIVE, CELL, ENCODER])
def test_a_pdo_is_remapped_as_cia_301_demands(network, node):
    """canopen's own order: off, empty, entries, number, on."""
    pdo = network[node].tpdo[2]
    pdo.read()
    pdo.clear()
    pdo.add_variable(0x1001)
    first = network[node].object_dictionary[0x1A00][1].default
    pdo.add_variable(first >> 16, first >> 8 & 0xFF)
    pdo.cob_id, pdo.trans_type, pdo.enabled = 0x280 + node, 1, True
    pdo.save()
    pdo.read()
    assert [variable.index for variable in pdo.map] == [0x1001, first >> 16]
    network.nmt.send_command(1)
    network.sync.transmit()
    assert pdo.wait_for_reception(10) is not None
    assert len(pdo.data) == 1 + (first & 0xFF) // 8


REFUSALS = [
    ("no object", CELL, 0x5FFF, 0, "I", 1, Abort.NO_OBJECT),
    ("no sub-index", CELL, 0x1018, 9, "I", 1, Abort.NO_SUBINDEX),
    ("constant", CELL, 0x1018, 1, "I", 1, Abort.READ_ONLY),
    ("process value", CELL, 0x9130, 1, "i", 1, Abort.READ_ONLY),
    ("too many bytes", CELL, 0x1017, 0, "I", 1, Abort.TOO_LONG),
    ("too few bytes", DRIVE, 0x607A, 0, "H", 1, Abort.TOO_SHORT),
    ("above the limit", CELL, 0x6132, 1, "B", 7, Abort.TOO_HIGH),
    ("below the limit", DRIVE, 0x6085, 0, "I", 0, Abort.TOO_LOW),
    ("unknown mode", DRIVE, 0x6060, 0, "b", 3, Abort.VALUE),
    ("unknown stop", DRIVE, 0x605A, 0, "h", 7, Abort.VALUE),
    ("not the tare signature", CELL, 0x6125, 1, "I", 1, Abort.VALUE),
]


@pytest.mark.parametrize("case", REFUSALS, ids=[case[0] for case in REFUSALS])
def test_what_cannot_be_written_is_refused_with_the_code_of_the_standard(case):
    _, node, index, sub, form, value, code = case
    with bench() as b:
        assert b.write(node, index, sub, form, value) == code


def test_transfers_that_break_the_protocol_are_aborted():
    with bench() as b:
        open_string = struct.pack("<BHB4x", 0x40, 0x1008, 0)
        segment, toggled = bytes([0x60]).ljust(8, b"\0"), bytes([0x70]).ljust(8, b"\0")
        assert code_of(b.sdo(CELL, segment)) == Abort.COMMAND
        b.sdo(CELL, open_string)
        assert code_of(b.sdo(CELL, toggled)) == Abort.TOGGLE
        assert code_of(b.sdo(CELL, segment)) == Abort.COMMAND
        assert code_of(b.sdo(CELL, bytes([0xC0]).ljust(8, b"\0"))) == Abort.COMMAND
        assert code_of(b.sdo(CELL, bytes(8))) == Abort.COMMAND


def test_a_string_that_does_not_fit_or_is_not_as_long_as_announced_is_refused():
    with bench() as b:
        start = struct.pack("<BHBI", 0x21, 0x2000, 0, 9)
        last = bytes([0x01]) + b"seven77"
        b.sdo(CELL, start)
        assert code_of(b.sdo(CELL, last)) == Abort.LENGTH
        b.sdo(CELL, struct.pack("<BHBI", 0x20, 0x2000, 0, 0))
        for number in range(10):
            assert b.sdo(CELL, bytes([number % 2 << 4]) + b"seven77")[0] == 0x20 | number % 2 << 4
        assert code_of(b.sdo(CELL, bytes([0x01]) + b"seven77")) == Abort.MEMORY
        assert code_of(b.sdo(CELL, struct.pack("<BHBI", 0x21, 0x1008, 0, 9))) == Abort.READ_ONLY


def test_a_client_that_gives_up_and_short_frames_get_no_answer():
    with bench() as b:
        assert b.send(0x600 + CELL, struct.pack("<BHBI", 0x80, 0x2000, 0, Abort.TOGGLE)) == []
        assert b.send(0x600 + CELL, b"\x40\x00\x10") == []
        assert b.send(0x600 + CELL, b"") == []
        assert b.send(0x67F, bytes(8)) == []


@pytest.mark.long
def test_a_process_value_read_by_sdo_is_of_now():
    with bench() as b:
        b.world.angle = 1.0
        b.step(0.005)
        first = b.read(ENCODER, 0x6004, 0, "I")
        b.world.angle = 1.1
        b.step(0.005)
        assert b.read(ENCODER, 0x6004, 0, "I") > first


def code_of(answer):
    assert answer[0] == 0x80
    return struct.unpack_from("<I", answer, 4)[0]
