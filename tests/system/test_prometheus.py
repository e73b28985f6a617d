"""Prometheus itself reads the metrics, and its alert on a lost sensor begins and ends.

PROMETHEUS names the folder of its programs, if they are not on the path (Debian: `apt install prometheus`).
"""

import json
import os
import shutil
import subprocess
import sys
import threading
import time
import urllib.request
from pathlib import Path

import pytest

sys.path.append(str(Path(__file__).parents[1] / "services"))

from ros_listener import eventually, free_port
from talking_robot import TalkingRobot

pytest.importorskip("prometheus_client")

from services.metrics.serve import serve_metrics

DEPLOY = Path(__file__).parents[2] / "deploy" / "prometheus"
WHERE = os.environ.get("PROMETHEUS", os.environ.get("PATH"))
PROMETHEUS, PROMTOOL = (shutil.which(name, path=WHERE) for name in ("prometheus", "promtool"))
pytestmark = [
    pytest.mark.long,
    pytest.mark.skipif(not (PROMETHEUS and PROMTOOL), reason="no prometheus here; name its folder in PROMETHEUS"),
]


def test_configuration_and_rules_are_clean() -> None:
    for arguments in (["check", "config", "prometheus.yml"], ["check", "rules", "gemuco.rules.yml"]):
        checked = subprocess.run([str(PROMTOOL), *arguments], cwd=DEPLOY, capture_output=True, text=True)
        assert checked.returncode == 0, checked.stdout + checked.stderr
        assert "FAILED" not in checked.stdout


def test_the_metrics_are_clean() -> None:
    from prometheus_client import CollectorRegistry, generate_latest
    from talking_robot import seen

    from services.metrics.collector import RobotCollector

    registry = CollectorRegistry()
    registry.register(RobotCollector(lambda: [seen(silent=True)]))
    checked = subprocess.run([str(PROMTOOL), "check", "metrics"], input=generate_latest(registry), capture_output=True)
    assert checked.returncode == 0, checked.stdout + checked.stderr


def test_an_alert_begins_and_ends_with_a_lost_sensor(tmp_path: Path) -> None:
    robot, port, place = f"alerting_{os.getpid()}", free_port(), free_port()
    text = (DEPLOY / "prometheus.yml").read_text().replace("127.0.0.1:9464", f"127.0.0.1:{port}")
    (tmp_path / "prometheus.yml").write_text(text)
    shutil.copy(DEPLOY / "gemuco.rules.yml", tmp_path)
    stop = threading.Event()
    serving = threading.Thread(target=serve_metrics, args=([robot], "127.0.0.1", port, (), stop), daemon=True)
    command = [
        str(PROMETHEUS), "--config.file=prometheus.yml", f"--web.listen-address=127.0.0.1:{place}",
        f"--storage.tsdb.path={tmp_path / 'data'}", "--log.level=error",
    ]  # fmt: skip

    def alerts() -> set[str]:
        try:
            with urllib.request.urlopen(f"http://127.0.0.1:{place}/api/v1/alerts", timeout=5.0) as answer:
                found = json.load(answer)["data"]["alerts"]
        except OSError:
            return set()
        return {
            f"{one['labels']['alertname']} {one['labels'].get('element', '')}"
            for one in found
            if one["state"] == "firing" and one["labels"].get("robot") == robot
        }

    def scraped() -> bool:
        url = f"http://127.0.0.1:{place}/api/v1/query?query=gemuco_elements"
        try:
            with urllib.request.urlopen(url, timeout=5.0) as answer:
                return robot in answer.read().decode()
        except OSError:
            return False

    with TalkingRobot(robot) as talking, subprocess.Popen(command, cwd=tmp_path) as running:
        serving.start()
        try:
            eventually(scraped, 60.0)
            eventually(lambda: not alerts(), 60.0)
            talking.silent, begun = True, time.monotonic()
            eventually(lambda: "GemucoSensorLost elbow" in alerts(), 60.0)
            fired = time.monotonic() - begun
            talking.silent, begun = False, time.monotonic()
            eventually(lambda: "GemucoSensorLost elbow" not in alerts(), 60.0)
            print(f"The alert fires after {fired:.1f} s and ends after {time.monotonic() - begun:.1f} s.")
        finally:
            running.terminate()
            stop.set()
            serving.join(15.0)
