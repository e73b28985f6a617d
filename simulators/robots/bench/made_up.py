"""A made-up body on the bench: what its sensors measure follows the positions of its drives by smooth functions."""

import math
import zlib
from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from cantools.database.can.signal import Signal
from typing_extensions import override

from hal import registry
from hal.config import RobotConfig
from hal.protocols import dbc
from simulators.nodes.canopen.analog_input import AnalogConstants
from simulators.nodes.canopen.spec import DriveConstants, EncoderConstants, NodeSpec
from simulators.nodes.dbc.sensor import DbcConstants
from simulators.nodes.serial.node import SerialConstants
from simulators.robots.bench.world import BenchWorld

SPANS = {"rad": 0.5, "rad/s": 1.0, "m": 0.1, "m/s": 1.0, "N": 20.0, "N m": 1.0, "degC": 20.0, "V": 5.0, "A": 2.0}
"""Unit -> how far a value of unknown range goes to either side of its middle."""
USED = 0.4
"""A value goes to either side by this share of a known range."""
MOST = 1e6
"""A range of a DBC file beyond this is that of its bits, and not of the value."""
STEPS = 100.0
"""A value of unknown range has at least this number of steps to either side."""
SIDE = 0.3
"""Weight of the other drives beside the one that an element follows most."""
WAVE, WAVES = 0.25, 2.0
"""Share of a value that is a sine, and the phase [rad] that it runs through to either side."""
FRICTION = 0.05
"""Share of an effort that grows with the speed."""
OTHER = 0.03
"""The weights of an actual body differ by this share, one standard deviation."""
NOISE = 0.003
"""Standard deviation of the noise, as a share of how far a value goes."""


class BenchBody(BenchWorld):
    """Elements that the nodes read from the world are functions of all positions; friction is in the efforts."""

    def __init__(self, config: RobotConfig, nodes: Sequence[NodeSpec], seed: int, is_actual: bool = False) -> None:
        """Make up the body of a robot file; the same elements have the same functions.

        Args:
            config: The robot file.
            nodes: Its nodes on the bench.
            seed: Seed of the noise, and of how the actual body differs.
            is_actual: Whether the functions differ somewhat from those of the designer's body.

        Raises:
            ConfigError: A DBC file cannot be read.
        """
        super().__init__(config)
        self._random = np.random.default_rng(seed)
        self._kept: set[str] = set()
        devices = {node.name: registry.equipment(config, node.name) for node in nodes}
        drives = [node for node in nodes if devices[node.name][0].commanded(devices[node.name][1]) is not None]
        self._moved = [node.element for node in drives]
        self._speeds = {
            config.devices[node.name].elements["velocity"]: number
            for number, node in enumerate(drives)
            if "velocity" in config.devices[node.name].elements and node.element != _velocity(config, node)
        }
        self._middle, self._half = _ranges(config, self._moved)
        ranges = {
            element: bounds
            for node in nodes
            for element, bounds in _followers(config, node)
            if element not in (*self._moved, *self._speeds)
        }
        self._followers = list(ranges)
        self._centers = np.array([center for center, _ in ranges.values()])
        self._spans = np.array([span for _, span in ranges.values()])
        loads = [getattr(node.constants, "load", None) for node in nodes]
        self._has_friction = np.array([element in loads for element in self._followers])
        self._weights, self._phases = _functions(self._followers, len(self._moved))
        if is_actual:
            self._weights = self._weights * (1.0 + OTHER * self._random.standard_normal(self._weights.shape))
        self._before = self._positions()
        self._follow(0.0)

    @override
    def step(self, duration: float) -> None:
        super().step(duration)
        self._follow(duration)

    @override
    def measure(self) -> Mapping[str, np.ndarray]:
        """Return all values, those of sensors with noise."""
        values = super().measure()
        noise = NOISE * self._spans * self._random.standard_normal(len(self._spans))
        for element, error in zip(self._followers, noise.tolist(), strict=True):
            if element not in self._kept:
                signal, index = self._places[element]
                values[signal][index] += error
        return values

    @override
    def truth(self) -> Mapping[str, np.ndarray]:
        return super().measure()

    @override
    def break_part(self, part: str) -> None:
        """Let an element read a value for good, as on a bench without a body."""
        super().break_part(part)
        self._kept.add(part.split(":")[1])

    def _positions(self) -> np.ndarray:
        return np.array([self._value(element) for element in self._moved])

    def _value(self, element: str) -> float:
        signal, index = self._places[element]
        return float(self._values[signal][index])

    def _follow(self, duration: float) -> None:
        """Set what follows the drives."""
        positions = self._positions()
        speeds = (positions - self._before) / duration if duration > 0.0 else np.zeros(len(positions))
        self._before = positions
        scaled, rates = (positions - self._middle) / self._half, speeds / self._half
        wave = np.sin(WAVES * (self._weights[:, ::-1] @ scaled) + self._phases) - np.sin(self._phases)
        shares = (1.0 - WAVE) * self._weights @ scaled + WAVE * wave
        shares += FRICTION * self._has_friction * np.tanh(self._weights @ rates)
        values = dict(zip(self._followers, (self._centers + self._spans * shares).tolist(), strict=True))
        values |= {element: float(speeds[number]) for element, number in self._speeds.items()}
        for element, value in values.items():
            if element not in self._kept:
                signal, index = self._places[element]
                self._values[signal][index] = value


