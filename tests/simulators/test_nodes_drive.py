import struct

import pytest
from bench import DRIVE, SPECS, bench

from simulators.nodes.cia402.states import Command, State, command, following

MASTER = 127
COUNTS = SPECS[0].constants.counts_per_unit

OFF, READY, ON, ENABLED = State.SWITCH_ON_DISABLED, State.READY_TO_SWITCH_ON, State.SWITCHED_ON, State.OPERATION_ENABLED
STOPPING, REACTING, FAULT = State.QUICK_STOP_ACTIVE, State.FAULT_REACTION_ACTIVE, State.FAULT
SHUTDOWN, SWITCH_ON, ENABLE, VOLTAGE_OFF, QUICK_STOP, RESET = 0x06, 0x07, 0x0F, 0x00, 0x02, 0x80

TRANSITIONS = {
    # state: (shutdown, switch on, enable operation, disable voltage, quick stop, fault reset)
    State.NOT_READY: (State.NOT_READY,) * 6,
    OFF: (READY, OFF, OFF, OFF, OFF, OFF),
    READY: (READY, ON, ENABLED, OFF, OFF, OFF),
    ON: (READY, ON, ENABLED, OFF, OFF, OFF),
    ENABLED: (READY, ON, ENABLED, OFF, STOPPING, OFF),
    STOPPING: (STOPPING, STOPPING, ENABLED, OFF, STOPPING, OFF),
    REACTING: (REACTING,) * 6,
    FAULT: (FAULT, FAULT, FAULT, FAULT, FAULT, OFF),
}


@pytest.mark.parametrize("state", TRANSITIONS)
def test_state_machine_is_the_table_of_the_standard(state):
    words = (SHUTDOWN, SWITCH_ON, ENABLE, VOLTAGE_OFF, QUICK_STOP, RESET)
    assert tuple(following(state, word, 0) for word in words) == TRANSITIONS[state]


@pytest.mark.parametrize("word", range(16))
def test_control_words_ask_for_what_table_27_says(word):
    expected = {6: Command.SHUTDOWN, 14: Command.SHUTDOWN, 7: Command.SWITCH_ON, 15: Command.ENABLE_OPERATION}
    default = Command.QUICK_STOP if word & 2 else Command.DISABLE_VOLTAGE
    assert command(word) is expected.get(word, default)


def test_only_the_edge_of_fault_reset_counts():
    assert following(FAULT, RESET, RESET) is FAULT
    assert following(FAULT, RESET, 0x0F) is OFF


class Driver:
    """Drives the bench's drive by PDO, as a master with a cycle of 5 ms does."""

    def __init__(self, b):
        self.b = b
        self.node = b.rig.node("wire_drive")
        self.target = round((b.world.length - 0.3) * COUNTS)
        self.frames = []
        b.nmt(1)

    def cycle(self, word, count=1, beat=True):
        for _ in range(count):
            answers = self.b.send(0x700 + MASTER, b"\x05") if beat else []
            answers += self.b.send(0x200 + DRIVE, struct.pack("<Hi", word, self.target))
            answers += self.b.send(0x80) + self.b.step(0.005)
            self.frames += answers
            self.status, self.position, self.torque = struct.unpack("<Hih", dict(answers)[0x180 + DRIVE])
        return self.state

    @property
    def state(self):
        return State(self.status & (0x4F if not self.status & 0x20 or self.status & 0x40 else 0x6F))

    def enable(self, mode=8):
        assert self.b.write(DRIVE, 0x6060, 0, "b", mode) == 0
        self.cycle(SHUTDOWN, 2)
        self.cycle(SWITCH_ON, 2)
        assert self.cycle(ENABLE, 2) is ENABLED

    def emergencies(self):
        return [struct.unpack_from("<H", data)[0] for identifier, data in self.frames if identifier == 0x80 + DRIVE]


@pytest.fixture
def driver():
    with bench() as b:
        b.write(DRIVE, 0x1016, 1, "I", MASTER << 16 | 150)
        b.write(DRIVE, 0x1029, 1, "B", 1)
        yield Driver(b)


