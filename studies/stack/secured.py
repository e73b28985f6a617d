"""Cost of security: round trips and processor time through a plain and a secured router, in turns in one run.

python -m studies.stack.secured [--count 300] [--turns 3]
"""

import argparse
import json
import statistics
import tempfile
import time
from pathlib import Path

from services.process.router import routing
from services.security.init import init, placed, planned
from services.wire import keys
from services.wire.query import serve_verb
from services.wire.session import CLIENT, address, close_session, open_session

ROBOT = "benchmark_secured"


def round_trips(
    hal: tuple[str, ...], client: tuple[str, ...], router: tuple[str, ...], count: int
) -> tuple[float, ...]:
    """Return median and p99 [ms] of a verb, and the processor time [ms] that client, router and HAL take for one."""
    with routing((), router):
        sessions = [open_session(ROBOT, "hal", hal), open_session(ROBOT, CLIENT, client)]
        try:
            key = keys.verb(ROBOT, "hal", "describe")
            serve_verb(sessions[0], key, lambda _: {"values": [0.5] * 64})
            while not list(sessions[1].get(key, timeout=1.0)):
                time.sleep(0.02)
            took, cpu = [], time.process_time()
            for _ in range(count):
                begun = time.perf_counter()
                while not list(
                    sessions[1].get(key, timeout=5.0)
                ):  # on a busy machine a link may be lost and made again
                    time.sleep(0.02)
                    begun = time.perf_counter()
                took.append(1e3 * (time.perf_counter() - begun))
            cpu = 1e3 * (time.process_time() - cpu) / count
            return statistics.median(took), statistics.quantiles(took, n=100)[-1], cpu
        finally:
            for session in reversed(sessions):
                close_session(session)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=300)
    parser.add_argument("--turns", type=int, default=3)
    options = parser.parse_args()
    plain = "tcp/127.0.0.1:7447"
    with tempfile.TemporaryDirectory() as name:
        links: dict[str, tuple[tuple[str, ...], ...]] = {"plain": ((plain,), (plain,), ())}
        for protocol in ("quic", "tls"):
            folder = Path(name) / protocol
            init(folder, planned(folder, {ROBOT: placed(address(ROBOT))}, ["127.0.0.1:17447"], protocol, None))
            unlimited(folder)
            links[protocol] = tuple((str(folder / f"{role}.json"),) for role in (f"hal.{ROBOT}", "viewer", "router"))
        print("| link | p50 [ms] | p99 [ms] | processor [ms] |\n|---|---|---|---|")
        for _ in range(options.turns):
            for link, (hal, client, router) in links.items():
                costs = round_trips(hal, client, router, options.count)
                print("| " + " | ".join([link, *(f"{cost:.2f}" for cost in costs)]) + " |", flush=True)


def unlimited(folder: Path) -> None:
    """Remove the limit of 50 questions per second, which would be measured otherwise."""
    path = folder / "router.json"
    settings = json.loads(path.read_text())
    del settings["downsampling"]  # the doors of people have the same limits
    path.write_text(json.dumps(settings))


if __name__ == "__main__":
    main()
