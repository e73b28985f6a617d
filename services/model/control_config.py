"""The `control` and `simulation` parts of a robot file's model section, and their controller and simulator."""

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
"""This maps each term to the keys that it takes beside its own."""


class TermConfig(Section):
    """One term of the loss: the key of its kind with a signal, and the options of that kind."""

    match: str | None = None
    """This term reaches the reference of a signal, or `value`; through `matrix` if given."""
    stay_near: str | None = None
    """This term keeps a signal near a reference, near `value`, or near its present value."""
    stay_small: str | None = None
    """This term keeps a signal near its physical zero."""
    hold: str | None = None
    """This constraint forces a signal to a reference or to `value` (.nan: this element is free)."""
    torque_balance: str | None = None
    """This is `module:name` of the joint torque [N m] that the muscles must supply at a posture [rad]."""
    weight: Weight | None = None
    """The weight is the loss per standard deviation (per SI unit with `unit: si`), or per N m of torque."""
    value: tuple[float, ...] | None = None
    matrix: tuple[tuple[Finite, ...], ...] | None = None
    unit: Literal["std", "si"] | None = None
    position: str | None = None
    tension: str | None = None
    length: str | None = None
    at: Literal["reference", "predicted"] | None = None
    """Torque is balanced at this posture."""

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
        """Names of its signals."""
        names = (self.match, self.stay_near, self.stay_small, self.hold, self.position, self.tension, self.length)
        return tuple(name for name in names if name is not None)

    def term(self) -> Term | Hold:
        """Make the term.

        Raises:
            SchemaError: Its numbers do not fit together.
        """
        kind = next(kind for kind in KINDS if getattr(self, kind) is not None)
        options = {name: getattr(self, name) for name in KINDS[kind] if getattr(self, name) is not None}
        if kind == "torque_balance":
            return TorqueBalance(registry.load_object(str(self.torque_balance)), **options)
        term: type[Match | StayNear | StaySmall | Hold]
        term = {"match": Match, "stay_near": StayNear, "stay_small": StaySmall, "hold": Hold}[kind]
        return term(getattr(self, kind), **options)


class ControlConfig(Section):
    """The target signal and the loss of the controller (paper, II-I and III)."""

    target: str
    """Targets are values of this signal."""
    route: Route = "auto"
    """`auto` is the paper's rule; see `gemuco.controller`."""
    mask: tuple[str, ...] | None = None
    """With route mask or input, the network is given these signals."""
    terms: tuple[TermConfig, ...] = ()
    """Without terms, the loss is to match the target."""
    speed: Positive = 1.0
    """The reference moves from the present posture to the target at this speed [unit/s]."""
    unknown: Literal["slow", "hold", "ignore"] = "slow"
    """Where the body is unknown the reference moves at a tenth of this speed, does not go there, or goes as usual."""


class SimulationConfig(Section):
    """The simulation of the state that a command leads to (paper, II-J)."""

    route: Route = "auto"
    mask: tuple[str, ...] | None = None
    terms: tuple[TermConfig, ...] = ()
    """These are constraints; one that matches the command is added if they do not contain it."""


def terms_of(config: ControlConfig | SimulationConfig) -> tuple[Term | Hold, ...]:
    """Return the section's terms; a controller without terms matches its target."""
    if isinstance(config, ControlConfig) and not config.terms:
        return (Match(config.target),)
    return tuple(term.term() for term in config.terms)


def controller_of(
    schema: BodySchema,
    robot: RobotConfig,
    config: ControlConfig,
    search: DescentConfig | NewtonConfig | None = None,
) -> Controller:
    """Make the robot file's controller, which stays inside the limits of the commanded signal.

    Raises:
        SchemaError: This model cannot control; the text names what is missing.
    """
    signal = robot.command.signal
    limits = {signal: robot.bounds(signal)}
    return Controller(schema, terms_of(config), signal, config.route, search, _mask(config), limits)


def simulator_of(schema: BodySchema, robot: RobotConfig, config: SimulationConfig) -> Simulator:
    """Make the robot file's simulator.

    Raises:
        SchemaError: This model cannot simulate; the text names what is missing.
    """
    return Simulator(schema, terms_of(config), robot.command.signal, config.route, mask=_mask(config))


def _mask(config: ControlConfig | SimulationConfig) -> frozenset[str] | None:
    return None if config.mask is None else frozenset(config.mask)


def named_signals(config: ControlConfig | SimulationConfig) -> list[tuple[str, str]]:
    """Return (key, signal) for every signal that the section names."""
    names = [("target", config.target)] if isinstance(config, ControlConfig) else []
    names += [("mask", name) for name in config.mask or ()]
    return names + [(f"terms.{index}", name) for index, term in enumerate(config.terms) for name in term.signals]
