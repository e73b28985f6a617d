import threading
from collections.abc import Iterator

import numpy as np
import pytest
from bad_commands import bad_commands
from small_arm import description, eventually

from hal.clock import Clock, ManualClock, SystemClock
from hal.config import RobotConfig
from hal.device import Device, DeviceHealth, DeviceState, Reading
from hal.robot import Robot
from services.command.intake import Commands, Intake
from services.command.lease import Lease
from services.hardware.hal_service import HalService
from services.process.service import Service
from services.wire import keys, messages
from services.wire.messages import Command, Sample
from services.wire.session import close_session, open_session

BOOT = 77


class Wires(Device):
    """All elements of the small arm in one device; each muscle is at once where it is asked to be."""

    def __init__(self, config: RobotConfig, clock: Clock) -> None:
        self.name = "wires"
        self.measures = tuple(config.element_names())
        self.commands = tuple(name for name in self.measures if name.startswith("muscle_length."))
        self.values = np.zeros(len(self.measures))
        self._clock = clock
        self._state = DeviceState.READY

    def open(self) -> None:
        self._state = DeviceState.READY

    def close(self) -> None:
        self._state = DeviceState.CLOSED

    def enable(self) -> None:
        self._state = DeviceState.ENABLED

    def disable(self) -> None:
        self._state = DeviceState.READY

    def health(self) -> DeviceHealth:
        return DeviceHealth(self._state)

    def read(self) -> Reading:
        return Reading(self.values.copy(), np.full(self.values.shape, self._clock.monotonic()))

    def apply(self, values: np.ndarray) -> None:
        self.values[-len(values) :] = values


class BrokenWires(Wires):
    """Wires whose driver has a bug."""

    is_broken = False

    def read(self) -> Reading:
        if self.is_broken:
            raise ZeroDivisionError("a bug in a driver")
        return super().read()


class Taken:
    """An intake before a robot that holds."""

    def __init__(self, robot: str) -> None:
        config = RobotConfig.model_validate(description(robot))
        self.clock = ManualClock()
        self.robot_name = robot
        self.robot = Robot(config, [Wires(config, self.clock)], clock=self.clock)
        self.session = open_session(robot, "client")
        self.commands = Commands(self.robot, config.command.signal, BOOT, Lease(self.clock))
        self.intake = Intake(self.session, keys.command(robot), Command, self.commands.follow)
        self.robot.open()
        self.cycle()
        self.robot.enable()
        self.sample = self.cycle()
        while self.robot.mode != "hold":
            self.sample = self.cycle()

    def offer(self, data: bytes) -> None:
        self.session.put(keys.command(self.robot_name), data)
        self.intake.take()

    def cycle(self) -> Sample:
        self.clock.advance(self.robot.period)
        sample, _ = self.robot.cycle()
        return Sample(
            boot=BOOT, cycle=sample.cycle, source="can", complete=True, values=sample.values, age=sample.age,
            valid=sample.valid,
        )  # fmt: skip


@pytest.fixture
def taken(robot: str) -> Iterator[Taken]:
    setting = Taken(robot)
    yield setting
    setting.robot.close()
    close_session(setting.session)


_ANY = Sample(cycle=50, source="can", complete=True, values={}, age={}, valid={})


@pytest.mark.parametrize("wrong", bad_commands(_ANY))
def test_a_bad_command_is_counted_and_told(taken: Taken, wrong: str) -> None:
    data, counter, says = bad_commands(taken.sample)[wrong]
    if wrong == "an old cycle":
        for _ in range(60):
            taken.cycle()
    taken.offer(data)
    taken.cycle()
    facts = taken.intake.facts()
    assert facts[counter] == 1
    assert facts["accepted"] == 0
    assert says in facts["text"]
    assert taken.intake.news() == facts["text"]
    assert taken.robot.mode == "hold"


def test_a_good_command_is_followed_and_its_sender_known(taken: Taken) -> None:
    good = Command(
        boot=9, signal="muscle_length", values=np.array([0.001, 0.0]), cycle=taken.sample.cycle, hal_boot=BOOT
    )
    taken.offer(messages.encode(good))
    taken.cycle()
    assert taken.robot.mode == "follow"
    assert taken.commands.sender == 9
    assert taken.intake.facts()["accepted"] == 1
    assert taken.intake.news() == ""


def test_bad_commands_are_logged_once_a_second(taken: Taken, caplog: pytest.LogCaptureFixture) -> None:
    for _ in range(50):
        taken.offer(b"\xc1")
    assert taken.intake.facts()["malformed"] == 50
    assert len(caplog.records) == 1


def test_a_cycle_that_fails_stops_the_robot_and_the_service_goes_on(robot: str) -> None:
    config = RobotConfig.model_validate(description(robot))
    clock = ManualClock()
    wires = BrokenWires(config, clock)
    with Service(robot, "hal") as service:
        body = Robot(config, [wires], clock=clock)
        hal = HalService(config, body, service)
        body.open()
        hal.tick()
        body.enable()
        while body.mode != "hold":
            clock.advance(body.period)
            hal.tick()
        wires.is_broken = True
        clock.advance(body.period)
        with pytest.raises(ZeroDivisionError):
            hal.tick()
        wires.is_broken = False
        clock.advance(body.period)
        hal.tick()
        assert body.mode == "fault"
        assert hal.status().text == "The cycle failed: ZeroDivisionError: a bug in a driver"
        body.close()


class StuckWires(Wires):
    """Wires whose driver hangs."""

    def __init__(self, config: RobotConfig, clock: Clock) -> None:
        super().__init__(config, clock)
        self.hangs, self.never = threading.Event(), threading.Event()

    def apply(self, values: np.ndarray) -> None:
        self.hangs.set()
        self.never.wait(60.0)


@pytest.mark.long
def test_a_hal_whose_cycle_is_stuck_stops_its_drives_and_ends_when_told(robot: str) -> None:
    config = RobotConfig.model_validate(description(robot))
    wires = StuckWires(config, SystemClock())
    stop = threading.Event()
    with Service(robot, "hal") as service:
        body = Robot(config, [wires])
        hal = HalService(config, body, service)
        thread = threading.Thread(target=hal.run, args=(stop,))
        thread.start()
        eventually(lambda: body.health()["cycles"] > 1)
        body.enable()
        assert wires.hangs.wait(5.0)
        stop.set()
        thread.join(30.0)
        assert not thread.is_alive()
    assert wires.health().state is DeviceState.CLOSED
    wires.never.set()
    assert body.fault_text == "Emergency stop: The HAL ends."
