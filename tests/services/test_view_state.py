"""What the page shows, without a browser and without a network."""

from dataclasses import replace as replaced
from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import replace
from talking_robot import BOTH, DESCRIBED, anomaly, seen

from hal.config import load_robot
from services.view.bias_map import BiasPicture, project
from services.view.charts import Chart, Line, ticks
from services.view.controls import Outcome
from services.view.figure import Body
from services.view.markup import banner_html, facts_html, services_html, signals_html
from services.view.page import LINGERS, Steady, source
from services.view.scene import wire_colors
from services.view.styles import with_ending
from services.view.trail import POINTS, Trail
from services.watch.service_rows import Level, service_rows
from services.watch.signal_rows import Kind, signal_rows
from services.watch.snapshot import Newest, held
from services.watch.trouble import Trouble, troubles, verdict
from services.wire.messages import Holder, Status
from simulators.robots.musashi_arm.model import ROUTES

ROBOTS = Path(__file__).parents[2] / "robots"


def test_old_values_are_never_shown_as_fresh():
    found = signal_rows(seen(age=3.0))
    assert [row.kind for row in found] == [Kind.OLD] * 3
    assert found[0].age == pytest.approx(3.001)
    html = signals_html(found)
    assert "measured" not in html
    assert "3.0 s" in html


def test_worse_is_shown_at_once_and_better_after_a_while():
    good, bad, steady = [], [Trouble(Level.TROUBLE, "b")], Steady()
    assert steady.show(good, 0.0) is good
    assert steady.show(bad, 0.1) is bad
    assert steady.show(good, 0.5) is bad
    assert steady.show(good, 0.2 + LINGERS) is good


def test_services_that_are_gone_or_silent_are_not_shown_as_running():
    status = Status(service="model", state="running", loops={"estimation": {"rate": 200.0, "rate_wanted": 200.0}})
    found = {
        row.name: row for row in service_rows(seen(alive=frozenset({"hal"}), statuses={"model": Newest(status, 9.0)}))
    }
    assert (found["model"].state, found["hal"].state) == ("gone", "silent")
    assert "heard 9.0 s ago" in services_html(tuple(found.values()))


def test_whatever_came_over_the_network_is_escaped():
    evil = "<script>alert(1)</script>"
    signals = {"signals": {evil: {"unit": evil, "elements": [evil], "source": "hal"}}, "command": {}, "limits": {}}
    moment = seen(
        hal=signals, holder=Newest(Holder(name=evil, holder=3, left=1.0), 0.0),
        statuses={"hal": Newest(Status(service="hal", state=evil, text=evil, loops={evil: {}}), 0.0)},
    )  # fmt: skip
    rows = signal_rows(moment)
    pages = [
        signals_html(rows), services_html(service_rows(moment)), banner_html(troubles(moment, rows)),
        facts_html(moment, evil, "", Outcome(0.0, False, evil)),
        BiasPicture().svg(project({evil: [0.0, 1.0], "b": [1.0, 0.0]}, np.zeros((1, 2))), False),
    ]  # fmt: skip
    assert not [html for html in pages if "<script" in html]


def test_where_data_come_from():
    assert source(seen()) == "robot (can)"
    assert source(seen(alive=BOTH | {"simulator"})) == "simulated robot"
    assert source(seen(age=9.0)) == "no samples"


@pytest.mark.parametrize("size", [1, 2, 5])
def test_p_is_mapped_whatever_its_size(size):
    random = np.random.default_rng(0)
    biases = {name: random.normal(size=size) for name in ("a", "b", "c")}
    found = project(biases, np.array([biases["b"] * 0.9, biases["b"]]))
    assert found is not None
    assert found.nearest == "b"
    assert found.distance == pytest.approx(0.0)
    assert found.path.shape == (2, 2)
    assert "b</text>" in BiasPicture().svg(found, False)


def test_the_plane_of_many_dimensions_keeps_distances_that_lie_in_it():
    found = project({"a": [0, 0, 0], "b": [3, 0, 0], "c": [0, 4, 0]}, np.zeros((0, 3)))
    assert np.linalg.norm(found.conditions["b"] - found.conditions["c"]) == pytest.approx(5.0)


def test_a_body_without_p_has_no_map():
    assert project({"": []}, np.zeros((0, 0))) is None


def test_the_map_does_not_jump_when_p_comes_back():
    picture, biases = BiasPicture(), {"a": [0.0, 0.0], "b": [1.0, 1.0]}
    picture.svg(project(biases, np.array([[3.0, 3.0]])), False)
    far = picture.svg(project(biases, np.array([[3.0, 3.0]])), False)
    near = picture.svg(project(biases, np.array([[0.5, 0.5]])), False)
    places = [[part.split(" class")[0] for part in svg.split("<rect")[2:4]] for svg in (far, near)]
    assert places[0] == places[1]


def test_gaps_stay_gaps_in_a_plot():
    values = np.array([1.0, 2.0, np.nan, 3.0, 4.0])
    svg = Chart(100).svg(np.linspace(-4, 0, 5), [Line("a", values, "#fff")], "rad", "a")
    curve = next(part for part in svg.split("<path") if 'stroke="#fff"' in part)
    assert curve.count("M") == 2


