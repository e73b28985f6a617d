"""The body schema in use: four loops read it at any time, and one replaces it."""

import threading
from collections.abc import Iterable
from pathlib import Path

from gemuco.checkpoint import load
from gemuco.errors import CheckpointError
from gemuco.schema import BodySchema
from gemuco.signals import Layout, Signal
from hal.config import RobotConfig
from services.model.model_config import model_config
from services.wire.signature import verifier_of


def layout_of(robot: RobotConfig) -> Layout:
    """Return the model's signals: those that the robot file names, by default all."""
    signals = [(name, robot.signals[name]) for name in model_config(robot).signals or robot.signals]
    return Layout(tuple(Signal(name, signal.size, signal.unit, signal.elements) for name, signal in signals))


def load_model(robot: RobotConfig, folder: Path, connect: Iterable[str] = ()) -> BodySchema:
    """Load the trained schema of a robot.

    Args:
        robot: The robot file.
        folder: Folder of the model.
        connect: Endpoints and role files. With a role file the model must be signed by its authority.

    Raises:
        CheckpointError: It is missing or damaged, or it is of another body than the robot file describes.
        NotSigned: It is not signed by the authority of the role file.
    """
    if not folder.exists():
        raise CheckpointError(f"There is no model in '{folder}'. Make one with `gemuco collect` and `gemuco train`.")
    schema = load(folder, verifier_of(connect, folder))
    if set(schema.layout.signals) != set(layout_of(robot).signals):
        theirs, ours = ", ".join(schema.layout.names), ", ".join(layout_of(robot).names)
        raise CheckpointError(
            f"The model in '{folder}' is of another body: its signals are {theirs}; the robot file's are {ours}, "
            "or their elements or units differ. Train again."
        )
    return schema


class LivingModel:
    """The schema in use and the one before adaption began. A reader sees one of them, never a mixture."""

    def __init__(self, schema: BodySchema) -> None:
        self._lock = threading.Lock()
        self._schema = schema
        self._before: BodySchema | None = None
        self.version = 0

    @property
    def schema(self) -> BodySchema:
        """The schema in use."""
        return self._schema

    @property
    def before(self) -> BodySchema | None:
        """The schema before adaption began; None before that."""
        return self._before

    def keep(self) -> None:
        """Remember the schema in use for `rollback`, unless one is already remembered."""
        with self._lock:
            self._before = self._before or self._schema

    def swap(self, schema: BodySchema) -> int:
        """Replace the schema; return the new version."""
        schema.prepare(self._schema)  # here, so that the other loops need no time for it
        with self._lock:
            self._schema = schema
            self.version += 1
            return self.version

    def rollback(self) -> int:
        """Restore the schema before adaption began; return the version."""
        with self._lock:
            if self._before is not None:
                self._schema, self._before = self._before, None
                self.version += 1
            return self.version
