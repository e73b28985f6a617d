"""The `model` and `collect` sections of a robot file, which only the services read."""

import difflib
from typing import Annotated, Literal, TypeVar

from pydantic import Field, ValidationError

from gemuco.learning.config import TrainConfig
from gemuco.trust.config import TrustConfig
from hal.config import Positive, RangeConfig, RobotConfig, Section
from hal.errors import ConfigError
from hal.reading.mistakes import explain
from services.model.control_config import ControlConfig, SimulationConfig, named_signals

Count = Annotated[int, Field(ge=1)]
DEFAULT = TrainConfig()
"""These defaults of training are those of the library."""
TRUST = TrustConfig()
"""These defaults of trust are those of the library."""


class NetworkConfig(Section):
    """Shape of the encoder; the decoder mirrors it."""

    hidden: tuple[Count, ...] = DEFAULT.hidden
    latent: Count | None = DEFAULT.latent
    """This is the length of z. By default it follows the data: one per element of the outputs, 15 to 40."""
    activation: Literal["tanh", "relu", "sigmoid", "elu", "softplus"] = "tanh"
    bias: Annotated[int, Field(ge=0)] | None = DEFAULT.bias_size
    """This is the length of the parametric bias p, one p per condition; 0 without p. By default it follows the data:
    one less than the data have conditions, at most 3."""


Threshold = Annotated[float, Field(gt=0, le=1)]


class StructureConfig(Section):
    """The thresholds of the paper, II-E: normalised error on held-out data; 1 is the error of guessing the mean."""

    threshold_out: Threshold = 0.15
    """A signal that the others explain better than this becomes an output."""
    threshold_in: Threshold = 0.15
    """A mask that explains the outputs better than this is feasible."""
    measure: Literal["mse", "rmse"] = "mse"
    """The thresholds apply to the mean squared error or to its root."""
    over: Literal["masked", "all"] = "masked"
    """A mask is judged by the outputs that it does not contain, or by all."""
    splits: Count | None = None
    """The network is trained and measured this many times, each time with other motions held out. With `null` at least
    twice, and at most ten times, until every error is on one side of its threshold."""
    epochs: Count = 80


class TrainingConfig(Section):
    """The training of the network after structure determination."""

    epochs: Count | None = DEFAULT.epochs
    """By default the epochs follow the number of samples: about 4000 steps."""
    batch: Count | None = DEFAULT.batch
    """By default a step takes a tenth of the samples, 50 to 500."""
    rate: Positive = DEFAULT.rate
    """This is the peak learning rate of the one-cycle schedule."""
    bias_rate: Positive = DEFAULT.bias_rate
    """This is the peak learning rate of p."""
    held_out: Annotated[float, Field(gt=0, lt=1)] = DEFAULT.held_out
    """This share of every condition's data is held out from training and measures the loss."""
    patience: Count | None = DEFAULT.patience
    """Training stops after this many epochs without a better held-out loss; with `null` after two fifths of them."""
    outliers: Positive = DEFAULT.outliers
    """A signal that the others contradict by this many robust standard deviations is rejected; `.inf`: none."""


class UpdateConfig(Section):
    """The online update of p and W from a bounded window; see `gemuco.adaption.config.UpdateConfig`."""

    what: Literal["weights", "bias", "both", "bias_then_weights"] = "bias_then_weights"
    """Without parametric bias, W alone is updated."""
    bias_method: Literal["ekf", "gauss_newton", "gradient"] = "ekf"
    window: Count = 6000
    """The window keeps this many samples; the oldest is dropped."""
    minimum: Count = 10
    """The first gradient step needs this many samples."""
    interval: Positive = 0.1
    """Samples of the window are at least this far apart [s], so that it spans some motion."""
    steps: Count = 3
    """Each new sample is followed by this many gradient steps."""
    repeats: Count = 30
    """In a window of few samples a new sample is followed by up to this many times `steps`; 1: never by more."""
    rate: Positive = 1e-4
    """This is the learning rate of W."""
    bias_rate: Positive = 0.02
    """This is the learning rate of p, if it is updated by gradient."""
    optimiser: Literal["adam", "sgd"] = "adam"
    replay: Annotated[int, Field(ge=0)] = 300
    """This is the weight of the training data, in window samples."""
    held_out: Annotated[int, Field(ge=0)] = 5
    """One of this many samples is held out to judge W; 0 holds out none."""


class AnomalyConfig(Section):
    """The condition under which an unlikely prediction error counts as an anomaly."""

    after: Annotated[float, Field(ge=0)] = 0.05
    """The score must stay above its threshold for this time [s]."""


class TrustSettings(Section):
    """The conditions under which a measured element is hidden, because the others contradict it."""

    active: bool = True
    """Whether lies are looked for; an operator can distrust an element also without."""
    false_alarms: Annotated[float, Field(gt=0, le=60)] = TRUST.false_alarms
    """A healthy robot may have this number of wrong verdicts per hour of motion; the default is one a week."""
    size: Positive = TRUST.size
    """A lie matters from this size on, in errors of a healthy prediction."""
    sizes: dict[str, Positive] = Field(default_factory=dict)
    """The same for single signals: signal -> size; it replaces `size`."""
    pairs: Literal["hide", "use"] = "hide"
    """Elements that look alike: `hide` all of them, or `use` them all."""
    stops: tuple[str, ...] | None = None
    """Signals, or single elements such as `joint_position.elbow`, without which the robot stops and is not engaged. By
    default the commanded signal, and limited elements of the same name."""

    def config(self) -> TrustConfig:
        """Return the settings for the library."""
        return TrustConfig(self.false_alarms, self.size, self.sizes, self.pairs)


