"""A simulated camera as a service: new truths only, honest ages, faults; and any other camera in its place."""

import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from small_arm import description as arm_description
from small_arm import eventually
from small_hand import HandWorld, config

from gemuco import TrainConfig, fit
from hal.clock import ManualClock
from hal.config import RobotConfig
from hal.errors import ConfigError
from services.client import Client
from services.errors import AlreadyRunning, RemoteError
from services.hardware.vision_service import run_vision
from services.learning.collector import Request, collect_direct
from services.model.estimation import Distrust, Freshness
from services.model.trust_loop import Trust
from services.process.service import Service
from services.recording.reading import read
from services.recording.recorder import Recorder
from services.recording.schema import Catalogue
from services.recording.writer import RecordingWriter
from services.verbs.ask import ask_robot
from services.verbs.top import watch
from services.wire import keys
from services.wire.messages import MessageError, Sample, Status
from services.wire.session import endpoint
from services.wire.streams import Arrival

EXAMPLE = Path(__file__).parents[2] / "examples" / "publish_marker.py"


def sample(values: dict[str, np.ndarray], cycle: int = 1, source: str = "simulated", age: float = 0.0) -> Sample:
    return Sample(
        stamp_ns=time.time_ns(),
        cycle=cycle,
        source=source,
        complete=True,
        values=values,
        age={name: np.full(value.shape, age) for name, value in values.items()},
        valid={name: np.isfinite(value) for name, value in values.items()},
    )


class Truth:
    """A simulator's truth, published while it is let."""

    def __init__(self, robot: str) -> None:
        self.world = HandWorld("short")
        self.service = Service(robot, "simulator")
        self._robot = robot
        self._stop, self.pause = threading.Event(), threading.Event()

    def __enter__(self) -> "Truth":
        self.service.__enter__()
        self._put = self.service.publisher(keys.truth(self._robot), Sample).put
        self._thread = threading.Thread(target=self._run)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()
        self.service.__exit__(None, None, None)

    def _run(self) -> None:
        while not self._stop.wait(0.01):
            if not self.pause.is_set():
                self._put(sample(self.world.truth(), source="truth"))


@contextmanager
def camera_of(robot: RobotConfig) -> Iterator[None]:
    stop = threading.Event()
    thread = threading.Thread(target=run_vision, args=(robot,), kwargs={"stop": stop})
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()


@pytest.mark.long
def test_the_camera_sees_what_is_and_says_how_old_it_is(robot: str) -> None:
    with Truth(robot) as truth, camera_of(config(robot)), Client(robot) as client:
        frame = client.vision(timeout=10.0)
        assert frame is not None
        assert list(frame.values) == ["tool_tip_position"]
        assert frame.source == "simulated"
        np.testing.assert_allclose(frame.values["tool_tip_position"], truth.world.truth()["tool_tip_position"])
        assert frame.valid["tool_tip_position"].all()
        assert 0.0 <= frame.age["tool_tip_position"][0] < 0.1
        following = client.reader(keys.vision(robot), Sample).wait(2.0)
        assert following is not None
        assert following.cycle > frame.cycle
        status = client.status("vision", timeout=5.0)
        assert status is not None
        assert status.state == "running"
        assert client.describe("vision")["signals"] == {"tool_tip_position": {"unit": "m", "elements": ["x", "y"]}}


@pytest.mark.long
def test_a_camera_with_nothing_to_look_at_is_silent_and_says_so(robot: str) -> None:
    with Truth(robot) as truth, camera_of(config(robot)), Client(robot) as client:
        assert client.vision(timeout=10.0) is not None
        truth.pause.set()
        reader = client.reader(keys.vision(robot), Sample)
        while reader.wait(0.3) is not None:
            pass
        assert client.vision() is None
        eventually(lambda: "No truth arrives" in getattr(client.status("vision", timeout=2.0), "text", ""))
        truth.pause.clear()
        assert client.vision(timeout=5.0) is not None


@pytest.mark.long
def test_faults_of_the_camera(robot: str) -> None:
    with Truth(robot), camera_of(config(robot)), Client(robot) as client:
        assert client.vision(timeout=10.0) is not None
        assert client.fault("camera_covered", "vision") == {"text": "The camera sees nothing."}
        eventually(lambda: not client.vision(timeout=2.0).valid["tool_tip_position"].any())
        assert np.isnan(client.vision(timeout=2.0).values["tool_tip_position"]).all()
        eventually(lambda: getattr(client.status("vision"), "text", "") == "Out of sight: tool_tip_position.")
        assert client.fault("camera_back", "vision") == {"text": "The camera sees again."}
        eventually(lambda: bool(client.vision(timeout=2.0).valid["tool_tip_position"].all()))
        with pytest.raises(RemoteError, match="Known: camera_covered, camera_back"):
            client.fault("camera_dropped", "vision")
        with pytest.raises(MessageError, match="as in 'camera_covered'"):
            client.ask("vision", "fault", {"text": " "})


