"""A simulated sensor with any DBC file: it sends what the robot file says that its device sends, and how often."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from typing_extensions import override

from hal.drivers.dbc.settings import MOTION, ConditionConfig, DbcSettings, StepConfig
from hal.protocols import dbc
from simulators.nodes.canopen.spec import NodeSpec
from simulators.nodes.dbc.frames import Numbering, Output, Request
from simulators.nodes.node import Frame, Handler, SimulatedNode
from simulators.nodes.plant import Plant
from simulators.wire_time import FD

MOST_AT_ONCE = 10
"""At most this many frames of one message are sent at once; after a longer pause the others are left out."""
ROOM = 25.0
"""A temperature that the robot file does not map reads this [degrees Celsius]."""


@dataclass(frozen=True, slots=True)
class DbcConstants:
    """A node that follows the settings of a robot file.

    Attributes:
        settings: Settings of its driver.
        folder: Folder of the robot file.
        elements: Quantity -> `signal.element` that it measures.
    """

    kind: ClassVar[str] = "dbc_node"

    settings: DbcSettings
    folder: Path
    elements: Mapping[str, str]


class DbcNode(SimulatedNode):
    """One node that sends with its own clock, and answers requests.

    A step of the robot file that waits for a value gets it: the node knows no more of its device than the file.
    """

    def __init__(self, spec: NodeSpec, plant: Plant, outbox: list[Frame]) -> None:
        constants = spec.constants
        assert isinstance(constants, DbcConstants)
        self.spec = spec
        self.plant = plant
        self._outbox = outbox
        self._elements = constants.elements
        self._settings = settings = constants.settings
        self._dbc = dbc.load(constants.folder / settings.dbc)
        self._numbering = Numbering(spec.node, settings.node_offset, settings.extended)
        self._outputs: dict[str, Output] = {}
        self.routes_changed: Callable[[], None] = lambda: None
        self.is_powered = False
        self.is_muted = False
        self._is_broken = False
        self._tare = 0.0
        self._due: dict[str, float] = {}
        self._prepare()
        for output in self._outputs.values():
            output.check()

    def _prepare(self) -> None:
        settings = self._settings
        self._sources = {quantity: self._output(config.signal) for quantity, config in settings.quantities.items()}
        self._error = self._output(settings.error.signal) if settings.error else None
        for name in (*settings.periods, *([settings.heartbeat.message] if settings.heartbeat else ())):
            self._message(name)
        identity = [self._output(name) for name in settings.identity.signals] if settings.identity else []
        for output, name in identity:
            output.put(name, float(self.spec.serial & 0x7F | 1))
        asked = (settings.identity.ask,) if settings.identity and settings.identity.ask else ()
        self._identity = self._requests(asked)
        self._identity_outputs = [output for output, _ in identity]
        self._tares = self._requests(settings.tare)
        self._known: list[tuple[Request, Callable[[Request], None]]] = [
            *((request, self._on_identity) for request in self._identity),
            *((request, self._fulfil) for request in self._requests(settings.open)),
            *((request, self._on_tare) for request in self._tares[-1:]),
        ]

    @property
    def is_fd(self) -> bool:
        """Whether it sends frames of CAN FD."""
        return any(dbc.is_fd(output.definition) for output in self._outputs.values())

    def _message(self, name: str) -> Output:
        if name not in self._outputs:
            definition = self._dbc.message(name)
            self._outputs[name] = Output(
                definition, self._numbering.of(definition) | (FD if dbc.is_fd(definition) else 0)
            )
        return self._outputs[name]

    def _output(self, source: str) -> tuple[Output, str]:
        """Return the message of `Message.Signal` and the name of the signal, which is sent from now on."""
        message, signal = self._dbc.signal(source)
        output = self._message(message.name)
        output.use(signal.name)
        return output, signal.name

    def _requests(self, steps: Iterable[StepConfig]) -> list[Request]:
        for step in steps:
            for condition in (step.until, step.unless):
                if condition is not None:
                    self._output(condition.signal)
        return [Request(self._dbc, step, self._numbering) for step in steps if step.send or step.frame]

    @property
    @override
    def condition(self) -> str:
        return "off" if not self.is_powered else "broken" if self._is_broken else "measuring"

    @override
    def routes(self) -> Mapping[int, Handler]:
        return {request.identifier: self._handler(request.identifier) for request, _ in self._known}

    def _handler(self, identifier: int) -> Handler:
        known = [(request, act) for request, act in self._known if request.identifier == identifier]

        def handle(data: bytes, now: float) -> None:
            if self.is_powered:
                for request, act in known:
                    if request.is_in(data):
                        act(request)

        return handle

    @override
    def sync(self, now: float) -> None:
        """Send what answers each cycle."""
        if self.is_powered:
            self._answer_cycle()

    def _answer_cycle(self) -> None:
        for name, period in self._settings.periods.items():
            if period == "cycle":
                self._send(self._outputs[name])

    @override
    def power_up(self, now: float) -> None:
        self.is_powered, self.is_muted = True, False
        self._tare = 0.0
        self._mend()
        self._due = {name: now for name, period in self._settings.periods.items() if period != "cycle"}

    @override
    def power_down(self) -> None:
        self.is_powered = False

    @override
    def break_down(self) -> None:
        """Report an error; a node without an error signal falls silent."""
        self._is_broken = True
        if self._error is None or self._settings.error is None:
            self.is_muted = True
            return
        output, name = self._error
        signal = output.signal(name)
        output.put(name, self._settings.error.good)
        good = output.raws[name]
        others = [float(raw) for raw in signal.choices or {} if raw != good]
        output.raws[name] = others[0] if others else good + 1.0 if good == 0.0 else 0.0

    def _mend(self) -> None:
        self._is_broken = False
        if self._error is not None and self._settings.error is not None:
            output, name = self._error
            output.put(name, self._settings.error.good)

    @override
    def tick(self, now: float) -> None:
        if not self.is_powered:
            return
        for name, due in self._due.items():
            period = self._settings.periods[name]
            assert not isinstance(period, str)
            count = int((now - due) / period + 1e-6) + 1 if now >= due - 1e-9 else 0
            for _ in range(min(count, MOST_AT_ONCE)):
                self._send(self._outputs[name])
            self._due[name] = due + count * period

    def _send(self, output: Output) -> None:
        for quantity, (source, name) in self._sources.items():
            if source is output:
                output.put(name, self._reading(quantity))
        if not self.is_muted:
            self._outbox.append((output.identifier, output.encode()))

    def _reading(self, quantity: str) -> float:
        """Return a quantity as the device sends it [unit of the DBC file]."""
        scale, offset = self._line(quantity)
        reading = (self._value(quantity) - offset) / scale
        return reading - self._tare if quantity == next(iter(self._sources)) else reading

    def _value(self, quantity: str) -> float:
        """Return the true value of a quantity [SI]."""
        if quantity in self._elements:
            return self.plant.read(self._elements[quantity])
        return ROOM if quantity == "temperature" else 0.0

    def _line(self, quantity: str) -> tuple[float, float]:
        """Return factor and offset [SI] from the unit of the DBC file, as the robot file states them."""
        settings, config = self._settings, self._settings.quantities[quantity]
        return self._conversion(
            quantity, config.scale, config.offset, is_main=quantity == next(iter(settings.quantities))
        )

    def _conversion(self, quantity: str, scale: float, offset: float, is_main: bool = False) -> tuple[float, float]:
        settings = self._settings
        if quantity in MOTION:
            zero = settings.zero if quantity == "position" else 0.0
            return settings.direction * scale, zero + settings.direction * offset
        if is_main:
            return settings.gain * scale, settings.zero + settings.gain * offset
        return scale, offset

    def _fulfil(self, request: Request) -> None:
        """Do what a step waits for; send it at once if it does not come by itself."""
        if request.until is not None:
            self._make_true(request.until)

    def _make_true(self, condition: ConditionConfig) -> None:
        output, name = self._output(condition.signal)
        if condition.below is not None:
            output.put(name, 0.0)
        else:
            output.put(name, condition.one_of[0] if condition.equals is None else condition.equals)
        if output.definition.name not in self._settings.periods:
            self._send(output)

    def _on_identity(self, request: Request) -> None:
        self._fulfil(request)
        for output in self._identity_outputs[:1]:
            if output.definition.name not in self._settings.periods:
                self._send(output)

    def _on_tare(self, request: Request) -> None:
        self._tare += self._reading(next(iter(self._sources)))
