"""Cost of the live page for a running robot: CPU and ticks of its services without a page, and with 0, 1, 5 browsers.

    python -m studies.stack.view_cost musashi_arm

Needs a running stack (`gemuco hal`, `gemuco serve`) on this machine. The same run measures the baseline twice.
"""

import argparse
import contextlib
import subprocess
import sys
import threading
import time
from collections.abc import Sequence

import msgspec
import viser
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from services.client import Client
from services.wire.messages import Status
from studies.stack.processes import cpu

PORT = 8093
SERVICES = ("hal", "model")
CAMERA = {
    "type": "ViewerCameraMessage", "wxyz": (1.0, 0.0, 0.0, 0.0), "position": (1.0, 1.0, 1.0), "fov": 1.0, "near": 0.1,
    "far": 10.0, "image_height": 10, "image_width": 10, "look_at": (0.0, 0.0, 0.0), "up_direction": (0.0, 0.0, 1.0),
}  # fmt: skip


class Browser:
    """A browser that reads everything.

    Attributes:
        page: Its connection.
        received: Number of bytes received so far.
    """

    def __init__(self) -> None:
        self.page = connect(f"ws://127.0.0.1:{PORT}", subprotocols=[f"viser-v{viser.__version__}"], max_size=None)  # type: ignore[list-item]
        self.page.send(msgspec.msgpack.encode(CAMERA))
        self.received = 0
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        with contextlib.suppress(ConnectionClosed):
            while True:
                self.received += len(self.page.recv())


def counted(client: Client) -> tuple[dict[str, float], dict[str, float]]:
    """Return the ticks and the skips of all loops of each service since their start."""
    ticks, skips = {}, {}
    for name in SERVICES:
        status: Status | None = client.status(name, timeout=5.0)
        loops = status.loops.values() if status else ()
        ticks[name] = sum(loop["ticks"] for loop in loops)
        skips[name] = sum(loop["skipped"] for loop in loops)
    return ticks, skips


def measure(client: Client, pids: dict[str, int], label: str, seconds: float, browsers: Sequence[Browser]) -> None:
    """Print CPU, ticks and skips of every service over a time span [s], and the bytes that each browser got."""
    ticks, skips = counted(client)
    before, began = {n: cpu(p) for n, p in pids.items()}, time.monotonic()
    bytes_before = sum(browser.received for browser in browsers)
    time.sleep(seconds)
    took = time.monotonic() - began
    used = {n: 100 * (cpu(p) - before[n]) / took for n, p in pids.items()}
    later, skipped = counted(client)
    cells = [f"{used[n]:5.1f} %  {later[n] - ticks[n]:6.0f} / {skipped[n] - skips[n]:3.0f}" for n in SERVICES]
    sent = (sum(browser.received for browser in browsers) - bytes_before) / took / 1e3 / max(1, len(browsers))
    print(f"{label:16} {'   '.join(cells)}   {used.get('view', 0.0):5.1f} %   {sent:6.1f} kB/s", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("robot")
    parser.add_argument("--seconds", type=float, default=20.0)
    options = parser.parse_args()
    with Client(options.robot) as client:
        pids = {name: int(client.describe(name, timeout=20.0)["pid"]) for name in SERVICES}
        counted(client)
        print(f"{'':16} {'   '.join(f'{n}: CPU, ticks / skips' for n in SERVICES)}   view     per page")
        measure(client, pids, "no page server", options.seconds, [])
        view = subprocess.Popen([sys.executable, "-m", "services.cli", "view", options.robot, "--port", str(PORT)])
        browsers: list[Browser] = []
        try:
            time.sleep(10.0)
            for count in (0, 1, 5):
                browsers += [Browser() for _ in range(count - len(browsers))]
                time.sleep(2.0)
                measure(client, pids | {"view": view.pid}, f"{count} browsers", options.seconds, browsers)
        finally:
            for browser in browsers:
                browser.page.close()
            view.terminate()
            view.wait(20.0)
        measure(client, pids, "no page server", options.seconds, [])


if __name__ == "__main__":
    main()
