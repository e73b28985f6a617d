"""What every kind of device must do: measure, age, fall silent, come back, survive what is no frame of its own."""

import random

import can
import numpy as np
import pytest
from bus_kinds import KINDS as BUS_KINDS
from conformance_stage import PERIOD, LiveStage, LockStage
from device_kinds import KINDS, NAME

from hal.errors import HalError
from hal.registry import DRIVERS

BAR = 2 * PERIOD + 0.010
OTHER_BUSES = [kind for kind in BUS_KINDS if kind.name != "virtual"]


def is_sentence(text):
    """Empty, or words that begin and end as a sentence does."""
    return not text or ((text[0] in "'\"" or text[0].isupper() or text[0].isdigit()) and text.endswith((".", "?")))


@pytest.fixture
def stage(request):
    stage = LockStage(request.param).open()
    stage.settle()
    yield stage
    stage.close()


every_kind = pytest.mark.parametrize("stage", KINDS, ids=str, indirect=True)


def test_every_driver_is_put_to_the_test():
    on_lines = {name for name, where in DRIVERS.items() if "serial" in where}  # test_serial_servos
    assert {kind.driver for kind in KINDS} == set(DRIVERS) - on_lines


@every_kind
@pytest.mark.long
def test_measures_si_units_in_the_right_direction(stage):
    kind = stage.kind
    for value in (kind.value, kind.value + 0.3, kind.value - 0.5):
        stage.set(value)
        stage.cycle(6)
        assert stage.value == pytest.approx(value, abs=kind.tolerance)
        assert stage.sample.complete
        assert (stage.sample.age[kind.main] <= PERIOD).all()
    assert is_sentence(stage.health["text"])
    assert not stage.is_powered


@every_kind
@pytest.mark.long
def test_what_cannot_be_is_not_measured_whatever_the_driver(stage):
    kind, name = stage.kind, f"{stage.kind.main}.one"
    bounds = stage.robot._assembler.plausibility._bounds
    bounds.high[bounds.names.index(name)] = kind.value + 0.5
    stage.set(kind.value)
    stage.cycle(6)
    assert stage.value == pytest.approx(kind.value, abs=kind.tolerance)
    stage.set(kind.value + 0.8)
    stage.cycle(6)
    assert not stage.is_valid
    assert np.isnan(stage.value)
    assert is_sentence(stage.robot.health()["implausible"][name])
    stage.set(kind.value)
    stage.until(lambda: stage.is_valid, "measured again")
    assert name not in stage.robot.health()["implausible"]


@every_kind
@pytest.mark.long
def test_silence_is_noticed_told_and_over_when_it_is_back(stage):
    stage.cycle(5)
    stage.rig.fault(f"node_silent {NAME}")
    start, ages = stage.clock.monotonic(), []
    while stage.is_valid:
        stage.cycle()
        ages.append(stage.sample.age[stage.kind.main][0])
    assert stage.clock.monotonic() - start <= BAR + 1e-9
    for _ in range(40):
        stage.cycle()
        ages.append(stage.sample.age[stage.kind.main][0])
        assert not stage.is_valid
    assert np.all(np.diff(ages) > 0), "an old value became younger"
    assert stage.health["state"] == "silent"
    assert stage.health["text"] and is_sentence(stage.health["text"])
    if stage.kind.commanded:
        assert stage.refuses_to_enable()
    stage.rig.fault(f"node_back {NAME}")
    stage.until(lambda: stage.is_ready, "coming back")
    stage.cycle(20)
    assert stage.value == pytest.approx(stage.kind.value, abs=stage.kind.tolerance)
    assert not stage.is_powered


@every_kind
@pytest.mark.long
def test_a_reboot_is_noticed_and_the_device_configured_again(stage):
    before = dict(stage.health["counters"])
    stage.rig.fault(f"node_reboot {NAME}")
    stage.cycle(3)
    if stage.kind.tells_reboot:
        assert stage.health["counters"]["boots"] == before["boots"] + 1
        stage.until(lambda: stage.health["counters"]["commissioned"] > before["commissioned"], "being commissioned")
    stage.until(lambda: stage.is_ready, "being ready again")
    assert stage.value == pytest.approx(stage.kind.value, abs=stage.kind.tolerance)
    assert not stage.is_powered


