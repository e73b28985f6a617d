"""A HAL and a model service that say what a test tells them to, over real sessions."""

import threading
import time
from types import TracebackType
from typing import Any, Self

import numpy as np

from services.process.service import Service
from services.watch.snapshot import Newest, RobotSnapshot
from services.wire import keys
from services.wire.messages import Anomaly, Applied, Estimates, Holder, Sample, Status, Update

BOTH = frozenset({"hal", "model"})
ELEMENTS = ["shoulder", "elbow"]
DESCRIBED = {
    "signals": {
        "joint_position": {"unit": "rad", "elements": ELEMENTS, "source": "hal"},
        "muscle_tension": {"unit": "N", "elements": ["biceps"], "source": "hal"},
    },
    "command": {"signal": "joint_position", "time_to_live": 0.2},
    "limits": {"joint_position": {"low": -1.0, "high": 1.0, "rate": 1.0}},
    "conditions": [],
}


def sample(silent: bool = False, source: str = "can") -> Sample:
    angles = np.array([0.25, np.nan if silent else -0.5])
    return Sample(
        cycle=1, source=source, complete=not silent, stamp_ns=time.time_ns(),
        values={"joint_position": angles, "muscle_tension": np.array([20.0])},
        age={"joint_position": np.array([0.001, 2.0 if silent else 0.001]), "muscle_tension": np.array([0.001])},
        valid={"joint_position": np.array([True, not silent]), "muscle_tension": np.array([True])},
    )  # fmt: skip


def estimates(silent: bool = False) -> Estimates:
    return Estimates(
        cycle=1, stamp_ns=time.time_ns(),
        values={"joint_position": np.array([0.25, -0.48 if silent else -0.5]), "muscle_tension": np.array([20.0])},
        estimated={"joint_position": np.array([False, silent]), "muscle_tension": np.array([False])},
        std={"joint_position": np.array([0.0, 0.02 if silent else 0.0]), "muscle_tension": np.array([0.0])},
        method={"joint_position": "mask" if silent else "measured", "muscle_tension": "measured"},
        mask={"joint_position": "muscle_tension" if silent else "", "muscle_tension": ""},
        residual={"joint_position": 0.0, "muscle_tension": 0.0},
    )  # fmt: skip


def anomaly(verdict: str = "normal") -> Anomaly:
    return Anomaly(
        cycle=1, score=30.0 if verdict == "anomaly" else 5.0, threshold=20.0, is_anomaly=verdict == "anomaly",
        blamed="muscle_tension.biceps", contribution={}, verdict=verdict, stamp_ns=time.time_ns(),
    )  # fmt: skip


def seen(silent: bool = False, age: float = 0.01, **other: Any) -> RobotSnapshot:
    """RobotSnapshot of both services, whose messages have this age [s]; `silent` is the elbow's encoder."""
    facts: dict[str, Any] = {
        "robot": "arm", "alive": BOTH, "hal": DESCRIBED, "sample": Newest(sample(silent), age),
        "estimate": Newest(estimates(silent), age), "anomaly": Newest(anomaly(), age),
    }  # fmt: skip
    return RobotSnapshot(**(facts | other))


class TalkingRobot:
    """Publishes at 20 Hz from a thread what `silent` and `verdict` say, until its services are ended."""

    def __init__(self, robot: str) -> None:
        self.robot = robot
        self.silent, self.verdict = False, "normal"
        self.asked: list[str] = []
        self._services: dict[str, Service] = {}
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._talk, daemon=True)
        self._lock = threading.Lock()

    def __enter__(self) -> Self:
        self.start("hal")
        self.start("model")
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stop.set()
        self._thread.join()
        for name in list(self._services):
            self.end(name)

    def start(self, name: str) -> None:
        about: dict[str, Any] = dict(DESCRIBED) if name == "hal" else {"biases": {"light": [0.0], "heavy": [1.0]}}
        service = Service(self.robot, name, describe=lambda: about)
        service.__enter__()
        for verb in ("enable", "stop", "reset", "estop", "lease", "release") if name == "hal" else ("engage",):
            service.verb(verb, lambda _, verb=verb: self._answer(verb))  # type: ignore[misc]
        with self._lock:
            self._services[name] = service

    def end(self, name: str) -> None:
        with self._lock:
            service = self._services.pop(name)
        service.__exit__(None, None, None)

    def _answer(self, verb: str) -> dict[str, Any]:
        self.asked.append(verb)
        return {"mode": "off", "number": 1, "complete": True}

    def _talk(self) -> None:
        publishers: dict[tuple[int, str], Any] = {}

        def put(service: Service, key: str, message: Any) -> None:
            which = (service.boot, key)
            if which not in publishers:
                publishers[which] = service.publisher(key, type(message))
            publishers[which].put(message)

        robot = self.robot
        while not self._stop.wait(0.05):
            with self._lock:
                for name, service in self._services.items():
                    stamp = time.time_ns()
                    loops = {name: {"rate_wanted": 20.0, "rate": 20.0, "late_p99": 1e-3, "late_max": 2e-3}}
                    put(
                        service,
                        keys.status(robot, name),
                        Status(service=name, state="running", loops=loops, stamp_ns=stamp),
                    )
                    if name == "hal":
                        nothing = np.full(2, np.nan)
                        put(service, keys.sample(robot), sample(self.silent))
                        put(service, keys.applied(robot), Applied(
                            cycle=1, mode="off", signal="joint_position", desired=nothing, values=nothing,
                            limited_by=[], sender=0, stamp_ns=stamp,
                        ))  # fmt: skip
                        put(service, keys.holder(robot), Holder(name="", holder=0, stamp_ns=stamp))
                    else:
                        put(service, keys.estimate(robot), estimates(self.silent))
                        put(service, keys.anomaly(robot), anomaly(self.verdict))
                        put(service, keys.update(robot), Update(
                            active=False, model_version=0, window=0, dropped=0, loss=0.0, bias=np.array([0.2]),
                            stamp_ns=stamp,
                        ))  # fmt: skip
