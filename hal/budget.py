"""Whether the frames of a cycle fit on the bus, before anything is sent.

Source: CiA 301 frames on classic CAN with 11-bit identifiers (ISO 11898-1): 44 bits beside the data, of which 34 and
the data may be stuffed once in four after the first, and 3 bits of space between frames.
"""

from dataclasses import dataclass

from hal import registry
from hal.config import RobotConfig
from hal.errors import ConfigError

OWN_HEARTBEAT_RATE = 50.0
"""Of the HAL [Hz]; a drive stops after 0.15 s without one, of which a machine under load may sleep most."""


def frame_bits(size: int, is_extended: bool = False) -> int:
    """Longest a classic frame with `size` data bytes can be on the wire [bit], stuffing and space included."""
    stuffed = (54 if is_extended else 34) + 8 * size
    return 13 + stuffed + (stuffed - 1) // 4


@dataclass(frozen=True, slots=True)
class BusBudget:
    """What the cyclic frames take of one bus.

    Attributes:
        bus: Name in the robot file.
        frames: Frames per cycle, the SYNC included.
        bits: Their longest length together [bit].
        heartbeats: What heartbeats add [bit/s].
        rate: Cycles per second [Hz].
        bitrate: Of the bus [bit/s].
    """

    bus: str
    frames: int
    bits: int
    heartbeats: float
    rate: float
    bitrate: int

    @property
    def load(self) -> float:
        """Share of the bit rate, 0 to 1 and beyond."""
        return (self.bits * self.rate + self.heartbeats) / self.bitrate

    def __str__(self) -> str:
        return (
            f"{self.frames} frames of together {self.bits} bits at {self.rate:g} Hz and {self.heartbeats / 1e3:.1f} "
            f"kbit/s of heartbeats are {self.load:.0%} of {self.bitrate / 1e6:g} Mbit/s"
        )


def budgets(config: RobotConfig) -> list[BusBudget]:
    """The budget of every bus of a robot."""
    found = []
    for name, bus in config.buses.items():
        sizes = [0]
        beats = OWN_HEARTBEAT_RATE * frame_bits(1)
        for device, entry in config.devices.items():
            if entry.bus != name:
                continue
            driver, settings = registry.equipment(config, device)
            for size, rate in driver.traffic(settings, config.rates.hal):
                if rate == config.rates.hal:
                    sizes.append(size)
                else:
                    beats += rate * frame_bits(size)
        bits = sum(frame_bits(size) for size in sizes)
        found.append(BusBudget(name, len(sizes), bits, beats, config.rates.hal, bus.bitrate))
    return found


def check(config: RobotConfig) -> None:
    """Refuse a robot whose frames do not fit.

    Raises:
        ConfigError: A bus would carry more than its `max_load`; the message has the arithmetic.
    """
    for budget in budgets(config):
        allowed = config.buses[budget.bus].max_load
        if budget.load > allowed:
            fits = (allowed * budget.bitrate - budget.heartbeats) / budget.bits
            raise ConfigError(
                f"Bus '{budget.bus}' would carry too much: {budget}, and buses.{budget.bus}.max_load is {allowed:.0%}. "
                f"Lower rates.hal to {max(fits, 0):.0f} Hz, or move devices to another bus."
            )
