import importlib.util

import canopen
import pytest
from canopen.objectdictionary import ODVariable

from simulators.nodes.canopen.spec import EDS_FOLDER

KINDS = ("servo_drive", "load_cell", "analog_input", "joint_encoder")

DEFAULT_PDOS = {
    "servo_drive": {
        "rpdo": [("Controlword", 16), ("Target position", 32)],
        "tpdo": [("Statusword", 16), ("Position actual value", 32), ("Torque actual value", 16)],
    },
    "load_cell": {"tpdo": [("AI input PV 32 bit.AI input PV 32 bit 1", 32), ("AI status.AI status 1", 8)]},
    "analog_input": {"tpdo": []},
    "joint_encoder": {"tpdo": [("Position value", 32), ("Alarms", 16)]},
}


def variables(dictionary):
    for item in dictionary.values():
        yield from [item] if isinstance(item, ODVariable) else item.subindices.values()


@pytest.fixture(params=KINDS)
def kind(request):
    return request.param


def test_the_files_are_what_the_script_writes(kind):
    spec = importlib.util.spec_from_file_location("write_eds", EDS_FOLDER / "write_eds.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    assert (EDS_FOLDER / f"{kind}.eds").read_text() == module.sheet(kind), "run robots/eds/write_eds.py"


def test_identifiers_follow_the_node_id(kind):
    dictionary = canopen.import_od(str(EDS_FOLDER / f"{kind}.eds"), node_id=9)
    assert dictionary[0x1014].default == 0x89
    assert dictionary[0x1200][1].default == 0x609
    assert dictionary[0x1200][2].default == 0x589
    assert dictionary[0x1800][1].default & 0x7FFF_FFFF == 0x4000_0189


def test_every_default_fits_its_type_and_its_limits(kind):
    for variable in variables(canopen.import_od(str(EDS_FOLDER / f"{kind}.eds"), node_id=9)):
        if variable.access_type != "wo":
            variable.encode_raw(variable.default)
        assert variable.min is None or variable.min <= variable.default
        assert variable.max is None or variable.default <= variable.max
        assert variable.access_type in ("rw", "ro", "wo", "const", "rwr", "rww")


def test_mandatory_objects_and_device_information_are_there(kind):
    dictionary = canopen.import_od(str(EDS_FOLDER / f"{kind}.eds"), node_id=9)
    profile = {"servo_drive": 402, "load_cell": 404, "analog_input": 401, "joint_encoder": 406}[kind]
    assert dictionary[0x1000].default & 0xFFFF == profile
    assert 0x1001 in dictionary
    assert dictionary[0x1018][1].default == dictionary.device_information.vendor_number == 0x47454D55
    assert dictionary[0x1018][2].default == dictionary.device_information.product_number
    assert dictionary.device_information.allowed_baudrates == {1_000_000}
    assert dictionary.device_information.nr_of_TXPDO == sum(0x1800 <= index < 0x1A00 for index in dictionary)


def test_default_pdos_are_those_of_the_cycle(kind):
    dictionary = canopen.import_od(str(EDS_FOLDER / f"{kind}.eds"), node_id=9)
    for direction, expected in DEFAULT_PDOS[kind].items():
        timing, mapping = (0x1400, 0x1600) if direction == "rpdo" else (0x1800, 0x1A00)
        assert dictionary[timing][2].default == 1
        mapped = [dictionary[mapping][sub].default for sub in range(1, dictionary[mapping][0].default + 1)]
        names = []
        for number in mapped:
            variable = dictionary.get_variable(number >> 16, number >> 8 & 0xFF)
            assert variable.pdo_mappable
            assert len(variable) == number & 0xFF
            names.append((variable.qualname, number & 0xFF))
        assert names == expected


def test_canopen_can_write_and_read_the_dictionary_again(kind, tmp_path):
    first = canopen.import_od(str(EDS_FOLDER / f"{kind}.eds"), node_id=9)
    canopen.export_od(first, str(tmp_path / "again.eds"), doc_type="eds")
    again = canopen.import_od(str(tmp_path / "again.eds"), node_id=9)
    described = [
        [(v.qualname, v.data_type, v.access_type, v.pdo_mappable) for v in variables(d)] for d in (first, again)
    ]
    assert described[0] == described[1]
