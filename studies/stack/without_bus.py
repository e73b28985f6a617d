"""The HAL of a robot whose simulated body lies in the HAL's own process, in real time and without a bus.

    python -m studies.stack.without_bus ROBOT_FILE [VARIANT] [SEED]

For measuring what runs beside a HAL: simulated nodes on a simulated bus cost more than all that is measured.
Runs until SIGTERM.
"""

import sys
from pathlib import Path

from hal import registry
from hal.config import load_robot
from hal.robot import Robot
from services.hardware.hal_service import HalService
from services.process.realtime import prepare_process
from services.process.service import Service, until_told
from studies.stack.light_robot import LiveDevice


def main(file: Path, variant: str = "geometric", seed: int = 1) -> None:
    """Serve until told to stop."""
    prepare_process()
    config = load_robot(file)
    world = registry.load(config.simulator or "").world(variant, seed)
    with until_told() as told, Service(config.robot, "hal") as service:
        HalService(config, Robot(config, [LiveDevice(config, world)], source="simulated"), service).run(told)


if __name__ == "__main__":
    main(Path(sys.argv[1]), *sys.argv[2:3], *map(int, sys.argv[3:4]))
