"""The page over a real socket: what a browser gets, what it may press, and what it cannot do."""

import contextlib
import gzip
import http.client
import logging
import os
import resource
import socket
import threading
import time
import urllib.parse
import urllib.request
from collections.abc import Iterator
from email.message import Message
from pathlib import Path
from typing import Any

import pytest
import viser
from browser import Browser
from recorded_arm import record
from talking_robot import TalkingRobot
from websockets.exceptions import InvalidStatus

from gemuco.dataset import Dataset
from services.errors import ServiceError
from services.recording.replay import run_replay
from services.view import run
from services.view.controls import Controls, why_read_only
from services.view.door import Door, new_token
from services.view.figure import Body
from services.view.scene import Looks
from services.view.site import is_news, open_site
from services.wire.member import Member

ARM = Path(__file__).parents[2] / "simulators/assets/musashi_arm/musashi_arm.urdf"
BUTTONS = {"Engage", "Disengage", "Reset", "Stop", "EMERGENCY STOP", "Record this posture", "Take over and hold"}


TOKEN = "the-secret-of-the-link"


@pytest.fixture(autouse=True)
def known_token(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(run, "new_token", lambda: TOKEN)


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


class Viewing:
    """`gemuco view` in a thread."""

    def __init__(self, robot: str, connect: tuple[str, ...] = (), urdf: Path | None = None) -> None:
        self.port, self._stop = free_port(), threading.Event()
        arguments = (robot, "127.0.0.1", self.port, connect, Looks(urdf), self._stop)
        self._thread = threading.Thread(target=run.view, args=arguments, daemon=True)

    def __enter__(self) -> "Viewing":
        self._thread.start()
        deadline = time.monotonic() + 60.0
        while True:
            with contextlib.suppress(OSError):
                if fetch(self.port, "/")[0] != 503:
                    return self
            assert time.monotonic() < deadline
            time.sleep(0.01)

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join(10.0)
        assert not self._thread.is_alive()


@pytest.fixture
def talking(robot: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[TalkingRobot]:
    monkeypatch.chdir(tmp_path)  # taught samples are written below it
    with TalkingRobot(robot) as found:
        yield found


@pytest.mark.slow
def test_the_page_shows_every_state_and_recovers(talking: TalkingRobot):
    with Viewing(talking.robot) as page, Browser(page.port, token=TOKEN) as browser:
        browser.until(lambda b: "Healthy" in b.text() and "joint_position" in b.text())
        talking.silent = True
        browser.until(lambda b: "joint_position (elbow) is estimated from muscle_tension" in b.text())
        talking.silent, talking.verdict = False, "anomaly"
        browser.until(lambda b: "Most likely wrong: muscle_tension.biceps" in b.text())
        talking.verdict = "normal"
        talking.end("model")
        browser.until(lambda b: "Model service gone" in b.text())
        talking.end("hal")
        browser.until(lambda b: "Robot gone" in b.text() and "k-old" in b.text())
        talking.start("hal")
        talking.start("model")
        browser.until(lambda b: "Healthy" in b.text())


def test_the_camera_sees_the_robot_beside_the_panels_until_it_is_moved(robot: str):
    """A browser reports its whole window first, and the picture beside the panels when they are laid out."""

    def distance(position: tuple[float, ...]) -> float:
        return sum((a - b) ** 2 for a, b in zip(position, center, strict=True)) ** 0.5

    center = Body(ARM).room()[0]
    with Viewing(robot, urdf=ARM) as page, Browser(page.port, token=TOKEN) as browser:
        browser.until(lambda b: len(b.camera) >= 2)  # one for all browsers, and one for the shape of this one
        wide = distance(browser.camera[-1])
        browser.look(442, 800, (1.0, 1.0, 1.0))  # on its way before the browser got the first place
        browser.until(lambda b: distance(b.camera[-1]) > 1.5 * wide)
        browser.look(0, 0)  # minimised
        browser.look(800, 800)
        browser.until(lambda b: distance(b.camera[-1]) < 1.01 * wide)
        browser.look(800, 800)
        browser.look(800, 800, (3.0, 0.0, 0.0))
        count = len(browser.camera)
        browser.look(442, 800, (3.0, 0.0, 0.0))
        time.sleep(0.5)
        assert len(browser.camera) == count


def test_buttons_ask_the_robot(talking: TalkingRobot):
    with Viewing(talking.robot) as page, Browser(page.port, token=TOKEN) as browser:
        browser.until(lambda b: "Healthy" in b.text())
        assert browser.labels() >= BUTTONS
        browser.press("Stop")
        browser.until(lambda b: "stop: done" in b.text())
        browser.press("EMERGENCY STOP")
        browser.until(lambda b: "estop: done" in b.text())
        assert talking.asked == ["stop", "estop"]


@pytest.mark.long
def test_a_posture_is_recorded_from_the_page(talking: TalkingRobot, tmp_path: Path):
    with Viewing(talking.robot) as page, Browser(page.port, token=TOKEN) as browser:
        browser.until(lambda b: "[rad]" in b.text() and "condition" in b.labels())
        browser.press("Record this posture")
        browser.until(lambda b: "needs a name" in b.text())
        browser.fill("condition", "light")
        browser.press("Record this posture")
        browser.until(lambda b: "1 samples are in the file" in b.text())
        talking.silent = True
        browser.until(lambda b: "is estimated from" in b.text())
        browser.press("Record this posture")
        browser.until(lambda b: "is not measured now, so nothing was recorded" in b.text())
    assert len(Dataset.load(tmp_path / "runs" / talking.robot / "taught.npz")) == 1


def test_a_viewer_has_no_buttons(talking: TalkingRobot, tmp_path: Path):
    role = tmp_path / "viewer.json"
    role.write_text('{"metadata": {"gemuco": {"role": "viewer", "robots": ["*"]}}}')
    with Viewing(talking.robot, (str(role),)) as page, Browser(page.port) as browser:
        browser.until(lambda b: "Read only: the role is viewer" in b.text())
        assert not browser.labels() & BUTTONS


def test_who_may_press():
    assert why_read_only(Member(), "arm", "127.0.0.1") == ""
    assert why_read_only(Member("operator", ("*",)), "arm", "localhost") == ""
    assert "role is viewer" in why_read_only(Member("viewer", ("arm",)), "arm", "127.0.0.1")
    assert "not for 'arm'" in why_read_only(Member("operator", ("leg",)), "arm", "127.0.0.1")
    assert "127.0.0.1 only" in why_read_only(Member(), "arm", "0.0.0.0")


def test_a_read_only_page_asks_nothing_even_if_it_is_told_to():
    asked: list[str] = []
    controls = Controls(lambda: asked.append("client"), "Read only: so it is.")  # type: ignore[func-returns-value]
    for verb in ("engage", "stop", "estop", "reset", "dance"):
        outcome = controls.press(verb)
        assert not outcome.is_done
    assert not asked
    assert "no button 'dance'" in outcome.text


@pytest.mark.slow
def test_without_a_robot_a_button_says_why(robot: str):
    with Viewing(robot) as page, Browser(page.port, token=TOKEN) as browser:
        browser.until(lambda b: "No robot" in b.text() and "Engage" in b.labels())
        browser.press("Stop")
        browser.until(lambda b: "Is `gemuco hal` running?" in b.text() and "stop: " in b.text())


def test_the_page_of_somebody_else_may_not_connect(robot: str):
    with Viewing(robot) as page:
        own = f"127.0.0.1:{page.port}"
        for origin in (
            "http://evil.example",
            "http://127.0.0.1.evil.example",
            f"http://127.0.0.1:{page.port + 1}",  # another web server of this machine
            "http://127.0.0.1",
            f"http://localhost:{page.port}",
            "null",
        ):
            with pytest.raises(InvalidStatus, match="403"):
                Browser(page.port, origin=origin, token=TOKEN)
        Browser(page.port, origin=f"http://{own}", token=TOKEN).close()


def fetch(port: int, path: str = "/", **headers: str) -> tuple[int, Message, bytes]:
    """One request, which follows no redirection."""
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=10.0)
    connection.request("GET", path, headers=headers)
    answer = connection.getresponse()
    return answer.status, answer.headers, answer.read()


def test_without_the_link_the_page_is_read_only(talking: TalkingRobot):
    with Viewing(talking.robot) as page:
        for token in ("", "guessed", TOKEN[:-1], f"{TOKEN}x", f"x/{TOKEN}", f"?token={TOKEN}"):
            with pytest.raises(InvalidStatus, match="403"):
                Browser(page.port, token=token)
            status, headers, _ = fetch(page.port, f"/{token}")
            assert status == 303
            other = urllib.parse.urlparse(headers["Location"]).port
        assert other and other != page.port
        with Browser(other) as browser:
            browser.until(lambda b: "Read only: buttons need the link" in b.text() and "Healthy" in b.text())
            assert not browser.labels() & BUTTONS
        with Browser(page.port, token=TOKEN) as operator:
            operator.until(lambda b: "Healthy" in b.text())
            assert operator.labels() >= BUTTONS
        assert talking.asked == []


def test_a_page_asks_whether_its_program_runs(robot: str):
    with Viewing(robot) as page:
        status, _, body = fetch(page.port, f"/{TOKEN}/alive")
        assert (status, body) == (200, b"alive\n")
        assert fetch(page.port, "/alive")[0] == 303
        for more in ({}, {"Accept-Encoding": "gzip"}):
            _, headers, body = fetch(page.port, f"/{TOKEN}", **more)
            assert int(headers["Content-Length"]) == len(body)
            html = gzip.decompress(body) if headers["Content-Encoding"] == "gzip" else body
            assert b"This page has ended" in html


@pytest.mark.long
def test_a_replay_has_its_own_buttons_and_moves_nothing(robot: str, tmp_path: Path):
    files, stop = record(tmp_path / "run.mcap", "arm", 300), threading.Event()
    replaying = threading.Thread(target=run_replay, args=(files, robot, 0.0), kwargs={"stop": stop}, daemon=True)
    replaying.start()
    try:
        with Viewing(robot) as page, Browser(page.port, token=TOKEN) as browser:
            browser.until(lambda b: "A replay that is paused" in b.text())
            browser.until(lambda b: b.props("Stop")["disabled"] and b.props("EMERGENCY STOP")["disabled"])
            browser.until(lambda b: b.props("Take over and hold")["disabled"])
            browser.press("Play")
            browser.until(lambda b: "play: at" in b.text() and "Pause" in b.labels())
            browser.press("Pause")
            browser.until(lambda b: "pause: at" in b.text() and "Play" in b.labels())
    finally:
        stop.set()
        replaying.join(30.0)


def test_no_page_may_frame_it_and_no_cookie_is_set(robot: str):
    with Viewing(robot) as page:
        for path in (f"/{TOKEN}", f"/{TOKEN}/", "/", "/elsewhere", f"/{TOKEN}/nothing"):
            _, headers, _ = fetch(page.port, path)
            assert headers["Content-Security-Policy"] == "frame-ancestors 'none'"
            assert headers["X-Frame-Options"] == "DENY"
            assert headers["Referrer-Policy"] == "no-referrer"
            assert "Set-Cookie" not in headers  # other web servers of this machine would get it


def test_a_foreign_name_for_this_machine_is_refused(robot: str):
    """A page whose name was made to mean 127.0.0.1 is of the same origin for the browser."""
    with Viewing(robot) as page:
        for host in (f"evil.example:{page.port}", "evil.example", f"127.0.0.1.evil.example:{page.port}", ""):
            assert fetch(page.port, f"/{TOKEN}", Host=host)[0] == 403
        assert fetch(page.port, f"/{TOKEN}", Host=f"localhost:{page.port}")[0] == 200


def test_the_link_is_printed_and_new_each_time(robot: str, capsys: pytest.CaptureFixture[str]):
    with Viewing(robot) as page:
        pass
    report = capsys.readouterr().out  # once, when the page has ended: what is printed during a read is lost
    assert f"http://127.0.0.1:{page.port}/{TOKEN}  With buttons: who has this link commands the robot." in report
    assert new_token() != new_token() and len(new_token()) >= 32


def test_nothing_can_be_published_on_the_internet(robot: str):
    site = open_site("127.0.0.1", 0, "x", Door("127.0.0.1"))
    try:
        from viser import _messages

        assert not site._websock_server._incoming_handlers.get(_messages.ShareUrlRequest)
    finally:
        site.stop()


def test_a_browser_is_refused_before_the_page_can_serve(robot: str):
    """viser accepts a browser at once and, while it is being made, serves it an internal error or nothing at all."""
    door, whole, refused = Door("127.0.0.1"), viser.ViserServer.__init__, list[int]()

    def slow(self: viser.ViserServer, *arguments: Any, **options: Any) -> None:
        whole(self, *arguments, **options)  # it listens now, and its maker has not returned
        with pytest.raises(InvalidStatus) as caught:
            Browser(self.get_port())
        refused.append(caught.value.response.status_code)
        refused.append(fetch(self.get_port())[0])

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(viser.ViserServer, "__init__", slow)
        site = open_site("127.0.0.1", 0, "x", door)
    try:
        assert refused == [503, 503]
        Browser(site.get_port()).close()
    finally:
        site.stop()


@pytest.mark.parametrize(("error", "is_shown"), [(AttributeError("x"), True), (ConnectionResetError(), False)])
def test_only_a_browser_that_went_away_is_not_logged(error: Exception, is_shown: bool):
    record = logging.LogRecord("websockets.server", logging.ERROR, "", 0, "x", (), (type(error), error, None))
    assert is_news(record) is is_shown


def test_the_page_needs_nothing_from_elsewhere(robot: str):
    with Viewing(robot) as page, urllib.request.urlopen(f"http://127.0.0.1:{page.port}/{TOKEN}") as answer:
        html = answer.read().decode()
    head = html[: html.index("<body")] if "<body" in html else html
    assert not [tag for tag in head.split("<") if tag.startswith(("link", "script")) and 'src="http' in tag]


def test_a_taken_port_is_one_sentence(robot: str):
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        with pytest.raises(ServiceError, match=f"Port {port} on 127.0.0.1 is taken"):
            open_site("127.0.0.1", port, "x", Door("127.0.0.1"))
    with pytest.raises(ServiceError, match="cannot be served"):
        open_site("203.0.113.7", 8090, "x", Door("203.0.113.7"))


def test_a_missing_package_is_one_sentence(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(__import__("sys").modules, "viser", None)
    with pytest.raises(ServiceError, match=r"pip install 'gemuco\[view\]'"):
        open_site("127.0.0.1", 0, "x", Door("127.0.0.1"))


@pytest.mark.slow
def test_a_browser_that_never_reads_holds_nothing_up(talking: TalkingRobot):
    with Viewing(talking.robot) as page, Browser(page.port, token=TOKEN) as browser:
        browser.until(lambda b: "Healthy" in b.text())
        deaf = socket.create_connection(("127.0.0.1", page.port))
        deaf.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        deaf.sendall(
            b"GET /" + TOKEN.encode() + b" HTTP/1.1\r\nHost: 127.0.0.1\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
            b"Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\nSec-WebSocket-Version: 13\r\n"
            b"Sec-WebSocket-Protocol: viser-v" + viser.__version__.encode() + b"\r\n\r\n"
        )
        before = resident()
        for silent in (True, False) * 4:
            talking.silent = silent
            browser.until(lambda b, silent=silent: ("is estimated from" if silent else "Healthy") in b.text())
        assert resident() - before < 30e6
        deaf.close()


def resident() -> float:
    """Memory of this process [B]."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return float(pages * resource.getpagesize()) if os.name == "posix" else 0.0
