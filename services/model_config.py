"""The `model` and `collect` sections of a robot file, checked here because only the services read them."""

from typing import Annotated, Literal, TypeVar

from pydantic import Field, ValidationError

from hal.config import Positive, RobotConfig, Section, explain
from hal.errors import ConfigError

Count = Annotated[int, Field(ge=1)]


class NetworkConfig(Section):
    """Shape of the encoder; the decoder mirrors it."""

    hidden: tuple[Count, ...] = (200, 30)
    latent: Count = 15
    activation: Literal["tanh"] = "tanh"


class StructureConfig(Section):
    """Thresholds of the paper, II-E: normalised mean squared error on held-out data."""

    threshold_out: Positive = 0.15
    """A signal that the others explain better than this becomes an output."""
    threshold_in: Positive = 0.15
    """A mask that explains the outputs better than this is feasible."""
    epochs: Count = 80


class TrainingConfig(Section):
    """How the network is fitted once its structure is known."""

    epochs: Count = 150
    batch: Count = 250
    rate: Positive = 3e-3
    """Peak learning rate of the one-cycle schedule."""


class ControlConfig(Section):
    """What the controller reaches, and what else it minds (paper, III-B)."""

    target: str
    effort: str | None = None
    """Signal to keep small."""
    gravity: str | None = None
    """`module:name` of the joint torque [N m] that balances gravity at a posture [rad]."""
    effort_weight: Annotated[float, Field(ge=0)] = 0.1
    """Loss per standard deviation of effort. The paper's 1 drives all muscles to the lowest tensions that were ever
    recorded, where they are soft and the model is worst: control error 0.25 rad against 0.08."""
    torque_weight: Annotated[float, Field(ge=0)] = 0.3
    """Loss per N m that the muscles lack to hold the posture."""
    speed: Positive = 1.0
    """Speed [unit/s] at which the reference moves from where the body is to the target."""


class UpdateConfig(Section):
    """The online update of W from a bounded window."""

    window: Count = 6000
    """Samples kept; the oldest is dropped."""
    interval: Positive = 0.1
    """Least time [s] between two samples of the window, so that it spans some motion."""
    rate: Positive = 1e-3
    """Learning rate."""


class AnomalyConfig(Section):
    """When an unlikely prediction error counts as an anomaly."""

    after: Annotated[float, Field(ge=0)] = 0.05
    """How long [s] the score must stay above its threshold."""


class ModelConfig(Section):
    """The whole `model` section."""

    signals: tuple[str, ...] = ()
    """The signals that are the body schema's x; all of the robot's if none is named."""
    network: NetworkConfig = NetworkConfig()
    structure: StructureConfig = StructureConfig()
    training: TrainingConfig = TrainingConfig()
    control: ControlConfig | None = None
    """Absent: the robot is observed and never commanded."""
    update: UpdateConfig = UpdateConfig()
    anomaly: AnomalyConfig = AnomalyConfig()


class CollectConfig(Section):
    """The whole `collect` section."""

    motion: str
    """`module:name` of the random safe motion: (config, seed) -> (command, duration [s]) without end."""
    states: str | None = None
    """`module:name` of random states of the designer's geometry, added to what is collected from the designer's
    variant: (config, count, seed) -> signal -> array (count, n)."""
    states_share: Annotated[float, Field(gt=0, le=1)] = 0.5
    """How many of them per recorded sample."""
    samples: Count = 10_000
    rate: Positive = 20.0
    """Samples per second of the robot's time."""
    settle: Annotated[float, Field(ge=0)] = 0.0
    """Seconds after the start that are not recorded."""


def model_config(robot: RobotConfig) -> ModelConfig:
    """The checked `model` section.

    Raises:
        ConfigError: An unknown key, a value out of range, or a signal the robot does not have.
    """
    model = _section(robot, "model", ModelConfig)
    wrong = [name for name in model.signals if name not in robot.signals]
    wrong += [name for name in model.signals if model.signals.count(name) > 1]
    if wrong:
        known = ", ".join(robot.signals)
        raise ConfigError(
            f"Robot '{robot.robot}': model.signals names '{wrong[0]}', which is no signal or there twice. "
            f"Known: {known}."
        )
    for key in ("target", "effort"):
        signal = getattr(model.control, key, None)
        if signal is not None and signal not in robot.signals:
            known = ", ".join(robot.signals)
            raise ConfigError(f"Robot '{robot.robot}': model.control.{key} '{signal}' is not a signal. Known: {known}.")
    return model


def collect_config(robot: RobotConfig) -> CollectConfig:
    """The checked `collect` section.

    Raises:
        ConfigError: It is missing or wrong.
    """
    return _section(robot, "collect", CollectConfig)


S = TypeVar("S", bound=Section)


def _section(robot: RobotConfig, name: str, model: type[S]) -> S:
    try:
        return model.model_validate(getattr(robot, name))
    except ValidationError as error:
        raise ConfigError(f"Robot '{robot.robot}', section '{name}': {explain(error, model)}") from None
