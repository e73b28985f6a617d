"""The demo in a terminal, its page and its report."""

import io
import math
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from rich.console import Console
from talking_robot import TalkingRobot

from hal.config import load_robot
from hal.errors import ConfigError
from services import extras
from services.client import Client
from services.demo import demo, report
from services.demo.actor import Stage
from services.demo.gauges import Ranges, States, bar, sparkline, strip
from services.demo.live_view import LiveView, Play, Screen
from services.demo.page import link_in
from services.demo.report import Ending
from services.extras import MissingExtra
from services.watch.signal_rows import Kind, SignalRow

ROBOT = load_robot(Path(__file__).parents[2] / "robots" / "musashi_arm.yaml")
PNG = b"\x89PNG\r\n\x1a\n"
STAGES = (
    Stage("moves", 0.0, 5.0, ("6 targets, 0.12 rad away",), True),
    Stage("loses <an> encoder", 5.0, 9.0, ("marked as estimated after 25 ms", "0.09 rad wrong"), False),
)


def row(kind: Kind, value: float = 0.5, **other: str) -> SignalRow:
    return SignalRow("joint_position", "elbow", "rad", kind, value, **other)


def until(view: LiveView, is_shown: Callable[[str], bool], sink: io.StringIO) -> str:
    deadline = time.monotonic() + 60.0
    while True:
        sink.truncate(0)
        view.turn()
        if is_shown(sink.getvalue()):
            return sink.getvalue()
        assert time.monotonic() < deadline, sink.getvalue()
        time.sleep(0.05)


@pytest.mark.parametrize(("share", "filled"), [(0.0, ""), (0.5, "█████"), (1.0, "██████████"), (0.26, "██▋")])
def test_a_bar_is_filled_up_to_its_share(share: float, filled: str) -> None:
    assert bar(share, 10, "cyan").plain == filled + "─" * (10 - len(filled))


def test_what_has_no_value_has_no_bar() -> None:
    assert bar(math.nan, 4, "cyan").plain == "┄┄┄┄"
    assert strip([0.0, math.nan, 1.0], ["", "", ""]).plain == "▁ ✕ █ "


def test_a_score_below_its_threshold_is_in_the_lower_half() -> None:
    text = sparkline([(math.nan, True), (0.01, True), (0.9, True), (1.1, True), (100.0, False)], 4).plain
    assert text == "▁▄▅█"


def test_an_element_that_is_measured_again_is_recovered_for_a_while() -> None:
    states = States()
    assert states.of(row(Kind.MEASURED), 0.0)[0] == "measured"
    assert states.of(row(Kind.ESTIMATED, source="muscle_length"), 1.0) == ("estimated", "estimated from muscle_length")
    assert states.of(row(Kind.ESTIMATED, distrust="distrusted: frozen"), 2.0)[0] == "distrusted"
    assert states.of(row(Kind.MASKED, math.nan), 3.0)[0] == "lost"
    assert states.of(row(Kind.MEASURED), 4.0) == ("recovered", "measured again after 3.0 s")
    assert states.of(row(Kind.MEASURED), 4.1 + States.RECOVERED_FOR)[0] == "measured"


def test_a_range_is_that_of_the_robot_file_or_what_was_seen() -> None:
    known, unknown = Ranges({"joint_position.elbow": (-1.0, 1.0)}), Ranges({})
    assert [known.share(row(Kind.MEASURED, value)) for value in (-2.0, 0.0, 0.5, 3.0)] == [0.0, 0.5, 0.75, 1.0]
    assert [unknown.share(row(Kind.MEASURED, value)) for value in (0.0, 1.0, 0.25)] == [0.5, 1.0, 0.25]


