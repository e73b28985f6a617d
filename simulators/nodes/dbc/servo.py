"""A simulated servo with any DBC file: it has the states, requests and the watchdog that the robot file states."""

from typing_extensions import override

from hal.drivers.dbc.settings import ServoSettings, Value
from simulators.nodes.canopen.spec import NodeSpec
from simulators.nodes.dbc.frames import Request, decoded, raw_of
from simulators.nodes.dbc.sensor import DbcConstants, DbcNode
from simulators.nodes.node import Frame, Handler, SimulatedDrive, SimulatedNode
from simulators.nodes.plant import Plant
from simulators.nodes.rotor import Rotor

BOOT_TIME = 0.1
"""The servo reports for this time [s] after power-on that it starts, if the robot file has values for that."""
INERTIA, FRICTION = 0.05, 0.5
"""Inertia [kg m2] or [kg] and friction [N m s/rad] or [N s/m] of a servo that is commanded by its effort."""


def make_dbc_node(spec: NodeSpec, plant: Plant, outbox: list[Frame]) -> SimulatedNode:
    """Make a sensor or a servo, as its settings are."""
    assert isinstance(spec.constants, DbcConstants)
    is_servo = isinstance(spec.constants.settings, ServoSettings)
    return DbcServoNode(spec, plant, outbox) if is_servo else DbcNode(spec, plant, outbox)


