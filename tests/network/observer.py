"""A remote client of the campaign: watches presence and estimates through the router, and asks verbs when told.

    python observer.py ROBOT RECORD CONNECT

Writes to a file when what arrived: ["alive", t, service, is there], ["estimate", t, cycle], ["sample", t, cycle]. Takes
one JSON map per line from stdin, {"ask": [service, verb, arguments]} or {"status": service}, and answers with one.
"""

import json
import os
import sys
import threading
import time
from pathlib import Path
from typing import Any

import msgpack
import zenoh

from services.client import Client
from services.wire import keys
from services.wire.records import Applied, Estimates, Sample


class Observer:
    """One client."""

    def __init__(self, robot: str, record: Path, connect: str) -> None:
        self._file = record.open("ab", buffering=0)
        self._lock = threading.Lock()
        self.robot = robot
        self.client = Client(robot, [connect], name="campaign")

    def run(self) -> None:
        with self.client:
            self._watch()
            print(json.dumps({"ready": True}), flush=True)
            for line in sys.stdin:
                print(json.dumps(self._answer(json.loads(line)), default=str), flush=True)

    def _watch(self) -> None:
        session = self.client.session

        def token(sample: zenoh.Sample) -> None:
            service = keys.parse(str(sample.key_expr))[1]
            self._write("alive", service, sample.kind == zenoh.SampleKind.PUT)

        self._token = session.liveliness().declare_subscriber(keys.alive(self.robot, "*"), token, history=True)
        for what, key, record in (
            ("estimate", keys.estimate(self.robot), Estimates),
            ("sample", keys.sample(self.robot), Sample),
            ("applied", keys.applied(self.robot), Applied),
        ):
            reader = self.client.reader(key, record)
            threading.Thread(target=self._follow, args=(what, reader), daemon=True).start()

    def _follow(self, what: str, reader: Any) -> None:
        while True:
            message = reader.wait(1.0)
            if message is None:
                continue
            if what == "applied":
                self._write(what, message.cycle, message.mode)
            else:
                self._write(what, message.cycle)

    def _write(self, *values: Any) -> None:
        with self._lock:
            self._file.write(msgpack.packb([values[0], time.monotonic(), *values[1:]]))

    def _answer(self, wanted: dict[str, Any]) -> dict[str, Any]:
        begun = time.monotonic()
        try:
            if "ask" in wanted:
                service, verb, arguments = wanted["ask"]
                return {"ok": self.client.ask(service, verb, arguments), "took": time.monotonic() - begun}
            if "status" in wanted:
                status = self.client.status(wanted["status"], max_age=3.0, timeout=3.0)
                return {"ok": None if status is None else {"state": status.state, "text": status.text,
                                                           "loops": status.loops, "facts": status.facts}}  # fmt: skip
            return {"error": "ValueError", "text": f"not a wish: {wanted}"}
        except Exception as error:  # every refusal is an answer here
            return {"error": type(error).__name__, "text": str(error), "took": time.monotonic() - begun}


if __name__ == "__main__":
    Observer(sys.argv[1], Path(sys.argv[2]), sys.argv[3]).run()
    os._exit(0)