class ModelConfig(Section):
    """The whole `model` section."""

    signals: tuple[str, ...] = ()
    """These signals are the body schema's x; by default all signals of the robot."""
    fuse: bool = False
    """Whether a measured output is combined with its estimate from the other signals, by their variances."""
    network: NetworkConfig = NetworkConfig()
    structure: StructureConfig = StructureConfig()
    training: TrainingConfig = TrainingConfig()
    control: ControlConfig | None = None
    """Without this section the robot is observed and never commanded."""
    simulation: SimulationConfig = SimulationConfig()
    update: UpdateConfig = UpdateConfig()
    anomaly: AnomalyConfig = AnomalyConfig()
    trust: TrustSettings = TrustSettings()


class CollectConfig(Section):
    """The whole `collect` section: a motion of the robot's own, or random postures within limits and constraints."""

    motion: str | None = None
    """This is `module:name` of the random safe motion: (config, seed) -> endless (command, duration [s]). Without it
    the robot moves smoothly between random postures within the limits of the commanded signal."""
    speed: Positive = 1.0
    """A commanded element moves at most at this speed [its unit per second]."""
    hold: Annotated[float, Field(ge=0)] = 0.3
    """The robot rests in every posture for this time [s]."""
    forecast: str | None = None
    """This is `module:name` of the designer's model: (config, condition, commands (n, k)) -> signal -> (n, m)."""
    constraints: dict[str, RangeConfig] = Field(default_factory=dict)
    """The forecast of every posture, and of the motion to it, must lie within this range of each signal."""
    states: str | None = None
    """This is `module:name` of random states of the designer's geometry, which are added to the data of the designer's
    variant: (config, count, seed) -> signal -> array (count, n)."""
    states_share: Annotated[float, Field(gt=0, le=1)] = 0.5
    """This many of them are added per recorded sample."""
    samples: Count = 10_000
    rate: Positive = 20.0
    """Samples are recorded at this rate [Hz] of the robot's time."""
    settle: Annotated[float, Field(ge=0)] = 0.0
    """This time [s] after the start is not recorded."""


def model_config(robot: RobotConfig) -> ModelConfig:
    """Return the checked `model` section.

    Raises:
        ConfigError: It has an unknown key, a value out of range, or an unknown signal.
    """
    model = _section(robot, "model", ModelConfig)
    wrong = [name for name in model.signals if name not in robot.signals]
    wrong += [name for name in model.signals if model.signals.count(name) > 1]
    if wrong:
        known = ", ".join(robot.signals)
        raise ConfigError(
            f"Robot '{robot.robot}': model.signals names '{wrong[0]}', which is unknown or named twice. Known: {known}."
        )
    names = model.signals or tuple(robot.signals)
    for name in model.trust.sizes:
        if name not in names:
            raise ConfigError(
                f"Robot '{robot.robot}': model.trust.sizes '{name}' is not a signal of the model. "
                f"Known: {', '.join(names)}."
            )
    choices = [*names, *robot.element_names(names)]
    for name in model.trust.stops or ():
        if name not in choices:
            raise ConfigError(
                f"Robot '{robot.robot}': model.trust.stops '{name}' is neither a signal of the model nor one of its "
                f"elements. Near it: {', '.join(difflib.get_close_matches(name, choices, 3, 0.0))}."
            )
    for section in ("control", "simulation"):
        part = getattr(model, section)
        for key, signal in [] if part is None else named_signals(part):
            if signal not in names:
                raise ConfigError(
                    f"Robot '{robot.robot}': model.{section}.{key} '{signal}' is not a signal of the model. "
                    f"Known: {', '.join(names)}."
                )
    return model


def collect_config(robot: RobotConfig) -> CollectConfig:
    """Return the checked `collect` section.

    Raises:
        ConfigError: It is missing or wrong.
    """
    collect = _section(robot, "collect", CollectConfig)
    where = f"Robot '{robot.robot}', section 'collect'"
    if not robot.collect:
        raise ConfigError(
            f"Robot '{robot.robot}' has no 'collect' section, so its safe motion is unknown. docs/robots.md, "
            "Collecting, shows how to write one."
        )
    if collect.motion is not None and collect.model_fields_set & {"speed", "hold", "forecast", "constraints"}:
        raise ConfigError(f"{where}: with 'motion', speed, hold, forecast and constraints have no effect. Remove them.")
    if collect.constraints and collect.forecast is None:
        raise ConfigError(f"{where}: 'constraints' need a 'forecast'.")
    constraints = {}
    for name, allowed in collect.constraints.items():
        if name not in robot.signals:
            raise ConfigError(f"{where}: constraints.{name} is not a signal. Known: {', '.join(robot.signals)}.")
        try:
            constraints[name] = allowed.in_unit(robot.signals[name].unit, f"constraints.{name}")
            allowed.bounds(robot.signals[name].size, f"constraints.{name}")
        except ValueError as error:
            raise ConfigError(f"{where}: {error}") from None
    return collect.model_copy(update={"constraints": constraints})


S = TypeVar("S", bound=Section)


def _section(robot: RobotConfig, name: str, model: type[S]) -> S:
    try:
        return model.model_validate(getattr(robot, name))
    except ValidationError as error:
        raise ConfigError(f"Robot '{robot.robot}', section '{name}': {explain(error, model)}") from None