def test_enabling_and_disabling_step_by_step(driver):
    assert driver.cycle(0, 2) is OFF
    assert driver.cycle(SHUTDOWN, 2) is READY
    assert not driver.b.world.enabled
    assert driver.cycle(SWITCH_ON, 2) is ON
    assert not driver.b.world.enabled
    assert driver.cycle(ENABLE, 2) is ENABLED
    assert driver.b.world.enabled
    assert driver.cycle(SWITCH_ON, 2) is ON
    assert not driver.b.world.enabled
    assert driver.cycle(0, 2) is OFF


def test_mode_8_follows_the_set_point(driver):
    driver.enable()
    driver.target = round((0.28 - 0.3) * COUNTS)
    driver.cycle(ENABLE, 40)
    assert driver.b.world.length == pytest.approx(0.28, abs=1e-5)
    assert driver.position == pytest.approx(driver.target, abs=2)
    assert driver.status & 1 << 12
    assert driver.b.read(DRIVE, 0x6062, 0, "i") == driver.target


def test_without_a_mode_an_enabled_drive_stays_where_it_is(driver):
    driver.enable(mode=0)
    driver.target = 10_000
    driver.cycle(ENABLE, 20)
    assert driver.b.world.length == pytest.approx(0.3, abs=1e-6)
    assert not driver.status & 1 << 12


def test_positions_beyond_the_software_limits_are_not_followed(driver):
    driver.b.write(DRIVE, 0x607D, 1, "i", -5000)
    driver.b.write(DRIVE, 0x607D, 2, "i", 5000)
    driver.enable()
    for target, reached in ((60_000, 5000), (-60_000, -5000)):
        driver.target = target
        driver.cycle(ENABLE, 40)
        assert driver.position == pytest.approx(reached, abs=2)


def test_torque_is_told_in_thousandths_of_the_rated_one(driver):
    driver.b.world.tension = 100.0
    driver.cycle(0, 2)
    shaft = 100.0 * 0.008 / 29
    assert driver.torque == pytest.approx(1000 * shaft / 0.1, abs=1)
    assert driver.b.read(DRIVE, 0x6076, 0, "I") == 100


def test_a_drive_at_its_largest_torque_pulls_no_further(driver):
    driver.b.write(DRIVE, 0x6072, 0, "H", 200)
    driver.enable()
    driver.b.world.tension = 100.0
    driver.cycle(ENABLE, 2)
    driver.target = round((0.25 - 0.3) * COUNTS)
    driver.cycle(ENABLE, 20)
    assert driver.b.world.length == pytest.approx(0.3, abs=1e-4)
    assert driver.status & 1 << 11
    driver.target = round((0.32 - 0.3) * COUNTS)
    driver.cycle(ENABLE, 40)
    assert driver.b.world.length == pytest.approx(0.32, abs=1e-4)


def test_velocity_is_the_change_of_position(driver):
    driver.b.world.length = 0.301
    driver.b.step(0.005)
    driver.cycle(0)
    driver.b.world.length = 0.302
    driver.b.step(0.005)
    driver.b.send(0x80)
    assert driver.b.read(DRIVE, 0x606C, 0, "i") == pytest.approx(0.001 * COUNTS / 0.01, rel=0.02)


def test_quick_stop_comes_to_rest_and_switches_off(driver):
    driver.enable()
    driver.target = -20_000
    driver.cycle(ENABLE, 3)
    moving = driver.b.world.length
    driver.cycle(QUICK_STOP)
    assert driver.node.state is STOPPING
    assert driver.cycle(QUICK_STOP, 60) is OFF
    assert not driver.b.world.enabled
    stopped = driver.b.world.length
    assert abs(stopped - moving) < 0.01
    driver.cycle(QUICK_STOP, 20)
    assert driver.b.world.length == stopped


def test_quick_stop_can_stay_and_be_left_for_operation(driver):
    driver.b.write(DRIVE, 0x605A, 0, "h", 6)
    driver.enable()
    assert driver.cycle(QUICK_STOP, 200) is STOPPING
    assert driver.b.world.enabled
    assert driver.cycle(ENABLE, 2) is ENABLED


