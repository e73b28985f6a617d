"""The `model` and `collect` sections of a robot file, checked here because only the services read them."""

from typing import Annotated, Literal, TypeVar

from pydantic import Field, ValidationError

from gemuco.learning.config import TrainConfig
from hal.config import Positive, RangeConfig, RobotConfig, Section, explain
from hal.errors import ConfigError
from services.model.control_config import ControlConfig, SimulationConfig, named_signals

Count = Annotated[int, Field(ge=1)]
DEFAULT = TrainConfig()
"""The defaults of training are those of the library."""


class NetworkConfig(Section):
    """Shape of the encoder; the decoder mirrors it."""

    hidden: tuple[Count, ...] = DEFAULT.hidden
    latent: Count = DEFAULT.latent
    activation: Literal["tanh", "relu", "sigmoid", "elu", "softplus"] = "tanh"
    bias: Annotated[int, Field(ge=0)] = DEFAULT.bias_size
    """Length of the parametric bias p, one p per condition; 0 without."""


Threshold = Annotated[float, Field(gt=0, le=1)]


class StructureConfig(Section):
    """Thresholds of the paper, II-E: normalised error on held-out data; 1 is that of always guessing the mean."""

    threshold_out: Threshold = 0.15
    """A signal that the others explain better than this becomes an output."""
    threshold_in: Threshold = 0.15
    """A mask that explains the outputs better than this is feasible."""
    measure: Literal["mse", "rmse"] = "mse"
    """What is compared with them: the mean squared error, or its root."""
    over: Literal["masked", "all"] = "masked"
    """Outputs that a mask is judged by: those it does not give, or all."""
    splits: Count = 1
    """How often to train and measure, each time with other episodes held out."""
    epochs: Count = 80


class TrainingConfig(Section):
    """How the network is fitted once its structure is known."""

    epochs: Count = DEFAULT.epochs
    batch: Count = DEFAULT.batch
    rate: Positive = DEFAULT.rate
    """Peak learning rate of the one-cycle schedule."""
    bias_rate: Positive = DEFAULT.bias_rate
    """Peak learning rate of p."""
    held_out: Annotated[float, Field(gt=0, lt=1)] = DEFAULT.held_out
    """Share of every condition's data that only measures."""
    patience: Count | None = DEFAULT.patience
    """Training stops after this many epochs without a better held-out loss; `null`: it goes on to the end."""
    outliers: Positive = DEFAULT.outliers
    """Reject a measured signal that the others contradict by so many robust standard deviations; `.inf`: none."""


class UpdateConfig(Section):
    """The online update of p and W from a bounded window; see `gemuco.adaption.config.UpdateConfig`."""

    what: Literal["weights", "bias", "both", "bias_then_weights"] = "bias_then_weights"
    """Without parametric bias, W alone is updated."""
    bias_method: Literal["ekf", "gauss_newton", "gradient"] = "ekf"
    window: Count = 6000
    """Samples kept; the oldest is dropped."""
    minimum: Count = 10
    """Samples before the first gradient step."""
    interval: Positive = 0.1
    """Least time [s] between two samples of the window, so that it spans some motion."""
    steps: Count = 3
    """Gradient steps per tick of the update loop."""
    rate: Positive = 1e-4
    """Learning rate of W."""
    bias_rate: Positive = 0.02
    """Learning rate of p, by gradient."""
    optimiser: Literal["adam", "sgd"] = "adam"
    replay: Annotated[int, Field(ge=0)] = 300
    """As how many samples of the window the training data counts."""
    held_out: Annotated[int, Field(ge=0)] = 5
    """Every so many-th sample only judges W; 0 none."""


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
    simulation: SimulationConfig = SimulationConfig()
    update: UpdateConfig = UpdateConfig()
    anomaly: AnomalyConfig = AnomalyConfig()


class CollectConfig(Section):
    """The whole `collect` section: a motion of the robot's own, or random postures within limits and constraints."""

    motion: str | None = None
    """`module:name` of the random safe motion: (config, seed) -> (command, duration [s]) without end. Absent: random
    postures within the limits of the commanded signal, and smooth moves from one to the next."""
    speed: Positive = 1.0
    """Highest speed of a commanded element on the way [its unit per second]."""
    hold: Annotated[float, Field(ge=0)] = 0.3
    """Rest in every posture [s]."""
    forecast: str | None = None
    """`module:name` of the designer's model: (config, condition, commands of shape (n, k)) -> signal -> (n, m)."""
    constraints: dict[str, RangeConfig] = Field(default_factory=dict)
    """Signal -> range within which the forecast of every posture, and of the way there, must lie."""
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
    for section in ("control", "simulation"):
        part = getattr(model, section)
        for key, signal in [] if part is None else named_signals(part):
            if signal not in (there := model.signals or tuple(robot.signals)):
                raise ConfigError(
                    f"Robot '{robot.robot}': model.{section}.{key} '{signal}' is not a signal of the model. "
                    f"Known: {', '.join(there)}."
                )
    return model


def collect_config(robot: RobotConfig) -> CollectConfig:
    """The checked `collect` section.

    Raises:
        ConfigError: It is missing or wrong.
    """
    collect = _section(robot, "collect", CollectConfig)
    where = f"Robot '{robot.robot}', section 'collect'"
    if not robot.collect:
        raise ConfigError(f"Robot '{robot.robot}' has no 'collect' section, so how it may be moved is not known.")
    if collect.motion is not None and collect.model_fields_set & {"speed", "hold", "forecast", "constraints"}:
        raise ConfigError(f"{where}: 'motion' moves as it likes; speed, hold, forecast and constraints are without it.")
    if collect.constraints and collect.forecast is None:
        raise ConfigError(f"{where}: 'constraints' need a 'forecast' of what they constrain.")
    for name, allowed in collect.constraints.items():
        if name not in robot.signals:
            raise ConfigError(f"{where}: constraints.{name} is not a signal. Known: {', '.join(robot.signals)}.")
        try:
            allowed.bounds(robot.signals[name].size, f"constraints.{name}")
        except ValueError as error:
            raise ConfigError(f"{where}: {error}") from None
    return collect


S = TypeVar("S", bound=Section)


def _section(robot: RobotConfig, name: str, model: type[S]) -> S:
    try:
        return model.model_validate(getattr(robot, name))
    except ValidationError as error:
        raise ConfigError(f"Robot '{robot.robot}', section '{name}': {explain(error, model)}") from None
