"""The simulated drive in its modes, spoken to in bare frames."""

import struct
from dataclasses import replace

import pytest
from bench import DRIVE, SPECS, bench
from test_nodes_drive import COUNTS, ENABLE, ENABLED, FAULT, REACTING, RESET, Driver

HOMING, VELOCITY, TORQUE = 6, 9, 10
REACHED, SPECIFIC, DEVIATES, LIMITED = 1 << 10, 1 << 12, 1 << 13, 1 << 11


@pytest.fixture
def driver():
    constants = replace(SPECS[0].constants, switches=(0.2, 0.4), direction=1, thermal_time=2.0)
    with bench([replace(SPECS[0], constants=constants), *SPECS[1:]]) as b:
        yield Driver(b)


def put(driver, index, form, value, sub=0):
    assert driver.b.write(DRIVE, index, sub, form, value) == 0


def get(driver, index, form, sub=0):
    return driver.b.read(DRIVE, index, sub, form)


def test_profile_position_moves_within_speed_and_acceleration(driver):
    put(driver, 0x6081, "I", 20_000)
    put(driver, 0x6083, "I", 200_000)
    put(driver, 0x6084, "I", 200_000)
    driver.enable(mode=1)
    start = driver.position
    driver.target = start + 10_000
    driver.cycle(ENABLE)
    assert driver.position == pytest.approx(start, abs=2)
    driver.cycle(ENABLE | 0x30, 2)
    assert driver.status & SPECIFIC
    driver.cycle(ENABLE, 2)
    assert not driver.status & SPECIFIC
    speeds = []
    before = driver.position
    for _ in range(140):
        driver.cycle(ENABLE)
        speeds.append((driver.position - before) / 0.005)
        before = driver.position
        assert not driver.status & REACHED or driver.position == pytest.approx(start + 10_000, abs=200)
    assert driver.status & REACHED
    assert max(speeds) == pytest.approx(20_000, rel=0.1)
    assert driver.position == pytest.approx(start + 10_000, abs=3)


def test_a_set_point_that_is_not_at_once_waits_for_the_one_before(driver):
    driver.enable(mode=1)
    start = driver.position
    driver.target = start + 4000
    driver.cycle(ENABLE | 0x10, 2)
    driver.cycle(ENABLE, 2)
    driver.target = start - 4000
    driver.cycle(ENABLE | 0x10, 2)
    driver.cycle(ENABLE, 2)
    assert driver.status & SPECIFIC  # there is no room for a third
    highest = driver.position
    for _ in range(200):
        driver.cycle(ENABLE)
        highest = max(highest, driver.position)
    assert highest == pytest.approx(start + 4000, abs=30)
    assert driver.position == pytest.approx(start - 4000, abs=3)


def test_halt_stands_still(driver):
    driver.enable(mode=1)
    driver.target = driver.position + 40_000
    driver.cycle(ENABLE | 0x30, 20)
    driver.cycle(ENABLE | 1 << 8, 60)
    still = driver.position
    driver.cycle(ENABLE | 1 << 8, 10)
    assert driver.position == pytest.approx(still, abs=3)


@pytest.mark.parametrize("speed", [8_000, -8_000])
def test_cyclic_velocity(driver, speed):
    driver.enable(mode=VELOCITY)
    put(driver, 0x60FF, "i", speed)
    driver.cycle(ENABLE, 20)
    before = driver.position
    driver.cycle(ENABLE, 20)
    assert (driver.position - before) / 0.1 == pytest.approx(speed, rel=0.02)
    assert get(driver, 0x606C, "i") == pytest.approx(speed, rel=0.05)
    assert driver.status & SPECIFIC


def test_no_faster_than_the_motor_may_turn(driver):
    put(driver, 0x6080, "I", 60)  # one turn, 4096 counts, per second
    driver.enable(mode=VELOCITY)
    put(driver, 0x60FF, "i", 100_000)
    driver.cycle(ENABLE, 20)
    before = driver.position
    driver.cycle(ENABLE, 20)
    assert (driver.position - before) / 0.1 == pytest.approx(4096, rel=0.02)
    assert driver.status & LIMITED


def test_velocity_ends_at_the_software_limit(driver):
    start = driver.position if hasattr(driver, "position") else 0
    put(driver, 0x607D, "i", start + 2000, sub=2)
    driver.enable(mode=VELOCITY)
    put(driver, 0x60FF, "i", 20_000)
    driver.cycle(ENABLE, 60)
    assert driver.position == pytest.approx(start + 2000, abs=3)
    assert driver.status & LIMITED


def test_torque_that_holds_the_load_moves_nothing_and_more_does(driver):
    driver.b.world.tension = 0.055 * 0.1 * 29 / 0.008
    hold = -55
    put(driver, 0x6071, "h", hold)
    driver.enable(mode=TORQUE)
    driver.cycle(ENABLE, 40)
    length = driver.b.world.length
    driver.cycle(ENABLE, 40)
    assert driver.b.world.length == pytest.approx(length, abs=2e-3)
    put(driver, 0x6071, "h", 2 * hold)
    driver.cycle(ENABLE, 10)
    assert driver.b.world.length < length - 1e-3
    assert driver.torque == 2 * hold