class DbcServoNode(DbcNode, SimulatedDrive):
    """One servo. It moves while its state is one of `enabled`, and follows the newest set-point."""

    _settings: ServoSettings

    def __init__(self, spec: NodeSpec, plant: Plant, outbox: list[Frame]) -> None:
        self._rotor = Rotor(INERTIA, FRICTION)
        self._target = 0.0
        self._now = self._fed = self._boot_ends = 0.0
        self._speed, self._before = 0.0, (0.0, 0.0)
        super().__init__(spec, plant, outbox)

    @override
    def _prepare(self) -> None:
        super()._prepare()
        settings = self._settings
        self._state = self._output(settings.state.signal)
        if settings.state.reason:
            self._output(settings.state.reason)
        watchdog = settings.watchdog
        if watchdog is not None and watchdog.expired is not None:
            self._output(watchdog.expired.signal)
        command = self._dbc.message(settings.command.send)
        self._command = command, self._dbc.signal_of(command, settings.command.signal)
        enable, disable = self._requests(settings.enable), self._requests(settings.disable)
        stop, reset = self._requests(settings.quick_stop), self._requests(settings.reset)
        self._cyclic = self._requests(settings.cyclic)
        more = self._requests(watchdog.configure) if watchdog else []
        self._known += [
            *((request, self._fulfil) for request in (*more, *enable[:-1], *disable[:-1], *stop[:-1], *reset[:-1])),
            *((request, self._on_reset) for request in reset[-1:]),
            *((request, self._on_enable) for request in enable[-1:]),
            *((request, self._on_disable) for request in (*disable[-1:], *stop[-1:])),
        ]
        self._fed_by = {self._numbering.of(self._dbc.message(name)) for name in watchdog.fed_by} if watchdog else set()

    @property
    def _quantity(self) -> str:
        return self._settings.command.quantity

    @property
    def _has_position(self) -> bool:
        """Whether the world's servo moves a position; else it moves the commanded quantity."""
        return self._elements.get("position") == self.spec.element

    def _is_state(self, values: tuple[Value, ...]) -> bool:
        output, name = self._state
        signal = output.signal(name)
        return any(output.raws[name] == raw_of(signal, value) for value in values)

    def _set_state(self, values: tuple[Value, ...]) -> None:
        output, name = self._state
        if values and not self._is_state(values):
            output.put(name, values[0])

    @property
    def _is_enabled(self) -> bool:
        return self.is_powered and self._is_state(self._settings.state.enabled)

    @property
    @override
    def condition(self) -> str:
        if self.is_powered and not self._is_broken:
            return "enabled" if self._is_enabled else "disabled"
        return super().condition

    @property
    @override
    def servo(self) -> tuple[float, bool]:
        is_turned = self._has_position and self._quantity != "position"
        return self._rotor.position if is_turned else self._target, self._is_enabled

    @override
    def routes(self) -> dict[int, Handler]:
        routes = dict(super().routes())
        setpoint = self._numbering.of(self._command[0])
        for identifier in {setpoint, *self._fed_by, *(request.identifier for request in self._cyclic)}:
            routes[identifier] = self._on_any(identifier, routes.get(identifier), identifier == setpoint)
        return routes

    def _on_any(self, identifier: int, further: Handler | None, is_setpoint: bool) -> Handler:
        is_cyclic = is_setpoint or any(request.identifier == identifier for request in self._cyclic)

        def handle(data: bytes, now: float) -> None:
            if not self.is_powered:
                return
            if identifier in self._fed_by:
                self._fed = now
            if is_setpoint:
                self._on_setpoint(data)
            if further is not None:
                further(data, now)
            if is_cyclic:
                self._answer_cycle()

        return handle

    @override
    def sync(self, now: float) -> None:
        """Ignore SYNC: a servo answers its set-point."""

    def _on_setpoint(self, data: bytes) -> None:
        message, signal = self._command
        raws = decoded(message, data)
        if raws is None or signal.name not in raws:
            return
        command, measured = self._settings.command, self._settings.quantities[self._quantity]
        scale, offset = self._conversion(
            self._quantity,
            measured.scale if command.scale is None else command.scale,
            measured.offset if command.offset is None else command.offset,
        )
        self._target = offset + scale * (raws[signal.name] * signal.scale + signal.offset)

    def _on_enable(self, request: Request) -> None:
        if self._is_broken:
            return
        self._fulfil(request)
        self._set_state(self._settings.state.enabled)
        self._rotor.rest(self._place())
        self._fed = self._now

    def _on_disable(self, request: Request) -> None:
        self._fulfil(request)
        if self._is_enabled:
            self._set_state(self._settings.state.ready)

    def _on_reset(self, request: Request) -> None:
        self._mend()
        if self._is_state(self._settings.state.fault):
            self._set_state(self._settings.state.ready)
        self._forget_expiry()
        self._fulfil(request)

    def _forget_expiry(self) -> None:
        watchdog = self._settings.watchdog
        if watchdog is not None and watchdog.expired is not None:
            output, name = self._output(watchdog.expired.signal)
            is_error = self._error is not None and self._error[0] is output and self._error[1] == name
            if not is_error and output.definition.name + "." + name != self._settings.state.signal:
                output.put(name, 0.0)

    @override
    def break_down(self) -> None:
        """Report an error, and lose power."""
        if self._error is not None:
            super().break_down()
        self._is_broken = True
        self._set_state(self._settings.state.fault or self._settings.state.ready)

    @override
    def power_up(self, now: float) -> None:
        super().power_up(now)
        state = self._settings.state
        self._set_state(state.booting or state.ready)
        self._forget_expiry()
        self._now = self._fed = now
        self._boot_ends = now + BOOT_TIME
        self._rotor.rest(self._place())

    @override
    def tick(self, now: float) -> None:
        duration, self._now = now - self._now, now
        if self.is_powered and duration > 0.0:
            if self._is_state(self._settings.state.booting) and now >= self._boot_ends:
                self._set_state(self._settings.state.ready)
            self._watch(now)
            self._turn(duration)
        super().tick(now)

    def _watch(self, now: float) -> None:
        watchdog = self._settings.watchdog
        if watchdog is None or not self._is_enabled or now - self._fed <= watchdog.timeout:
            return
        self._set_state(self._settings.state.ready)
        if watchdog.expired is not None:
            self._make_true(watchdog.expired)

    def _turn(self, duration: float) -> None:
        place = self._place()
        time, before = self._before
        if self.plant.time > time:
            self._speed = (place - before) / (self.plant.time - time) if time else 0.0
            self._before = self.plant.time, place
        if not self._is_enabled:
            self._rotor.rest(place)
        elif self._quantity == "velocity":
            self._rotor.run(self._target, duration)
        elif self._quantity == "effort":
            self._rotor.push(self._target, duration)

    def _place(self) -> float:
        return self.plant.value(self.spec.element)

    @override
    def _value(self, quantity: str) -> float:
        if quantity == "velocity" and self._has_position:
            return self._speed
        if quantity == "effort" and self._quantity == "effort" and self._has_position:
            return self._target if self._is_enabled else 0.0
        return super()._value(quantity)