@pytest.mark.parametrize(("width", "height"), [(80, 24), (160, 50)])
@pytest.mark.long
def test_the_view_of_a_robot_fits_its_terminal(robot: str, width: int, height: int) -> None:
    sink = io.StringIO()
    console = Console(file=sink, force_terminal=True, width=width, height=height, color_system=None)
    play = Play(["moves", "loses <an> encoder", "learns"], STAGES, ["joint_position"], lambda: ["the last line"])
    with TalkingRobot(robot) as talking, Client(robot) as client:
        view = LiveView(console, ROBOT, client, play, ["hal", "model"])
        view.report("[bold](c)[/] An event.")
        with view:
            shown = until(view, lambda text: "-0.500" in text and "lateness" in text and "threshold" in text, sink)
            for text in (
                "✓ moves",
                "✗ loses <an> encoder",
                "0.09 rad wrong",
                "learns",
                "(c) An event.",
                "the last line",
            ):
                assert text in shown
            talking.silent = True
            until(view, lambda text: "± 0.020" in text and "estimated from muscle_tension" in text, sink)
            talking.silent, talking.verdict = False, "anomaly"
            until(view, lambda text: "measured again after" in text and "ANOMALY: muscle_tension.biceps" in text, sink)
            lines = view.view(view._snapshot(), time.monotonic()).renderables
        assert len(lines) < height


def test_without_a_terminal_every_event_is_a_line() -> None:
    console = Console(record=True, width=100)
    screen = Screen(console)
    with screen.live(ROBOT, None, Play((), (), (), list), ()):  # type: ignore[arg-type]
        screen.report("[bold](a)[/] It moves.")
        screen.turn()
    assert console.export_text() == "(a) It moves.\n"


def test_the_link_is_read_when_its_line_is_whole(tmp_path: Path) -> None:
    log = tmp_path / "view.log"
    assert link_in(log) == ""
    log.write_text("http://127.0.0.1:809")
    assert link_in(log) == ""
    log.write_text("http://127.0.0.1:8090/secret  With buttons.\n")
    assert link_in(log) == "http://127.0.0.1:8090/secret"


def test_a_missing_page_is_found_before_anything_is_collected(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    missing = extras.is_missing
    monkeypatch.setattr(extras, "is_missing", lambda name: name == "viser" or missing(name))
    with pytest.raises(MissingExtra, match=r"gemuco\[view\]"):
        demo.play(ROBOT.model_copy(update={"robot": "unseen"}), tmp_path / "unseen.yaml", 1, tmp_path, with_page=True)
    assert not list(tmp_path.iterdir())


def test_a_missing_data_sheet_is_found_before_anything_is_collected(tmp_path: Path) -> None:
    robot = ROBOT.model_copy(update={"robot": "unseen", "folder": tmp_path})
    with pytest.raises(ConfigError, match="There is no EDS file"):
        demo.play(robot, tmp_path / "unseen.yaml", 1, tmp_path)
    assert not list(tmp_path.iterdir())


def test_the_report_is_one_file_that_needs_no_other(tmp_path: Path) -> None:
    picture = tmp_path / "story.png"
    picture.write_bytes(PNG)
    ending = Ending("arm", STAGES, 1, lines=30, estimated=4, rate=100.0, wanted=200.0)
    report.write(ending, tmp_path / "arm.yaml", 7, picture)
    html = (tmp_path / "report.html").read_text()
    assert "Not every expected event was observed." in html
    assert "loses &lt;an&gt; encoder" in html
    assert "because 200 Hz are too much for this machine" in html
    assert "gemuco demo arm.yaml --seed 7" in html
    assert 'src="data:image/png;base64,' in html
    assert "http" not in html  # nothing is loaded from elsewhere
    assert str(tmp_path.parent) not in html.partition("See it again")[0]


@pytest.mark.parametrize(("lines", "estimated", "observed"), [(30, 4, True), (30, 0, False), (3, 3, False)])
def test_all_events_are_observed_only_with_the_remote_client(lines: int, estimated: int, observed: bool) -> None:
    assert Ending("arm", STAGES[:1], 0, lines, estimated, 200.0, 200.0).is_observed is observed
    assert not Ending("arm", STAGES, 0, lines, estimated, 200.0, 200.0).is_observed