def test_torque_is_cut_at_the_largest(driver):
    put(driver, 0x6072, "H", 50)
    driver.enable(mode=TORQUE)
    put(driver, 0x6071, "h", -400)
    driver.cycle(ENABLE, 3)
    assert driver.torque == -50
    assert driver.status & LIMITED


def test_the_winding_warms_with_torque_and_cools_without(driver):
    cold = get(driver, 0x2200, "h", sub=1)
    driver.enable(mode=TORQUE)
    put(driver, 0x6071, "h", -1000)
    put(driver, 0x607D, "i", driver.position - 10, sub=1)
    driver.cycle(ENABLE, 400)
    warm = get(driver, 0x2200, "h", sub=1)
    assert cold == 250
    assert warm == pytest.approx(250 + 400 * (1 - 2.718281828**-1), abs=3)  # 40 K at rated torque, 2 s
    driver.cycle(0, 400)
    assert get(driver, 0x2200, "h", sub=1) < warm


def test_following_error_is_told_and_too_much_of_it_a_fault(driver):
    put(driver, 0x6065, "I", 500)
    put(driver, 0x6066, "H", 30)
    driver.enable()
    driver.b.world.step = lambda duration: setattr(driver.b.world, "time", driver.b.world.time + duration)
    driver.target = driver.position + 400
    driver.cycle(ENABLE, 20)
    assert get(driver, 0x60F4, "i") == 400
    assert driver.state is ENABLED
    driver.target = driver.position + 2000
    driver.frames.clear()
    driver.cycle(ENABLE, 3)
    assert driver.state is ENABLED
    assert driver.status & DEVIATES
    driver.cycle(ENABLE, 200)
    assert driver.state in (REACTING, FAULT)
    assert driver.emergencies() == [0x8611]
    assert get(driver, 0x603F, "H") == 0x8611


@pytest.mark.parametrize(("method", "home", "offset"), [(17, 0.2, 0), (18, 0.4, 0), (37, 0.3, 0), (17, 0.2, 700)])
def test_homing_bits_and_zero(driver, method, home, offset):
    put(driver, 0x6098, "b", method)
    put(driver, 0x607C, "i", offset)
    put(driver, 0x6099, "I", 400_000, sub=1)
    put(driver, 0x6099, "I", 20_000, sub=2)
    driver.enable(mode=HOMING)
    driver.cycle(ENABLE | 0x10)
    for _ in range(600):
        driver.cycle(ENABLE | 0x10)
        if driver.status & SPECIFIC:
            break
        assert not driver.status & (REACHED | DEVIATES)
    driver.cycle(ENABLE | 0x10, 2)
    assert driver.status & (SPECIFIC | REACHED | DEVIATES) == SPECIFIC | REACHED
    counts_at_home = driver.position - (driver.b.world.length - home) * abs(COUNTS)
    assert counts_at_home == pytest.approx(-offset, abs=60)


def test_a_method_that_it_does_not_have_is_a_homing_error(driver):
    put(driver, 0x6098, "b", 5)
    driver.enable(mode=HOMING)
    driver.cycle(ENABLE | 0x10, 3)
    assert driver.status & DEVIATES
    assert not driver.status & SPECIFIC


def test_homing_ends_with_its_bit(driver):
    put(driver, 0x6098, "b", 17)
    driver.enable(mode=HOMING)
    driver.cycle(ENABLE | 0x10, 40)
    driver.cycle(ENABLE, 20)
    still = driver.position
    driver.cycle(ENABLE, 20)
    assert driver.position == still
    assert driver.status & (SPECIFIC | REACHED) == REACHED


def test_limit_switches_are_digital_inputs(driver):
    for length, inputs in ((0.3, 0), (0.19, 1), (0.41, 2)):
        driver.b.world.length = length
        driver.b.step(0.005)
        assert get(driver, 0x60FD, "I") == inputs


def test_a_mode_that_it_does_not_have_is_refused():
    specs = [replace(SPECS[0], constants=replace(SPECS[0].constants, modes=(8,)))]
    with bench(specs) as b:
        assert b.write(DRIVE, 0x6060, 0, "b", 9) == 0x0609_0030
        assert b.read(DRIVE, 0x6502, 0, "I") == 1 << 7


def test_velocities_in_revolutions_per_minute():
    specs = [replace(SPECS[0], constants=replace(SPECS[0].constants, velocity_unit=0x00B44700))]
    with bench(specs) as b:
        driver = Driver(b)
        driver.enable(mode=VELOCITY)
        put(driver, 0x60FF, "i", 60)  # one turn, 4096 counts, per second
        driver.cycle(ENABLE, 20)
        before = driver.position
        driver.cycle(ENABLE, 20)
        assert (driver.position - before) / 0.1 == pytest.approx(4096, rel=0.02)
        assert struct.pack("<i", get(driver, 0x606C, "i")) in [struct.pack("<i", speed) for speed in (59, 60, 61)]


def test_a_fault_in_motion_stops_each_mode():
    for mode in (1, 8, VELOCITY, TORQUE):
        with bench(SPECS) as b:
            driver = Driver(b)
            driver.enable(mode=mode)
            b.rig.fault("emcy wire_drive")
            driver.cycle(ENABLE, 200)
            assert driver.state is FAULT
            driver.cycle(0)
            driver.cycle(RESET, 2)
            assert driver.state is not FAULT