def test_there_is_one_camera(robot: str) -> None:
    with Truth(robot), camera_of(config(robot)), Client(robot) as client:
        assert client.vision(timeout=10.0) is not None
        with pytest.raises(AlreadyRunning, match="already has a 'vision' service"):
            run_vision(config(robot), stop=threading.Event())


def test_a_robot_without_a_camera_is_told(robot: str) -> None:
    with pytest.raises(ConfigError, match="has no signal with `source: vision`"):
        run_vision(RobotConfig.model_validate(arm_description(robot)))
    with pytest.raises(ConfigError, match="has no variant 'best'"):
        run_vision(config(robot), "best")


@pytest.mark.slow
def test_top_and_the_recorder_show_what_is_seen(robot: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with Truth(robot), camera_of(config(robot)), Service(robot, "recorder") as service:
        with (
            Recorder(service.session, robot, RecordingWriter(tmp_path / "seen.mcap", robot, Catalogue({}))),
            Client(robot) as client,
        ):
            assert client.vision(timeout=10.0) is not None
            watch(robot, True, ())
        report = capsys.readouterr().out
        assert "tool_tip_position" in report
        assert "2/2" in report
    assert len(list(read(tmp_path / "seen.mcap", [keys.vision(robot)]))) > 0


@pytest.mark.long
@pytest.mark.parametrize("has_camera", [True, False])
def test_top_misses_a_camera_only_where_there_is_one(
    robot: str, has_camera: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    with Service(robot, "hal") as service:
        stop = threading.Event()
        status = partial(Status, service="hal", state="running", facts={"camera": has_camera})
        telling = threading.Thread(target=service.run, args=(lambda: status(stamp_ns=time.time_ns()), stop))
        telling.start()
        try:
            watch(robot, True, ())
        finally:
            stop.set()
            telling.join()
    lines = capsys.readouterr().out.splitlines()
    absent = {name for name in ("vision", "model", "recorder") for line in lines if name in line and "absent" in line}
    assert absent == ({"vision", "model"} if has_camera else {"model"})


def test_any_program_may_be_the_camera(robot: str) -> None:
    program = subprocess.Popen([sys.executable, str(EXAMPLE), robot, "20"])
    try:
        with Client(robot) as client:
            frame = client.vision(timeout=15.0)
            assert frame is not None
            assert frame.source == "camera"
            assert frame.values["tool_tip_position"].shape == (3,)
            assert client.alive() >= {"vision"}
    finally:
        program.kill()
        program.wait()


@pytest.mark.slow
def test_the_frame_of_the_documentation_is_one(robot: str) -> None:
    blocks = (EXAMPLE.parents[1] / "docs" / "keys.md").read_text().split("```python\n")[1:]
    (program,) = [block.split("```")[0] for block in blocks if "vision/sample" in block.split("```")[0]]
    program = program.replace("ENDPOINT", endpoint(robot, "model")).replace("gemuco/kxr_humanoid/", f"gemuco/{robot}/")
    with Service(robot, "model") as model:
        frames = model.newest(keys.vision(robot), Sample)
        for _ in range(5):
            exec(program, {})
            if frames.wait(2.0) is not None:
                break
        last = frames.last()
    assert frames.rejected == 0, frames.rejected_text
    assert last is not None
    assert last.message.source == "camera"
    np.testing.assert_array_equal(last.message.values["tool_tip_position"], [0.12, -0.05, 0.31])
    assert last.message.valid["tool_tip_position"].all()


class Bench:
    """Freshness with both newest samples in hand."""

    def __init__(self) -> None:
        self.clock = ManualClock()
        self.hal: Arrival[Sample] | None = None
        self.seen: Arrival[Sample] | None = None
        self.freshness = Freshness(config(), lambda: self.hal, self.clock, lambda: self.seen)
        truth = HandWorld("short").truth()
        self.tip = truth.pop("tool_tip_position")
        self.body = truth

    def now(self, values: dict[str, np.ndarray], age: float = 0.0) -> Arrival[Sample]:
        return Arrival(sample(values, age=age), self.clock.monotonic())


def test_each_signal_is_fresh_for_as_long_as_its_own_stale_after() -> None:
    bench = Bench()
    bench.hal, bench.seen = bench.now(bench.body), bench.now({"tool_tip_position": bench.tip}, age=0.01)
    assert list(bench.freshness.take()[1]) == ["joint_position", "center_of_gravity", "tool_tip_position"]
    assert all(np.isfinite(value).all() for value in bench.freshness.take()[1].values())
    bench.clock.advance(0.1)
    fresh, values = bench.freshness.take()
    assert fresh is None, "the HAL is silent"
    assert np.isnan(values["joint_position"]).all()
    np.testing.assert_array_equal(values["tool_tip_position"], bench.tip)
    bench.hal = bench.now(bench.body)
    bench.clock.advance(0.019)
    assert bench.freshness.take()[0] is bench.hal
    bench.clock.advance(0.1)
    bench.hal = bench.now(bench.body)
    fresh, values = bench.freshness.take()
    assert fresh is bench.hal
    assert np.isnan(values["tool_tip_position"]).all(), "older than 0.2 s"


def test_values_of_one_time_are_judged_and_learned_also_if_the_camera_is_late() -> None:
    bench, units = Bench(), {"joint_position": "rad", "center_of_gravity": "m", "tool_tip_position": "m"}
    sizes = {"joint_position": 2, "center_of_gravity": 2, "tool_tip_position": 2}
    random = np.random.default_rng(0)
    rows = {name: random.normal(size=(60, size)) for name, size in sizes.items()}
    schema, _ = fit([rows], TrainConfig(hidden=(8,), epochs=1), [("joint_position",)], units=units)
    trust = Trust(config(), bench.freshness, lambda: schema, None, bench.clock)
    for step in range(40):  # the body moves: every value is the time of its measurement, and a frame is 60 ms late
        bench.clock.advance(0.01)
        now = bench.clock.monotonic()
        body = {"joint_position": np.full(2, now), "center_of_gravity": np.full(2, now)}
        bench.hal = bench.now(body)
        if step % 5 == 4:
            bench.seen = bench.now({"tool_tip_position": np.full(2, now - 0.06)}, age=0.06)
        trust.tick()
        if step < 15:
            continue
        fresh, values = bench.freshness.together()
        assert fresh is bench.hal
        np.testing.assert_allclose(values.flat, values["tool_tip_position"][0], atol=1e-6)
        assert bench.freshness.take()[1]["joint_position"][0] == now, "an estimate is of the newest values"
        assert now - values["joint_position"][0] < 0.12
    bench.freshness.distrust = Distrust(np.arange(6) == 1, {})
    hidden = bench.freshness.together()[1]
    assert np.isnan(hidden.flat).tolist() == (np.arange(6) == 1).tolist()
    assert bench.freshness.together()[1] is hidden, "one object for the same values"
    bench.clock.advance(1.1)
    assert bench.freshness.together()[0] is None
    bench.hal = bench.now(bench.body)
    assert bench.freshness.together()[1] is bench.freshness.take()[1], "nothing was aligned for a second"


def test_a_signal_is_taken_from_its_own_source_and_no_other() -> None:
    bench = Bench()
    bench.hal = bench.now(bench.body | {"tool_tip_position": bench.tip})
    bench.seen = bench.now({"joint_position": np.zeros(2)})
    fresh, values = bench.freshness.take()
    assert fresh is bench.hal
    assert np.isnan(values["tool_tip_position"]).all()
    np.testing.assert_array_equal(values["joint_position"], bench.body["joint_position"])


def test_collected_data_have_what_the_camera_sees() -> None:
    dataset = collect_direct(config(), request=Request(("short",), 20)).dataset
    assert np.isfinite(dataset.rows()[:, -2:]).any()


def test_the_command_line_finds_who_plays_a_fault(robot: str, capsys: pytest.CaptureFixture[str]) -> None:
    def play(arguments: dict[str, str]) -> dict[str, str]:
        if arguments["text"] == "camera_dropped":
            raise ValueError("'camera_dropped' is not a part that can break.")
        return {"text": f"The simulator plays {arguments['text']}."}

    with Truth(robot) as truth, camera_of(config(robot)), Client(robot) as client:
        truth.service.verb("fault", play)
        assert client.vision(timeout=10.0) is not None
        ask_robot(robot, "fault", ("camera_covered",), (), False, ())
        assert "The camera sees nothing." in capsys.readouterr().out
        ask_robot(robot, "fault", ("tool_changed", "long"), (), False, ())
        assert "The simulator plays tool_changed long." in capsys.readouterr().out
        with pytest.raises(RemoteError, match=r"not a part that can break.*nothing that can happen here"):
            ask_robot(robot, "fault", ("camera_dropped",), (), False, ())