@every_kind
@pytest.mark.long
def test_frames_of_another_length_or_sort_change_nothing(stage):
    draw = random.Random(1)
    wire, before = stage.wires["can0"], stage.health["counters"]["malformed"]
    lengths = _lengths(wire, stage)
    for _ in range(20):
        for identifier in stage.kind.answers:
            for length in set(range(9)) - lengths[identifier]:
                stage.send("can0", identifier, draw.randbytes(length))
        stage.flush()
        assert stage.read() == pytest.approx(stage.kind.value, abs=stage.kind.tolerance)
        stage.cycle()
        assert stage.value == pytest.approx(stage.kind.value, abs=stage.kind.tolerance)
    assert stage.health["counters"]["malformed"] > before
    for identifier in stage.kind.answers:
        for how in ({"is_remote_frame": True, "dlc": 8}, {"is_extended_id": True, "data": bytes(8)}):
            message = can.Message(arbitration_id=identifier, **{"is_extended_id": False, **how})
            stage.wires["can0"].send(message)
    stage.cycle(2)
    assert stage.value == pytest.approx(stage.kind.value, abs=stage.kind.tolerance)
    assert stage.buses["can0"].counters["broken_handlers"] == 0


def _lengths(wire, stage):
    """How long the frames with what is measured really are, by identifier."""
    while wire.recv(0) is not None:
        pass
    stage.cycle(3)
    found = {identifier: set() for identifier in stage.kind.answers}
    while (message := wire.recv(0)) is not None:
        if message.arbitration_id in found:
            found[message.arbitration_id].add(len(message.data))
    assert all(found.values()), "the entry names an identifier that nobody sends"
    return found


@every_kind
@pytest.mark.long
def test_closing_and_opening_twice_is_safe(stage):
    device = stage.robot._devices[0]
    stage.while_time_passes(device.open)
    stage.until(lambda: stage.is_ready, "being ready after a second open")
    for _ in range(2):
        stage.while_time_passes(stage.robot.close)
    assert stage.health["state"] == "closed"
    assert is_sentence(stage.health["text"])
    device.close()
    stage.while_time_passes(stage.robot.open)
    stage.until(lambda: stage.is_ready, "being ready after another open")
    assert not stage.is_powered


@pytest.mark.long
@every_kind
def test_without_a_bus_it_says_so_and_lets_go(stage):
    device = stage.robot._devices[0]
    stage.powered = False
    stage.cycle(40)
    assert stage.health["state"] != "ready"
    assert is_sentence(stage.health["text"])
    failures = []
    stage.while_time_passes(lambda: _try(device.open, failures))
    assert all(isinstance(failure, HalError) and is_sentence(str(failure)) for failure in failures), failures
    stage.while_time_passes(device.close)
    stage.powered = True
    stage.until(lambda: stage.is_ready, "coming back")


def _try(job, failures):
    try:
        job()
    except Exception as error:
        failures.append(error)


@pytest.fixture
def live(request):
    kind, bus_kind = request.param
    bus_kind.skip_unless_it_works()
    with bus_kind.serve() as section:
        stage = LiveStage(kind, section).open()
        yield stage
        stage.close()


@pytest.mark.long
@pytest.mark.parametrize(
    "live",
    [pytest.param((kind, bus), id=f"{kind}-{bus}") for kind in KINDS for bus in OTHER_BUSES],
    indirect=True,
)
def test_on_every_bus_it_measures_follows_and_stays_off_when_it_was_silent(live):
    kind = live.kind
    live.settle()
    live.until(lambda: live.value == pytest.approx(kind.value, abs=kind.tolerance), "measuring")
    if kind.commanded == "position":
        live.enable()
        goal = live.value + 0.1
        deadline = 200
        while abs(live.value - goal) > 0.02 and deadline:
            if live.robot.mode in ("hold", "follow"):
                live.robot.command(np.array([goal]), live.sample.cycle)
            live.cycle()
            deadline -= 1
        assert deadline, live.robot.health()
    live.rig.fault(f"node_silent {NAME}")
    live.until(lambda: not live.is_valid, "silence")
    live.rig.fault(f"node_back {NAME}")
    live.until(lambda: live.is_valid, "coming back")
    assert not live.is_powered
