"""One light robot in one process: HAL service and model service as in life, without a bus.

Started by `studies.stack.fleet`, or by hand: python -m studies.stack.fleet_robot ROBOT_FILE MODEL_FOLDER SEED ENDPOINT

Runs until SIGTERM. On SIGUSR1 it floods its estimates' key for as long as it lives, as a robot gone wild would.
"""

import os
import signal
import sys
import threading
import time
from pathlib import Path

from hal.config import load_robot
from services.hardware.hal_service import HalService
from services.model import gemuco_service
from services.process.service import Service, until_told
from services.wire import keys
from studies.stack import light_robot

FLOOD_BYTES = 10_000


def flood(session_of: list[Service]) -> None:
    """Put as fast as it goes, until the session is closed."""
    service = session_of[0]
    key, payload = keys.truth(service.robot), os.urandom(FLOOD_BYTES)
    while not service.session.is_closed():
        for _ in range(10):
            service.session.put(key, payload)
        time.sleep(0)


def main(file: Path, model: Path, seed: int, endpoint: str) -> None:
    """Run both services in threads of this process until told to stop."""
    config, connect = load_robot(file), (endpoint,) if endpoint else ()
    running: list[Service] = []
    wild = threading.Event()
    signal.signal(signal.SIGUSR1, lambda *_: wild.set())
    with until_told() as told, Service(config.robot, "hal", connect) as service:
        running.append(service)
        hal = HalService(config, light_robot.in_process(config, seed), service)
        threads = [
            threading.Thread(target=hal.run, args=(told,), name="hal service"),
            threading.Thread(target=gemuco_service.serve, args=(config, model, connect, told), name="model service"),
        ]
        for thread in threads:
            thread.start()
        while not told.wait(0.2):
            if wild.is_set():
                wild.clear()
                threading.Thread(target=flood, args=(running,), daemon=True).start()
        for thread in threads:
            thread.join()


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3]), sys.argv[4] if len(sys.argv) > 4 else "")
