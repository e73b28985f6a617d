"""Load of a bus, computed from the robot file before a frame is sent.

On a serial line packets are counted as frames.
"""

from dataclasses import dataclass

from hal import registry
from hal.config import RobotConfig
from hal.errors import ConfigError
from hal.line.port import SERIAL
from hal.protocols.can_frames import FrameLengths, Frames, frame_bits

OWN_HEARTBEAT_RATE = 50.0
"""The HAL sends its heartbeat at this rate [Hz]. A drive stops after 0.15 s without one, and a machine under load may
sleep for most of this time."""

BITS_PER_BYTE = 10
"""A byte on a serial line has 8 bits, a start bit and a stop bit."""


@dataclass(frozen=True, slots=True)
class BusBudget:
    """Load of one bus by cyclic frames.

    Attributes:
        bus: Name in the robot file.
        frames: Number of frames per cycle, including a SYNC.
        bits: Sum of the longest lengths of these frames [bit at the bit rate of the bus].
        beside: Load by heartbeats and other frames with a rate of their own [bit/s].
        rate: Cycles per second [Hz].
        bitrate: Bit rate of the bus [bit/s].
    """

    bus: str
    frames: int
    bits: float
    beside: float
    rate: float
    bitrate: int

    @property
    def load(self) -> float:
        """Share of the bit rate; may exceed 1."""
        return (self.bits * self.rate + self.beside) / self.bitrate

    def __str__(self) -> str:
        return (
            f"{self.frames} frames of together {self.bits:.0f} bits at {self.rate:g} Hz and {self.beside / 1e3:.1f} "
            f"kbit/s beside the cycle are {self.load:.0%} of {self.bitrate / 1e6:g} Mbit/s"
        )


def budgets(config: RobotConfig) -> list[BusBudget]:
    """Return the budget of every bus of a robot."""
    return [_budget(config, name) for name in config.buses]


def _budget(config: RobotConfig, bus: str) -> BusBudget:
    rate = config.rates.hal
    section = config.buses[bus]
    lengths = FrameLengths(section.bitrate, section.data_bitrate)
    cyclic: list[float] = []
    beside = 0.0
    has_sync = False
    is_serial = section.interface in SERIAL
    states: list[int] = []
    for device, entry in config.devices.items():
        if entry.bus != bus:
            continue
        driver, settings = registry.equipment(config, device)
        has_sync |= driver.NEEDS_SYNC
        if is_serial and driver.state is not None:
            states.append(BITS_PER_BYTE * (2 * driver.packets.OVERHEAD + driver.state[1]))
        quantities = tuple(entry.elements) or driver.quantities(settings)[:1]
        try:
            traffic = driver.traffic_of(settings, rate, quantities, config.folder)
        except ConfigError as error:  # such as a DBC file that is not there
            raise ConfigError(f"Device '{device}': {error}") from None
        for frames in traffic:
            size, times, is_extended, is_fd = Frames(*frames)
            bits: float = BITS_PER_BYTE * size
            if not is_serial:  # a device of a serial line on a CAN bus is refused later
                bits = lengths.of(size, is_extended, is_fd) if is_fd else frame_bits(size, is_extended)
            if times == rate:
                cyclic.append(bits)
            else:
                beside += times * bits
    if states:  # that of one servo per cycle
        cyclic.append(max(states))
    if has_sync:
        cyclic.append(lengths.classic[0])
        beside += OWN_HEARTBEAT_RATE * lengths.classic[1]
    return BusBudget(bus, len(cyclic), sum(cyclic), beside, rate, section.bitrate)


def check(config: RobotConfig) -> None:
    """Check that the load of every bus is allowed.

    Raises:
        ConfigError: The load of a bus exceeds its `max_load`; the message shows the calculation.
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
