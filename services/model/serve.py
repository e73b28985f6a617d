"""The process of the body schema service (`gemuco serve`)."""

import logging
import threading
import time
from collections.abc import Iterable
from pathlib import Path

from gemuco.warm import warm
from hal.config import RobotConfig
from services.model.gemuco_service import GemucoService
from services.model.living_model import load_model
from services.model.model_verbs import ModelVerbs
from services.process.realtime import prepare_process, starting
from services.process.service import Service, until_stopped

log = logging.getLogger(__name__)

PATIENCE = 3.0
"""Compiling is reported at this interval [s]; loading stored code takes less."""


def serve(robot: RobotConfig, folder: Path, connect: Iterable[str] = (), stop: threading.Event | None = None) -> None:
    """Run the model service of a robot until SIGTERM, SIGINT or `stop`.

    Args:
        robot: The robot file.
        folder: Folder of the trained model.
        connect: Endpoints, such as a router's, and role files.
        stop: Event that ends the service; signals are then not handled.

    Raises:
        CheckpointError: The folder holds no model, or a model of another body.
        NotSigned: The model is not signed by the authority of the role file.
        AlreadyRunning: The robot already has a model service.
    """
    prepare_process()
    items = tuple(connect)
    with starting():
        schema = load_model(robot, folder, items)
        make_ready(bool(len(schema.bias)))
    with until_stopped(stop) as stopped, Service(robot.robot, "model", items) as service:
        model = GemucoService(robot, schema, service)
        ModelVerbs(model).serve(service)
        model.run(stopped)


def make_ready(has_p: bool) -> None:
    """Load all compiled code before the first tick, for a model with p or without; report a compilation's progress."""
    reported = time.monotonic()

    def report(done: float, part: str) -> None:
        nonlocal reported
        if time.monotonic() - reported > PATIENCE:
            reported = time.monotonic()
            log.warning(
                "Compiled code: %d %% is ready, now %s. It is compiled once; later only a busy machine is slow.",
                round(100 * done),
                part,
            )

    warm(report, is_service=True, has_p=has_p)
