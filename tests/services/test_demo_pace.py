"""What the demo does on a machine that does not keep a robot file's rate."""

import errno
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from hal.config import RobotConfig, load_robot
from services.demo import demo, pace
from services.demo.actor import Actor, NotFollowing, Stage
from services.demo.pace import CycleCounts, at_rates, count_cycles, halved
from services.errors import ServiceError, ServiceUnavailable
from services.model.artifacts import fingerprint
from services.process.supervisor import ChildDied, NotReady, Supervisor
from services.wire.messages import Status

ARM = Path(__file__).parents[2] / "robots" / "musashi_arm.yaml"


def status(second: int, ticks: int, skipped: int, incomplete: int, rate: float = 200.0) -> Status:
    loop = {"rate_wanted": rate, "ticks": ticks, "skipped": skipped, "late_p99": 0.0031}
    facts = {"incomplete": incomplete, "commands": {"accepted": ticks // 2, "refused": skipped // 10}}
    return Status(stamp_ns=second * 10**9, service="hal", state="running", loops={"hal": loop}, facts=facts)


class Told:
    """A client that hears these statuses, one after the other, then the last one for ever."""

    def __init__(self, *statuses: Status | None) -> None:
        self._statuses = list(statuses)

    def status(self, service: str, timeout: float = 0.0) -> Status | None:
        assert service == "hal"
        return self._statuses.pop(0) if len(self._statuses) > 1 else self._statuses[0]


def until(condition: Any, duration: float) -> bool:
    return any(condition() for _ in range(10))


@pytest.fixture
def arm(tmp_path: Path) -> Path:
    shutil.copytree(ARM.parent / "eds", tmp_path / "eds")
    return Path(shutil.copy(ARM, tmp_path))


def test_the_pace_is_what_happened_between_two_statuses() -> None:
    client = Told(status(1, 500, 90, 40), status(1, 500, 90, 40), status(5, 1290, 100, 43), status(5, 1290, 100, 43))
    found = count_cycles(client, until)  # type: ignore[arg-type]
    assert found == CycleCounts(200.0, cycles=790, skipped=10, incomplete=3, late=0.0031, commands=396, refused=1)
    assert found.is_kept
    cycles, commands = "10 of 800 cycles were skipped and 3 incomplete", "1 of 396 commands were refused"
    assert str(found) == f"{cycles}, 99 of 100 began within 3.1 ms, {commands}"


@pytest.mark.parametrize(
    ("cycles", "skipped", "incomplete", "refused", "is_kept"),
    [
        (800, 0, 0, 0, True),
        (784, 16, 78, 2, True),
        (780, 20, 0, 0, False),
        (800, 0, 81, 0, False),
        (800, 0, 0, 3, False),
        (0, 0, 0, 0, False),
    ],
)
def test_a_rate_is_kept_if_few_cycles_are_missed(
    cycles: int, skipped: int, incomplete: int, refused: int, is_kept: bool
) -> None:
    assert CycleCounts(200.0, cycles, skipped, incomplete, 0.0, commands=100, refused=refused).is_kept is is_kept


def test_a_hal_that_says_nothing_is_told() -> None:
    with pytest.raises(ServiceError, match="publishes no status any more"):
        count_cycles(Told(None), until)  # type: ignore[arg-type]


def test_half_the_rate_is_half_of_all_that_follows_the_cycle(arm: Path) -> None:
    robot = load_robot(arm)
    half, quarter = halved(robot.rates), halved(halved(robot.rates))
    assert half.model_dump() == {"hal": 100, "estimation": 100, "anomaly": 50, "control": 50, "update": 10}
    assert quarter.model_dump() == {"hal": 50, "estimation": 50, "anomaly": 25, "control": 50, "update": 10}


@pytest.mark.parametrize(
    ("cores", "with_page", "rate", "tried"),
    [
        (2, False, 200, [100, 50]),
        (2, False, 100, [100, 50, 25]),
        (2, False, 1000, [250]),
        (2, True, 200, [50]),
        (4, True, 1000, [1000, 500, 250]),
        (3, False, 50, [50, 25, 12.5]),
    ],
)
def test_few_cores_try_no_fast_rates(
    monkeypatch: pytest.MonkeyPatch, arm: Path, cores: int, with_page: bool, rate: float, tried: list[float]
) -> None:
    monkeypatch.setattr(pace, "cores", lambda: cores)
    rates = load_robot(arm).rates.model_copy(update={"hal": rate})
    assert [slower.hal for slower in pace.rates_to_try(rates, with_page)] == tried


def test_the_same_robot_at_another_rate_needs_no_other_model(arm: Path) -> None:
    robot = load_robot(arm)
    rates = halved(robot.rates)
    with at_rates(arm, robot, rates) as file:
        slower = load_robot(file)
        assert slower.rates == rates
        assert {signal.stale_after for signal in slower.signals.values()} == {0.04}
        assert fingerprint(slower) == fingerprint(robot)
        same = {"rates": robot.rates, "signals": robot.signals}
        assert slower.model_copy(update=same) == robot
        assert "." in file.stem  # so that no list of robot files names it
    assert not file.exists()


def test_the_robot_files_own_rates_need_no_other_file(arm: Path) -> None:
    robot = load_robot(arm)
    with at_rates(arm, robot, robot.rates) as file:
        assert file == arm


def test_what_cannot_be_written_is_told(monkeypatch: pytest.MonkeyPatch, arm: Path) -> None:
    def full(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(pace, "NamedTemporaryFile", full)
    robot = load_robot(arm)
    with (
        pytest.raises(ServiceError, match=r"100 Hz cannot be written beside .*No space left"),
        at_rates(arm, robot, halved(robot.rates)),
    ):
        pass


class Processes:
    """Stands for the supervisor and all that it starts; keeps the highest rate that it is told to."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, highest: float, cores: int = 4, follows: float = 1e3) -> None:
        self.highest, self.follows, self.stopped, self.is_engaged = highest, follows, 0, False
        self.rates: list[float] = []
        monkeypatch.setattr(pace, "cores", lambda: cores)
        monkeypatch.setattr(demo, "start", self._start)
        monkeypatch.setattr(demo, "Client", self._client)
        monkeypatch.setattr(pace, "count_cycles", self._look)
        monkeypatch.setattr(Actor, "engage", self._engage)

    def _start(self, robot: RobotConfig, file: Path, *_: object) -> None:
        self.rates.append(load_robot(file).rates.hal)
        self.is_engaged = False

    def _engage(self, *_: object) -> None:
        if self.rates[-1] > self.follows:
            raise NotFollowing("The arm did not begin to follow.")
        self.is_engaged = True

    @contextmanager
    def _client(self, name: str) -> Iterator[None]:
        yield None

    def _look(self, *_: object) -> CycleCounts:
        rate = self.rates[-1]
        assert self.is_engaged
        return CycleCounts(rate, 700, 0 if rate <= self.highest else 100, 0, 0.002, 100, 0)

    def check(self) -> None:
        pass

    def stop_all(self) -> None:
        self.stopped += 1


@pytest.mark.parametrize(
    ("cores", "highest", "rates", "sentences"),
    [
        (4, 200, [200], []),
        (4, 100, [200, 100], ["keep 200 Hz: 100 of 800", "again at 100 Hz"]),
        (4, 50, [200, 100, 50], ["again at 100 Hz", "again at 50 Hz"]),
        (4, 10, [200, 100, 50], ["again at 50 Hz", "keep 50 Hz", "played in spite of this"]),
        (2, 200, [100], ["few processor cores (2), so the story is played at 100 Hz, not at 200 Hz"]),
        (1, 50, [100, 50], ["played at 100 Hz", "again at 50 Hz"]),
        (2, 10, [100, 50], ["played at 100 Hz", "again at 50 Hz", "played in spite of this"]),
    ],
)
def test_a_machine_that_does_not_keep_the_rate_plays_at_half_of_it(
    monkeypatch: pytest.MonkeyPatch, arm: Path, cores: int, highest: float, rates: list[float], sentences: list[str]
) -> None:
    processes, console = Processes(monkeypatch, highest, cores), Console(record=True, width=300)
    robot = load_robot(arm)
    with demo.running(robot, arm, 1, arm.parent, processes, console, False) as cast:  # type: ignore[arg-type]
        assert cast.robot.rates.hal == rates[-1]
        assert processes.stopped == len(rates) - 1
    assert processes.rates == rates
    report = console.export_text()
    assert [sentence for sentence in sentences if sentence not in report] == []
    assert bool(report) is bool(sentences)
    assert list(arm.parent.glob("*.yaml")) == [arm]


def test_a_rate_at_which_the_arm_does_not_follow_is_not_kept(monkeypatch: pytest.MonkeyPatch, arm: Path) -> None:
    processes, console = Processes(monkeypatch, 200, follows=100), Console(record=True, width=300)
    robot = load_robot(arm)
    with demo.running(robot, arm, 1, arm.parent, processes, console, False) as cast:  # type: ignore[arg-type]
        assert cast.robot.rates.hal == 100
    assert "200 Hz: The arm did not begin to follow. All processes are started again" in console.export_text()


def test_an_arm_that_follows_at_no_rate_ends_the_demo(monkeypatch: pytest.MonkeyPatch, arm: Path) -> None:
    processes = Processes(monkeypatch, 200, follows=0)
    with (
        pytest.raises(NotFollowing),
        demo.running(load_robot(arm), arm, 1, arm.parent, processes, Console(), False),  # type: ignore[arg-type]
    ):
        raise AssertionError("the story is not played")
    assert processes.rates == [200, 100, 50]


def test_a_story_that_ends_early_shows_the_stages_before(
    monkeypatch: pytest.MonkeyPatch, arm: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def stall(cast: demo.Cast, *_: object) -> None:
        cast.actor.played.append(Stage("loses an encoder", 0.0, 4.0, ("0.09 rad wrong",), True))
        raise NotFollowing("The arm did not begin to follow.")

    Processes(monkeypatch, 200)
    monkeypatch.setattr(demo, "check_start", lambda *_: None)
    monkeypatch.setattr(demo, "make_model", lambda *_: None)
    monkeypatch.setattr(demo, "warm", lambda *_, has_p: None)
    monkeypatch.setattr(demo, "perform", stall)
    with pytest.raises(NotFollowing):
        demo.play(load_robot(arm), arm, 1, arm.parent / "out")
    shown = capsys.readouterr().out
    assert "loses an encoder" in shown
    assert "0.09 rad wrong" in shown
    assert "story.png" not in shown  # it was not drawn


@pytest.mark.parametrize("has_ended", [True, False])
def test_a_process_that_ended_is_named_before_what_it_did_not_answer(
    monkeypatch: pytest.MonkeyPatch, arm: Path, has_ended: bool
) -> None:
    def check() -> None:
        if has_ended:
            raise ChildDied("'vision' ended with -11.")

    processes = Processes(monkeypatch, 200)
    monkeypatch.setattr(processes, "check", check)
    with (
        pytest.raises(ChildDied if has_ended else ServiceUnavailable),
        demo.running(load_robot(arm), arm, 1, arm.parent, processes, Console(), False),  # type: ignore[arg-type]
    ):
        raise ServiceUnavailable("No 'vision' service answered.")


@pytest.mark.parametrize(
    ("name", "state", "estimates", "runs"),
    [
        ("model", "running", True, True),
        ("model", "degraded", True, True),
        ("model", "degraded", False, False),
        ("hal", "running", False, True),
        ("hal", "degraded", True, True),  # servos without a watchdog answer, and it says so for good
        ("hal", "degraded", False, False),
        ("hal", "fault", True, False),
        ("model", None, True, False),
    ],
)
def test_a_degraded_service_that_does_its_work_runs(name: str, state: str | None, estimates: bool, runs: bool) -> None:
    class Publishing:
        def status(self, service: str) -> Status | None:
            return None if state is None else Status(service=service, state=state, text="a sensor is suspected")

        def estimate(self) -> object:
            return object() if estimates else None

        def sample(self) -> SimpleNamespace:
            return SimpleNamespace(complete=estimates, valid={"joint_position": np.array([True])})

    assert demo._is_running(Publishing(), name) == runs  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("state", "alive", "words"),
    [
        ("degraded", {"model"}, "It is connected, and no estimate arrives; its status is degraded. No sample."),
        (None, set(), "It is not connected, and no status arrives."),
        (None, {"model"}, "It is connected, and no status arrives."),
    ],
)
def test_of_a_process_that_is_not_ready_the_error_says_what_arrives(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, state: str | None, alive: set[str], words: str
) -> None:
    class Client:
        def status(self, service: str) -> Status | None:
            return None if state is None else Status(service=service, state=state, text="No sample.")

        def estimate(self) -> None:
            return None

        def alive(self) -> set[str]:
            return alive

    monkeypatch.setattr(demo, "READY_WITHIN", 0.1)
    with Supervisor(tmp_path) as supervisor, pytest.raises(NotReady) as error:
        supervisor.start("model", ["sleep", "30"])
        demo.await_ready("model", supervisor, Client(), Console())  # type: ignore[arg-type]
    assert str(error.value).endswith(words)
    assert "model.log" in str(error.value)
