"""HAL in one namespace, model service in the other, a router and clients: started, frozen and killed by name."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import msgpack
import seesaw
import yaml
from link import Link, inside

from hal.config import load_robot
from services.process.supervisor import Supervisor, gemuco_command
from services.security.init import init, placed
from services.security.plan import InstallationPlan, Person
from services.security.signing import sign_model
from services.wire.session import ROUTER_PORT, port

HERE = Path(__file__).parent
PATIENCE = 40.0
ROUTER = f"{Link.ADDRESS['first']}:{ROUTER_PORT}"
VIEWERS = ("viewer", "guest")
"""One person has 32 sessions at the router."""


class Records:
    """What a process wrote down, read on as it grows."""

    def __init__(self, path: Path) -> None:
        self._path, self._at = path, 0
        self._unpacker = msgpack.Unpacker()
        self.rows: list[list[Any]] = []

    def read(self, since: float = 0.0) -> list[list[Any]]:
        """All rows so far whose time is not before `since` [monotonic s]; older ones are forgotten."""
        if self._path.exists():
            with self._path.open("rb") as file:
                file.seek(self._at)
                data = file.read()
            self._at += len(data)
            self._unpacker.feed(data)
            self.rows.extend(self._unpacker)
        place = 1 if self.rows and isinstance(self.rows[0][0], str) else 0
        self.rows = [row for row in self.rows if row[place] >= since]
        return self.rows


class Talker:
    """A remote client in a namespace, driven by lines."""

    def __init__(self, namespace: str, robot: str, record: Path, connect: Path, log: Path, env: dict[str, str]) -> None:
        self.records = Records(record)
        self.process = subprocess.Popen(
            inside(namespace, sys.executable, str(HERE / "observer.py"), robot, str(record), str(connect)),
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=log.open("w"), text=True, bufsize=1, env=env,
        )  # fmt: skip
        self._line()

    def ask(self, service: str, verb: str, **arguments: Any) -> dict[str, Any]:
        """The answer, or `error` and `text`."""
        return self.tell({"ask": [service, verb, arguments]})

    def status(self, service: str) -> dict[str, Any] | None:
        return self.tell({"status": service}).get("ok")

    def tell(self, wanted: dict[str, Any]) -> dict[str, Any]:
        assert self.process.stdin is not None
        self.process.stdin.write(json.dumps(wanted) + "\n")
        return self._line()

    def _line(self) -> dict[str, Any]:
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        if not line:
            raise RuntimeError("An observer ended; see its log.")
        return dict(json.loads(line))

    def close(self) -> None:
        self.process.kill()
        self.process.communicate()


class Stack:
    """The processes of one robot over a link.

    Args:
        folder: For robot file, model, records and logs.
        link: Open already.
        protocol: `tcp`, without security, or `quic` or `tls` with what `gemuco security init` makes.
    """

    def __init__(self, folder: Path, link: Link, protocol: str) -> None:
        self.folder, self.link, self.protocol = folder, link, protocol
        folder.mkdir(parents=True, exist_ok=True)
        self.robot = f"net_{protocol}_{os.getpid()}"
        self.file = folder / "robot.yaml"
        self.file.write_text(yaml.safe_dump(seesaw.description(self.robot), sort_keys=False))
        self.model = folder.parent / "model"
        if not self.model.exists():
            seesaw.train(load_robot(self.file), self.model)
        self.roles = self._secured() if protocol in ("quic", "tls") else self._plain()
        self.supervisor = Supervisor(folder / "logs")
        self.clocks = {name: folder / f"{name}.clock" for name in ("hal", "model")}
        path = os.pathsep.join(str(place) for place in (HERE, HERE.parent / "services", HERE.parents[1]))
        self.env = {**os.environ, "PYTHONPATH": path, "PYTHONUNBUFFERED": "1", "OMP_NUM_THREADS": "1"}
        os.environ.update({name: self.env[name] for name in ("PYTHONPATH", "OMP_NUM_THREADS")})
        self.records = {name: Records(folder / f"{name}.record") for name in ("hal", "model", "timer")}
        self.talkers: dict[str, Talker] = {}
        self.last: dict[str, Any] = {}

    def __enter__(self) -> Self:
        self.supervisor.__enter__()
        for name in ("timer", "router", "simulator", "hal", "model"):
            self.start(name)
            time.sleep(0.3)
        self.here = self.talker("here", self.link.first)
        self.there = self.talker("there", self.link.second)
        self.until(lambda: (self.here.status("hal") or {}).get("state") == "running", "the HAL runs")
        self.until(lambda: (self.here.status("model") or {}).get("state") == "running", "the model runs")
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for child in self.supervisor.children.values():
            child.process.send_signal(signal.SIGCONT)
        for talker in self.talkers.values():
            talker.close()
        self.supervisor.__exit__(kind, error, trace)

    def talker(self, name: str, namespace: str, role: str = "operator") -> Talker:
        """Start a client."""
        made = Talker(
            namespace, self.robot, self.folder / f"{name}.record", self.roles[role], self.folder / f"{name}.log",
            self.env,
        )  # fmt: skip
        self.talkers[name] = made
        return made

    def start(self, name: str, prefix: tuple[str, ...] = ()) -> None:
        """Start a process where it belongs; `prefix` is a command that wraps it."""
        first, second = self.link.first, self.link.second
        witness = (sys.executable, str(HERE / "witness.py"))
        record, clock = str(self.folder / f"{name}.record"), str(self.folder / f"{name}.clock")
        connect = str(self.roles.get(name, ""))
        common = (str(self.file), record)
        hardware = ("chrt", "-f", "55", *witness)  # no computer starves it
        command = {
            "timer": [sys.executable, str(HERE / "timer.py"), record, str(seesaw.RATE)],
            "router": inside(first, *gemuco_command("-v", "router", "--connect", connect)),
            "simulator": inside(first, *hardware, "simulator", *common, "", *([connect] if connect else [])),
            "hal": inside(first, *prefix, *witness, "hal", *common, clock, connect),
            "model": inside(second, *prefix, *witness, "model", *common, clock, str(self.model), connect),
        }[name]  # fmt: skip
        self.supervisor.start(name, command)

    def kill(self, name: str) -> float:
        """As kill -9; returns when [monotonic s]."""
        now = time.monotonic()
        self.supervisor.kill(name)
        return now

    def signal(self, name: str, number: int) -> float:
        """Returns when [monotonic s]."""
        os.killpg(self.supervisor.children[name].process.pid, number)
        return time.monotonic()

    def until(self, happened: Any, what: str, patience: float = PATIENCE) -> None:
        deadline = time.monotonic() + patience
        while not happened():
            if time.monotonic() > deadline:
                raise RuntimeError(f"It did not happen that {what}; see the logs in {self.folder}.")
            time.sleep(0.05)

    def mode(self) -> str:
        """What the HAL's witness saw last; empty if that is not recent."""
        rows = self.records["hal"].read(time.monotonic() - 30.0)
        return str(rows[-1][2]) if rows and time.monotonic() - rows[-1][0] < 0.5 else ""

    def engage(self, side: int) -> None:
        """Have the arm on its way to one side, anew if need be."""

        def follows() -> bool:
            if self.mode() == "fault":
                self.here.ask("hal", "reset")
            if self.mode() not in ("hold", "follow"):
                self.last = self.here.ask("model", "engage")
                if self.last.get("error") == "CommandRefused":  # the drives of a HAL that was killed are in fault
                    self.here.ask("hal", "reset")
                time.sleep(0.3)
            return self.mode() == "follow"

        try:
            self.until(follows, "the robot follows")
        except RuntimeError as error:
            raise RuntimeError(f"{error} It is in '{self.mode()}', and the model says: {self.last}") from None
        self.here.ask("model", "target", signal="joint_position", values=[0.8 * side])

    def _plain(self) -> dict[str, Path]:
        hal = f"{Link.ADDRESS['first']}:{port(self.robot, 'hal')}"
        router = [f"{self.protocol}/{ROUTER}"]
        loopback = f"{self.protocol}/127.0.0.1"
        made: dict[str, dict[str, Any]] = {
            "router": {"listen": {"endpoints": router}},
            "hal": {
                "listen": {"endpoints": [f"{self.protocol}/{hal}", f"{loopback}:{port(self.robot, 'hal')}"]},
                "connect": {"endpoints": router},
            },
            "model": {
                "listen": {"endpoints": [f"{loopback}:{port(self.robot, 'model')}"]},
                "connect": {"endpoints": [f"{self.protocol}/{hal}", *router]},
            },
            "operator": {"mode": "client", "connect": {"endpoints": router}},
            **{name: {"mode": "client", "connect": {"endpoints": router}} for name in VIEWERS},
        }
        paths = {}
        for name, configuration in made.items():
            paths[name] = self.folder / f"{name}.json"
            paths[name].write_text(json.dumps(configuration))
        return paths

    def _secured(self) -> dict[str, Path]:
        folder = self.folder / "security"
        hosts = placed(Link.ADDRESS["first"], Link.ADDRESS["second"])
        people = {"operator": Person(role="operator"), **{name: Person(role="viewer") for name in VIEWERS}}
        plan = InstallationPlan(
            protocol=self.protocol, routers=[ROUTER], robots={self.robot: hosts}, people=people, days=2
        )
        init(folder, plan)
        sign_model(folder, self.model)
        services = {name: folder / f"{name}.{self.robot}.json" for name in ("simulator", "hal", "model")}
        return services | {name: folder / f"{name}.json" for name in ("router", "operator", *VIEWERS)}