def _velocity(config: RobotConfig, node: NodeSpec) -> str | None:
    return config.devices[node.name].elements.get("velocity")


def _ranges(config: RobotConfig, elements: Sequence[str]) -> tuple[np.ndarray, np.ndarray]:
    """Return middle and half range of the elements that drives move; shapes (n,)."""
    middles, halves = [], []
    for element in elements:
        signal, name = element.split(".", 1)
        index = config.signals[signal].elements.index(name)
        low, high = (float(bound[index]) for bound in config.bounds(signal))
        is_stated = math.isfinite(low) and math.isfinite(high)
        middles.append(0.5 * (low + high) if is_stated else 0.0)
        halves.append(0.5 * (high - low) if is_stated else SPANS.get(config.signals[signal].unit, 1.0))
    return np.array(middles), np.array(halves)


def _followers(config: RobotConfig, node: NodeSpec) -> Iterator[tuple[str, tuple[float, float]]]:
    """Yield the elements that a node reads from the world, with the middle of each and how far it goes."""
    constants = node.constants
    if isinstance(constants, DbcConstants):
        file = dbc.load(constants.folder / constants.settings.dbc)
        for quantity, element in constants.elements.items():
            source = constants.settings.quantities[quantity]
            center, span = _range(file.signal(source.signal)[1], _span(config, element) / abs(source.scale))
            yield element, (source.offset + source.scale * center, abs(source.scale) * span)
    elif isinstance(constants, DriveConstants):
        if constants.load is not None:
            largest = constants.rated_torque * constants.gear / (constants.spool_radius or 1.0)
            yield constants.load, (0.0, USED * largest)
    elif isinstance(constants, SerialConstants):
        if constants.load is not None:
            yield constants.load, (0.0, USED * constants.full_load)
    elif isinstance(constants, AnalogConstants):
        for element in (node.element, *filter(None, constants.more)):
            yield element, (0.0, USED * constants.full_scale)
    elif isinstance(constants, EncoderConstants):  # it wraps after one turn, so it stays away from the ends
        yield node.element, (constants.zero + constants.direction * math.pi, _span(config, node.element))
    else:
        for element in (node.element, *filter(None, getattr(constants, "more", ()))):
            yield element, (0.0, _span(config, element))


def _range(signal: Signal, usual: float) -> tuple[float, float]:
    """Return the middle of a signal and how far it goes to either side [unit of the DBC file]."""
    ends = sorted(signal.scale * raw + signal.offset for raw in dbc.raw_bounds(signal))
    if ends[0] < ends[1] and ends[1] - ends[0] < MOST:
        return 0.5 * (ends[0] + ends[1]), USED * (ends[1] - ends[0])
    if signal.is_float:
        return 0.0, usual
    span = max(usual, STEPS * abs(signal.scale))
    return (0.0 if signal.is_signed else span + signal.offset), span


def _span(config: RobotConfig, element: str) -> float:
    return SPANS.get(config.signals[element.split(".", 1)[0]].unit, 1.0)


def _functions(elements: Sequence[str], count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return weights of the positions and phases of the sines, shapes (n, count) and (n,); each row of weights has
    magnitudes with a sum of 1, the largest for one drive in turn, so that few elements show all positions.
    """
    weights, phases = np.zeros((len(elements), count)), np.zeros(len(elements))
    for row, element in enumerate(elements):
        random = np.random.default_rng(zlib.crc32(element.encode()))
        weights[row] = SIDE * random.uniform(-1.0, 1.0, count)
        weights[row, row % count] = random.choice((-1.0, 1.0))
        weights[row] /= np.abs(weights[row]).sum()
        phases[row] = random.uniform(-1.0, 1.0)
    return weights, phases
