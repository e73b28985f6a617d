"""The metrics of robots, over HTTP, and the alert rules and the dashboard that use them."""

import json
import re
import socket
import threading
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from ros_listener import eventually, free_port
from talking_robot import TalkingRobot, seen

from services.errors import ServiceError

pytest.importorskip("prometheus_client")

from services.metrics.collector import COUNTERS, FAMILIES, values_of
from services.metrics.serve import serve_metrics

DEPLOY = Path(__file__).parents[2] / "deploy" / "prometheus"


@contextmanager
def metrics(*robots: str) -> Iterator[str]:
    port, stop = free_port(), threading.Event()
    thread = threading.Thread(target=serve_metrics, args=(robots, "127.0.0.1", port, (), stop), daemon=True)
    thread.start()
    try:
        yield f"http://127.0.0.1:{port}/metrics"
    finally:
        stop.set()
        thread.join(15.0)
        assert not thread.is_alive()


def scraped(url: str) -> dict[str, float]:
    try:
        with urllib.request.urlopen(url, timeout=5.0) as answer:
            lines = answer.read().decode().splitlines()
    except OSError:
        return {}
    return {line.rpartition(" ")[0]: float(line.rpartition(" ")[2]) for line in lines if not line.startswith("#")}


@pytest.mark.long
def test_a_lost_sensor_is_in_the_metrics_and_goes(robot: str):
    element = f'{{element="elbow",robot="{robot}",signal="joint_position"}}'
    with TalkingRobot(robot) as talking, metrics(robot) as url:
        expected = {
            f'gemuco_elements{{robot="{robot}",state="measured"}}': 3,
            "gemuco_element_estimated" + element: 0,
            f'gemuco_robot_severity{{robot="{robot}"}}': 0,
            f'gemuco_loop_late_seconds{{loop="hal",quantile="0.99",robot="{robot}",service="hal"}}': 1e-3,
            f'gemuco_motors{{mode="off",robot="{robot}"}}': 1,
            f'gemuco_lease_held{{robot="{robot}"}}': 0,
            f'gemuco_anomaly_score{{robot="{robot}"}}': 5.0,
        }  # they come with several messages, in any order
        eventually(lambda: expected.items() <= scraped(url).items())
        talking.silent = True
        eventually(lambda: scraped(url).get("gemuco_element_estimated" + element) == 1)
        unit = f'{{element="elbow",robot="{robot}",signal="joint_position",unit="rad"}}'
        assert scraped(url)["gemuco_element_std" + unit] == 0.02
        talking.silent = False
        eventually(lambda: scraped(url).get("gemuco_element_estimated" + element) == 0)
        talking.end("model")
        up = f'gemuco_service_up{{robot="{robot}",service="model"}}'
        eventually(lambda: scraped(url).get(up) == 0)


def test_a_fleet_is_served_from_its_statuses(robot: str):
    with TalkingRobot(robot), metrics() as url:
        eventually(lambda: scraped(url).get(f'gemuco_service_up{{robot="{robot}",service="hal"}}') == 1)
        assert not [name for name in scraped(url) if name.startswith("gemuco_element_") and robot in name]


def test_a_taken_port_is_one_sentence(robot: str):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(ServiceError, match=rf"cannot be served at 127.0.0.1:{port}: Address already in use"):
            serve_metrics([robot], "127.0.0.1", port, (), threading.Event())


def test_a_sensor_that_is_unknown_has_no_value():
    names = {name for name, labels, _ in values_of(seen(silent=True)) if "elbow" in labels}
    assert {"gemuco_element_std", "gemuco_element_age_seconds"} <= names
    assert names <= set(FAMILIES)


def published() -> set[str]:
    return {f"{name}_total" if name in COUNTERS else name for name in FAMILIES}


@pytest.mark.parametrize("file", ["gemuco.rules.yml", "dashboard.json"])
def test_rules_and_dashboard_use_metrics_that_exist(file: str):
    text = (DEPLOY / file).read_text()
    used = set(re.findall(r"\bgemuco_[a-z_]+", text))
    assert used
    assert used <= published()


def test_the_dashboard_is_whole():
    dashboard = json.loads((DEPLOY / "dashboard.json").read_text())
    ids = [panel["id"] for panel in dashboard["panels"]]
    assert len(set(ids)) == len(ids)
    assert all(panel["targets"] and panel["gridPos"]["w"] <= 24 for panel in dashboard["panels"])
    shown = " ".join(target["expr"] for panel in dashboard["panels"] for target in panel["targets"])
    assert {"gemuco_elements", "gemuco_anomaly_score", "gemuco_loop_late_seconds", "gemuco_bus_load_ratio"} <= set(
        re.findall(r"gemuco_[a-z_]+", shown)
    )
