"""Whether the frames of a cycle fit on the bus, before anything is sent.

Source: classic CAN (ISO 11898-1): with an 11-bit identifier 44 bits beside the data, with a 29-bit one 64, of which 34
or 54 and the data may be stuffed once in four after the first, and 3 bits of space between frames.
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
        frames: Frames per cycle, the SYNC included if there is one.
        bits: Their longest length together [bit].
        beside: What heartbeats and whatever else has a rate of its own add [bit/s].
        rate: Cycles per second [Hz].
        bitrate: Of the bus [bit/s].
    """

    bus: str
    frames: int
    bits: int
    beside: float
    rate: float
    bitrate: int

    @property
    def load(self) -> float:
        """Share of the bit rate, 0 to 1 and beyond."""
        return (self.bits * self.rate + self.beside) / self.bitrate

    def __str__(self) -> str:
        return (
            f"{self.frames} frames of together {self.bits} bits at {self.rate:g} Hz and {self.beside / 1e3:.1f} "
            f"kbit/s beside the cycle are {self.load:.0%} of {self.bitrate / 1e6:g} Mbit/s"
        )


def budgets(config: RobotConfig) -> list[BusBudget]:
    """The budget of every bus of a robot."""
    return [_budget(config, name) for name in config.buses]


def _budget(config: RobotConfig, bus: str) -> BusBudget:
    rate = config.rates.hal
    cyclic: list[int] = []
    beside = 0.0
    has_sync = False
    for device, entry in config.devices.items():
        if entry.bus != bus:
            continue
        driver, settings = registry.equipment(config, device)
        has_sync |= driver.NEEDS_SYNC
        wanted = tuple(entry.elements) or driver.quantities(settings)[:1]
        for size, times, *extended in driver.traffic_of(settings, rate, wanted):
            bits = frame_bits(size, any(extended))
            if times == rate:
                cyclic.append(bits)
            else:
                beside += times * bits
    if has_sync:
        cyclic.append(frame_bits(0))
        beside += OWN_HEARTBEAT_RATE * frame_bits(1)
    return BusBudget(bus, len(cyclic), sum(cyclic), beside, rate, config.buses[bus].bitrate)


def check(config: RobotConfig) -> None:
    """Refuse a robot whose frames do not fit.

    Raises:
        ConfigError: A bus would carry more than its `max_load`; the message has the arithmetic.
    """
    for budget in budgets(config):
        allowed = config.buses[budget.bus].max_load
        if budget.load > allowed:
            room = allowed * budget.bitrate - budget.beside
            slower = f"Lower rates.hal to {room / budget.bits:.0f} Hz, or move" if room > 0 and budget.bits else "Move"
            raise ConfigError(
                f"Bus '{budget.bus}' would carry too much: {budget}, and buses.{budget.bus}.max_load is {allowed:.0%}. "
                f"{slower} devices to another bus."
            )
