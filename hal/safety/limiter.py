"""All limits of a robot's command, one after the other: what a command may become before it is applied."""

from collections.abc import Sequence

import numpy as np

from hal.config import LimitConfig, RobotConfig, per_element
from hal.device import Device
from hal.safety import roles
from hal.safety.ends import RESPONSE, EndsOfEffort, EndsOfVelocity
from hal.safety.limit import Acceleration, Arrays, Limit, Range, Rate, Turn
from hal.safety.soft_effort import Load, SoftEffort, SoftEffortOfEffort, SoftEffortOfVelocity
from hal.safety.trips import Trips


class Limiter:
    """Keeps the set-point, and moves it towards what is desired as far as every limit allows.

    Every new set-point is a step from the one before, so that no command, however it jumps, moves a drive faster than
    the robot file says. A limit that depends on what is measured comes after those that do not, and wins.

    Attributes:
        set_point: Of the newest cycle [unit of the commanded signal], shape (n,).
    """

    def __init__(self, config: RobotConfig, period: float, devices: Sequence[Device] = (), quantity: str = "position"):
        """Prepare the limits of `config` for cycles of `period` [s] and commands of a `quantity`.

        Raises:
            ConfigError: A limit that cannot act.
        """
        self._config, self._period, self._quantity = config, period, quantity
        name = config.command.signal
        self._size = config.signals[name].size
        self._low, self._high = config.bounds(name)
        limit = config.limits.get(name, LimitConfig())
        self._rate = None if limit.rate is None else per_element(limit.rate, self._size, name)
        self._acceleration = None if limit.acceleration is None else per_element(limit.acceleration, self._size, name)
        nature = roles.natures(config, devices)
        if quantity != "position":
            roles.check_known(config, nature)
        self._positions = [roles.own_way(config)] if quantity == "position" else roles.ways(config, nature, "position")
        self._velocities = roles.ways(config, nature, "velocity")
        self._trips = Trips(config, self._positions)
        self._parking: list[Limit] = []
        make = {"position": self._of_position, "velocity": self._of_velocity, "effort": self._of_effort}[quantity]
        self._limits = make(roles.loads(config, nature, quantity))
        self.set_point = np.full(self._size, np.nan)
        self._speed = np.zeros(self._size)

    def _of_position(self, loads: Sequence[Load]) -> list[Limit]:
        free: list[Limit] = [Range(self._low, self._high)]
        if self._acceleration is not None:
            free.append(Acceleration(self._acceleration, self._period))
        if self._rate is not None:
            free.append(Rate(self._rate, self._period))
        span = np.where(np.isfinite(self._high - self._low), self._high - self._low, 1.0)
        relief = span if self._rate is None else np.minimum(self._rate, span)
        loaded: list[Limit] = []
        for load in loads:
            at = load.commanded
            braking = None if self._acceleration is None else self._acceleration[at]
            loaded.append(SoftEffort(load, relief[at], self._low[at], self._high[at], self._period, braking))
        if self._config.stop.speed is not None:
            self._parking = [*free, Rate(self._config.stop.speed, self._period), *loaded]
        return [*free, *loaded]

    def _of_velocity(self, loads: Sequence[Load]) -> list[Limit]:
        limits: list[Limit] = [Range(self._low, self._high)]
        most = np.minimum(np.abs(self._low), np.abs(self._high))
        relief = np.where(np.isfinite(most), most, 1.0)
        limits += [SoftEffortOfVelocity(load, relief[load.commanded]) for load in loads]
        if self._rate is not None:
            limits.append(Rate(self._rate, self._period))
        for way in self._positions:
            braking = None if self._rate is None else self._rate[way.commanded]
            limits.append(EndsOfVelocity(way, braking, self._ahead(way.signal)))
        return limits

    def _of_effort(self, loads: Sequence[Load]) -> list[Limit]:
        limits: list[Limit] = [Range(self._low, self._high)]
        if self._rate is not None:
            limits.append(Rate(self._rate, self._period))
        limits += [SoftEffortOfEffort(load) for load in loads]
        limits += [EndsOfEffort("range", way) for way in self._positions]
        limits += [EndsOfEffort("velocity", way) for way in self._velocities]
        return limits

    def _ahead(self, signal: str) -> float:
        """How old [s] a measurement may be by the time at which a drive has followed what was made of it."""
        return self._config.signals[signal].stale_after + 2 * self._period + RESPONSE

    def start(self, measured: Arrays) -> np.ndarray:
        """Begin where the robot is: at its position, or without velocity or effort. Shape (n,)."""
        self._speed = np.zeros(self._size)
        if self._quantity == "position":
            value = measured[self._config.command.signal]
            self.set_point = np.where(np.isfinite(value), value, self.set_point)
        else:
            self.set_point = np.zeros(self._size)
        return self.set_point

    def step(self, desired: np.ndarray | None, measured: Arrays, is_parking: bool = False) -> list[str]:
        """Take `set_point` one cycle further.

        Args:
            desired: What is asked for [unit of the commanded signal], shape (n,); None: hold, which of a velocity or
                effort is 0.
            measured: The newest valid values; an element that is NaN limits nothing, or everything, as the limit says.
            is_parking: Whether to move no faster than `stop.speed`.

        Returns:
            A sorted subset of `range`, `rate`, `acceleration`, `tension`, `effort`, `velocity`: which limits acted.
        """
        before = self.set_point
        wanted = desired
        if wanted is None:
            wanted = before if self._quantity == "position" else np.zeros(self._size)
        turn = Turn(before, self._speed, measured, desired is not None)
        acted = set()
        for limit in self._parking if is_parking else self._limits:
            limited = limit.limit(wanted, turn)
            if limited is not wanted:
                acted.add(limit.name)
                wanted = limited
        self._speed = (wanted - before) / self._period
        self.set_point = wanted
        return sorted(acted)

    def trip(self, measured: Arrays) -> str:
        """Why the robot must stop, in a sentence; empty if it need not. Values that are not valid trip nothing."""
        return self._trips.trip(measured)

    def excluded(self, measured: Arrays) -> str:
        """Why the robot must not be enabled where it is, in a sentence; empty if it may."""
        return self._trips.excluded(measured)

    def blind(self, measured: Arrays) -> str:
        """Which limits cannot act for want of a measurement, in a sentence; empty if all can."""
        told = []
        for limit in self._limits:
            names = limit.blind(measured)
            if names:
                told.append(f"The {limit.name} limit cannot act without a valid {limit.needs} of {', '.join(names)}.")
        return " ".join(told)