def test_quick_stop_that_ends_off_cannot_be_taken_back(driver):
    driver.enable()
    driver.target = -60_000
    driver.cycle(ENABLE, 2)
    driver.cycle(QUICK_STOP)
    driver.cycle(ENABLE)
    assert driver.node.state is not ENABLED


def test_quick_stop_option_zero_switches_off_at_once(driver):
    driver.b.write(DRIVE, 0x605A, 0, "h", 0)
    driver.enable()
    assert driver.cycle(QUICK_STOP, 2) is OFF


@pytest.mark.parametrize(
    ("option", "during", "after"), [(0, ENABLED, ENABLED), (1, REACTING, FAULT), (2, OFF, OFF), (3, STOPPING, FAULT)]
)
def test_a_lost_master_stops_the_drive_as_6007_says(driver, option, during, after):
    driver.b.write(DRIVE, 0x6007, 0, "h", option)
    driver.enable()
    driver.frames.clear()
    seen = []
    for _ in range(200):
        driver.target -= 1000
        driver.cycle(ENABLE, beat=False)
        seen.append(driver.node.state)
    assert driver.emergencies() == [0x8130]
    assert during in seen
    assert seen[-1] is after
    assert driver.b.world.enabled == (after is ENABLED)
    if after is FAULT:
        assert driver.b.read(DRIVE, 0x603F, 0, "H") == 0x8130
        assert driver.state is FAULT


def test_a_lost_master_is_only_reported_by_a_drive_without_power(driver):
    driver.cycle(0, 2)
    driver.frames.clear()
    driver.cycle(0, 60, beat=False)
    assert driver.emergencies() == [0x8130]
    assert driver.state is OFF


def test_a_lost_master_also_ends_the_process_data_by_default(driver):
    driver.b.write(DRIVE, 0x1029, 1, "B", 0)
    driver.enable()
    driver.b.step(0.3, pieces=60)
    assert 0x180 + DRIVE not in driver.b.sync()
    assert driver.b.read(DRIVE, 0x6041, 0, "H") & 0x4F == FAULT


def test_a_fault_is_latched_and_leaves_by_an_edge_only(driver):
    driver.enable()
    driver.b.rig.fault("emcy wire_drive")
    assert driver.cycle(ENABLE | RESET, 200) is FAULT  # an edge during the reaction is no edge in the fault
    assert driver.emergencies() == [0x5000]
    assert not driver.b.world.enabled
    assert driver.cycle(ENABLE, 5) is FAULT
    driver.frames.clear()
    assert driver.cycle(RESET, 5) is OFF
    assert driver.emergencies() == [0]
    assert driver.b.read(DRIVE, 0x603F, 0, "H") == 0
    assert driver.b.read(DRIVE, 0x1001, 0, "B") == 0
    driver.enable()


def test_taking_an_enabled_drive_out_of_operation_stops_it(driver):
    driver.enable()
    driver.b.nmt(0x80)
    driver.b.step(1.0, pieces=200)
    assert driver.node.state is FAULT
    assert not driver.b.world.enabled


def test_without_power_the_brake_holds(driver):
    driver.enable()
    driver.b.rig.fault("node_silent wire_drive")
    driver.b.step(0.01)
    assert not driver.b.world.enabled
    assert driver.b.send(0x80 + 0) != []
    assert 0x180 + DRIVE not in driver.b.sync()
    driver.b.rig.fault("node_back wire_drive")
    assert (0x700 + DRIVE, b"\0") in driver.b.step(0.005)
    assert driver.node.state is OFF


def test_settings_of_the_hardware_can_be_read(driver):
    assert driver.b.read(DRIVE, 0x608F, 1, "I") == 4096
    assert driver.b.read(DRIVE, 0x6091, 1, "I") == 29
    assert driver.b.read(DRIVE, 0x6502, 0, "I") == 1 << 0 | 1 << 5 | 1 << 6 | 1 << 7 | 1 << 8 | 1 << 9
    assert driver.b.read(DRIVE, 0x6077, 0, "h") == pytest.approx(20.0 * 0.008 / 29 * 10_000, abs=1)