def test_an_estimate_has_a_band_that_stays_in_the_frame():
    values, half = np.array([1.0, 2.0, np.nan, 3.0, 4.0]), np.array([0.1, 0.1, 0.1, 0.2, 1e6])
    svg = Chart(100).svg(np.linspace(-4, 0, 5), [Line("a", values, "#fff", half=half)], "rad", "a")
    bands = [part.split('"')[1] for part in svg.split("<polygon ")[1:]]
    assert [len(band.split()) for band in bands] == [4, 4]
    heights = [float(corner.split(",")[1]) for band in bands for corner in band.split()]
    assert all(0.0 <= height <= 100.0 for height in heights)


@pytest.mark.parametrize("ends", [(0.0, 1.0), (-0.031, 0.027), (1e4, 1e4 + 3), (-1e-5, 1e-5)])
def test_ticks_are_few_and_inside(ends):
    found = ticks(*ends)
    assert 2 <= len(found) <= 6
    assert ends[0] <= found[0] <= found[-1] <= ends[1] + 1e-12


def test_a_trail_is_bounded_and_knows_what_vanished():
    trail = Trail()
    for index in range(POINTS + 50):
        moment = seen(silent=index > POINTS)
        trail.add(0.25 * index, moment, signal_rows(moment))
    curves = trail.curves(["joint_position.elbow", "nothing"], 0.25 * index)
    assert curves.measured.shape == (2, POINTS)
    assert curves.time[-1] == 0.0
    assert np.isnan(curves.measured[0, -1])
    assert curves.estimated[0, -1] == -0.48
    assert curves.std[0, -1] == 0.02
    assert np.isnan(curves.measured[1]).all()


def test_a_blamed_part_needs_a_verdict():
    early = Newest(replace(anomaly("anomaly"), verdict=""), 0.01)
    assert verdict(seen(anomaly=early)).blamed == ""
    assert "not known yet" in str(troubles(seen(anomaly=early), ())[0])
    assert verdict(seen(anomaly=Newest(anomaly("anomaly"), 0.01))).blamed == "muscle_tension.biceps"


def test_an_anomaly_below_the_threshold_of_single_samples_is_explained():
    large, small = anomaly("anomaly"), replace(anomaly("anomaly"), score=18.7)
    assert "lasts" not in str(troubles(seen(anomaly=Newest(large, 0.01)), ())[0])
    assert "small and lasts. Score 18.7, threshold 20.0" in str(troubles(seen(anomaly=Newest(small, 0.01)), ())[0])


def test_a_paused_replay_is_shown_as_present():
    status = Status(service="hal", state="running", facts={"replay": {"paused": True}})
    moment = seen(age=9.0, statuses={"hal": Newest(status, 0.5)})
    assert {row.kind for row in signal_rows(moment)} == {Kind.OLD}
    assert {row.kind for row in signal_rows(held(moment))} == {Kind.MEASURED}
    playing = seen(age=9.0, statuses={"hal": Newest(replace(status, facts={"replay": {"paused": False}}), 0.5)})
    assert held(playing) is playing


@pytest.mark.long
def test_the_drawn_wires_are_those_of_the_simulator():
    robot = load_robot(ROBOTS / "musashi_arm.yaml")
    body = Body(robot.folder / robot.urdf)
    assert robot.wires.keys() == ROUTES.keys()
    links = sorted(body.links, key=lambda link: len(body.carried_by(link)))  # frame k is behind k joints
    for name, route in ROUTES.items():
        assert robot.wires[name] == tuple((links[via.frame], via.x, via.y, via.z) for via in route)


@pytest.mark.parametrize(("tension", "is_red"), [(0.0, False), (280.0, True), (1000.0, True)])
def test_a_wire_is_colored_by_its_tension(tension, is_red):
    moment = seen(hal=DESCRIBED | {"limits": {"muscle_tension": {"soft_high": 280}}})
    rows = [replaced(row, value=tension) if row.unit == "N" else row for row in signal_rows(moment)]
    (color,) = wire_colors(moment, rows, ["biceps"])
    assert bool(color[0] > color[2]) is is_red
    (old,) = wire_colors(moment, [replaced(row, kind=Kind.OLD) for row in rows], ["biceps"])
    assert np.ptp(old) < 20  # grey


def test_a_camera_sees_the_whole_robot():
    body = Body(load_robot(ROBOTS / "musashi_arm.yaml").folder / "../simulators/assets/musashi_arm/musashi_arm.urdf")
    center, radius = body.room()
    ends = np.array([pose[:3, 3] for pose in body.poses({}).values()])
    assert np.linalg.norm(ends - center, axis=1).max() < 1.3 * radius
    assert 0.2 < radius < 0.6  # an arm of 0.5 m


def test_a_page_says_when_its_program_has_ended():
    html = b"<html><head></head><body><div id=root></div></body></html>"
    assert b"This page has ended" in with_ending(html)
    assert with_ending(html).endswith(b"</body></html>")
    assert with_ending(b"\x00\x01") == b"\x00\x01"
