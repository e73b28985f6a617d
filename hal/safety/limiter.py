"""All limits of a robot's command, applied in sequence."""

from collections.abc import Sequence

import numpy as np

from hal.config import LimitConfig, RobotConfig, per_element
from hal.device import Device
from hal.safety import feedback
from hal.safety.ends import RESPONSE, EndsOfEffort, EndsOfVelocity
from hal.safety.feedback import Arrays, Load
from hal.safety.limit import Acceleration, CycleState, Limit, Range, Rate
from hal.safety.soft_effort import SoftEffort, SoftEffortOfEffort, SoftEffortOfVelocity
from hal.safety.trips import Trips


class Limiter:
    """Owner of the set-point, which moves towards the desired one as far as every limit allows.

    Every new set-point is a step from the last one, so that no jump of a command moves a drive faster than the robot
    file allows. Limits that need a measurement come after the others and have priority.

    Attributes:
        set_point: Set-point of the newest cycle [unit of the commanded signal], shape (n,).
    """

    def __init__(self, config: RobotConfig, period: float, devices: Sequence[Device] = (), quantity: str = "position"):
        """Prepare the limits of `config` for cycles of `period` [s] and commands of a `quantity`.

        Raises:
            ConfigError: A limit can have no effect.
        """
        self._config, self._period, self._quantity = config, period, quantity
        name = config.command.signal
        self._size = config.signals[name].size
        self._low, self._high = config.bounds(name)
        limit = config.limits.get(name, LimitConfig())
        self._rate = None if limit.rate is None else per_element(limit.rate, self._size, name)
        self._acceleration = None if limit.acceleration is None else per_element(limit.acceleration, self._size, name)
        quantity_of = feedback.quantities(config, devices)
        if quantity == "position":
            self._positions = [feedback.commanded_range(config)]
        else:
            feedback.check_known(config, quantity_of)
            self._positions = feedback.measured_ranges(config, quantity_of, "position")
        self._velocities = feedback.measured_ranges(config, quantity_of, "velocity")
        self._trips = Trips(config, self._positions)
        self._parking: list[Limit] = []
        limits_of = {"position": self._of_position, "velocity": self._of_velocity, "effort": self._of_effort}
        self._limits = limits_of[quantity](feedback.loads(config, quantity_of, quantity))
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
        for position in self._positions:
            braking = None if self._rate is None else self._rate[position.commanded]
            limits.append(EndsOfVelocity(position, braking, self._ahead(position.signal)))
        return limits

    def _of_effort(self, loads: Sequence[Load]) -> list[Limit]:
        limits: list[Limit] = [Range(self._low, self._high)]
        if self._rate is not None:
            limits.append(Rate(self._rate, self._period))
        limits += [SoftEffortOfEffort(load) for load in loads]
        limits += [EndsOfEffort("range", position) for position in self._positions]
        limits += [EndsOfEffort("velocity", velocity) for velocity in self._velocities]
        return limits

    def _ahead(self, signal: str) -> float:
        """Return the largest age [s] of a measurement at the time at which a drive has followed its command."""
        return self._config.signals[signal].stale_after + 2 * self._period + RESPONSE

    def start(self, measured: Arrays) -> np.ndarray:
        """Set and return the set-point, shape (n,): the measured position, or zero velocity or effort."""
        self._speed = np.zeros(self._size)
        if self._quantity == "position":
            value = measured[self._config.command.signal]
            self.set_point = np.where(np.isfinite(value), value, self.set_point)
        else:
            self.set_point = np.zeros(self._size)
        return self.set_point

    def step(self, desired: np.ndarray | None, measured: Arrays, is_parking: bool = False) -> list[str]:
        """Advance `set_point` by one cycle.

        Args:
            desired: Desired set-point [unit of the commanded signal], shape (n,); None to hold the position, or for
                zero velocity or effort.
            measured: Newest valid values; each limit defines its behaviour where an element is NaN.
            is_parking: Whether `stop.speed` limits the speed.

        Returns:
            Limits that acted: a sorted subset of `range`, `rate`, `acceleration`, `tension`, `effort`, `velocity`.
        """
        before = self.set_point
        set_point = desired
        if set_point is None:
            set_point = before if self._quantity == "position" else np.zeros(self._size)
        state = CycleState(before, self._speed, measured, desired is not None)
        active = set()
        for limit in self._parking if is_parking else self._limits:
            limited = limit.limit(set_point, state)
            if limited is not set_point:
                active.add(limit.name)
                set_point = limited
        self._speed = (set_point - before) / self._period
        self.set_point = set_point
        return sorted(active)

    def trip(self, measured: Arrays) -> str:
        """Return the reason to stop the robot, as a sentence; empty without one. Invalid values are no reason."""
        return self._trips.trip(measured)

    def excluded(self, measured: Arrays) -> str:
        """Return the reason not to enable the robot at its present position; empty without one."""
        return self._trips.excluded(measured)

    def blind(self, measured: Arrays) -> str:
        """Return the limits that cannot act because a measurement is missing, in sentences; empty if all can."""
        texts = []
        for limit in self._limits:
            names = limit.blind(measured)
            if names:
                texts.append(f"The {limit.name} limit cannot act without a valid {limit.needs} of {', '.join(names)}.")
        return " ".join(texts)
