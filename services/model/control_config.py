"""The `control` and `simulation` parts of a robot file's model section, and what they make of a model."""

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from gemuco.controller import Controller
from gemuco.schema import BodySchema
from gemuco.search.descent import DescentConfig, NewtonConfig
from gemuco.search.losses import Hold, Match, StayNear, StaySmall, Term
from gemuco.search.torque import TorqueBalance
from gemuco.simulation import Simulator
from hal import registry
from hal.config import Finite, Positive, RobotConfig, Section

Weight = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Route = Literal["auto", "mask", "latent", "input"]

KINDS: dict[str, tuple[str, ...]] = {
    "match": ("weight", "value", "matrix", "unit"),
    "stay_near": ("weight", "value", "unit"),
    "stay_small": ("weight", "unit"),
    "hold": ("value",),
    "torque_balance": ("weight", "position", "tension", "length", "at"),
}
"""Term -> the keys it takes beside its own."""


class TermConfig(Section):
    """One wish: one key of a kind with the signal it is about, and what that kind takes."""

    match: str | None = None
    """Reach the reference of a signal, or `value`; through `matrix` if there is one."""
    stay_near: str | None = None
    """Keep a signal near a reference, near `value`, or near where it is."""
    stay_small: str | None = None
    """Keep a signal near its physical zero."""
    hold: str | None = None
    """Force a signal to a reference or to `value` (.nan: this element is free)."""
    torque_balance: str | None = None
    """`module:name` of the joint torque [N m] that the muscles must supply at a posture [rad]."""
    weight: Weight | None = None
    """Loss per standard deviation (per SI unit with `unit: si`), and per N m of torque."""
    value: tuple[float, ...] | None = None
    matrix: tuple[tuple[Finite, ...], ...] | None = None
    unit: Literal["std", "si"] | None = None
    position: str | None = None
    tension: str | None = None
    length: str | None = None
    at: Literal["reference", "predicted"] | None = None
    """Whether torque is balanced at the reference posture or at the predicted one."""

    @model_validator(mode="after")
    def _one_kind(self) -> Self:
        kinds = [kind for kind in KINDS if getattr(self, kind) is not None]
        if len(kinds) != 1:
            raise ValueError(f"a term has exactly one of {', '.join(KINDS)}; this one has {', '.join(kinds) or 'none'}")
        fitting = (kinds[0], *KINDS[kinds[0]])
        for name in type(self).model_fields:
            if getattr(self, name) is not None and name not in fitting:
                raise ValueError(f"a term {kinds[0]} takes {', '.join(KINDS[kinds[0]])}, not {name}")
        return self

    @property
    def signals(self) -> tuple[str, ...]:
        """The signals it names."""
        names = (self.match, self.stay_near, self.stay_small, self.hold, self.position, self.tension, self.length)
        return tuple(name for name in names if name is not None)

    def term(self) -> Term | Hold:
        """What it means.

        Raises:
            SchemaError: The numbers make no sense together.
        """
        kind = next(kind for kind in KINDS if getattr(self, kind) is not None)
        options = {name: getattr(self, name) for name in KINDS[kind] if getattr(self, name) is not None}
        if kind == "torque_balance":
            return TorqueBalance(registry.load_object(str(self.torque_balance)), **options)
        made: type[Match | StayNear | StaySmall | Hold]
        made = {"match": Match, "stay_near": StayNear, "stay_small": StaySmall, "hold": Hold}[kind]
        return made(getattr(self, kind), **options)


class ControlConfig(Section):
    """What the controller reaches, and what else it minds (paper, II-I and III)."""

    target: str
    """The signal that targets are given for."""
    route: Route = "auto"
    """`auto` is the paper's rule; see `gemuco.controller`."""
    mask: tuple[str, ...] | None = None
    """With route mask or input: the signals the network is given."""
    terms: tuple[TermConfig, ...] = ()
    """To match the target if none is named."""
    speed: Positive = 1.0
    """Speed [unit/s] at which the reference moves from where the body is to the target."""


class SimulationConfig(Section):
    """What state a command brings about (paper, II-J)."""

    route: Route = "auto"
    mask: tuple[str, ...] | None = None
    terms: tuple[TermConfig, ...] = ()
    """Constraints; to match the command is added if none is about it."""


def terms_of(config: ControlConfig | SimulationConfig) -> tuple[Term | Hold, ...]:
    """The section's terms; a controller's are at least to match its target."""
    if isinstance(config, ControlConfig) and not config.terms:
        return (Match(config.target),)
    return tuple(term.term() for term in config.terms)


def controller_of(
    schema: BodySchema,
    robot: RobotConfig,
    config: ControlConfig,
    search: DescentConfig | NewtonConfig | None = None,
) -> Controller:
    """The robot file's controller, which stays inside the limits of the commanded signal.

    Raises:
        SchemaError: This model cannot control; the text says what it lacks.
    """
    signal = robot.command.signal
    limits = {signal: robot.bounds(signal)}
    return Controller(schema, terms_of(config), signal, config.route, search, _mask(config), limits)


def simulator_of(schema: BodySchema, robot: RobotConfig, config: SimulationConfig) -> Simulator:
    """The robot file's simulator.

    Raises:
        SchemaError: This model cannot simulate; the text says what it lacks.
    """
    return Simulator(schema, terms_of(config), robot.command.signal, config.route, mask=_mask(config))


def _mask(config: ControlConfig | SimulationConfig) -> frozenset[str] | None:
    return None if config.mask is None else frozenset(config.mask)


def named_signals(config: ControlConfig | SimulationConfig) -> list[tuple[str, str]]:
    """(key, signal) of every signal that the section names, for a look at whether it exists."""
    found = [("target", config.target)] if isinstance(config, ControlConfig) else []
    found += [("mask", name) for name in config.mask or ()]
    return found + [(f"terms.{index}", name) for index, term in enumerate(config.terms) for name in term.signals]
