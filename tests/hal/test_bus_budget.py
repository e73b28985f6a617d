"""What different devices put on a bus, added up before anything is sent."""

import pytest
from hal_bench import description

from hal.config import RobotConfig
from hal.drivers.can_device import CanDevice
from hal.errors import ConfigError
from hal.protocols.can_frames import frame_bits
from hal.wire import budget

RATE = 200.0


class Chatterbox(CanDevice):
    """Needs no SYNC; sends one frame in every cycle, and a long identifier at a rate of its own."""

    @classmethod
    def quantities(cls, settings):
        return ("position",)

    @classmethod
    def commanded(cls, settings):
        return "position"

    @classmethod
    def traffic(cls, settings, rate):
        return ((8, rate), (4, 100.0, True))


@pytest.mark.parametrize(
    ("size", "extended", "bits"), [(0, False, 55), (8, False, 135), (0, True, 80), (1, True, 90), (8, True, 160)]
)
def test_worst_frames_with_short_and_long_identifiers(size, extended, bits):
    assert frame_bits(size, extended) == bits


def chatterboxes(count=1, **bus):
    body = description(rates={"hal": RATE})
    body["kinds"] = {"chatterbox": {"driver": f"{__name__}:Chatterbox"}}
    names = [f"joint_{number}" for number in range(count)]
    body["signals"] = {"joint_position": {"unit": "rad", "elements": names}}
    body["command"] = {"signal": "joint_position"}
    body["limits"] = {}
    body["buses"]["can0"].update(bus)
    body["devices"] = {
        name: {"kind": "chatterbox", "bus": "can0", "node": number, "element": f"joint_position.{name}"}
        for number, name in enumerate(names)
    }
    return RobotConfig.model_validate(body)


def test_a_bus_without_canopen_carries_no_sync_and_no_heartbeat_of_ours():
    (first, second) = budget.budgets(chatterboxes())
    assert (first.frames, first.bits, first.beside) == (1, 135, 100 * 120)
    assert (second.frames, second.load) == (0, 0.0)


def test_canopen_nodes_bring_the_sync_and_our_heartbeat_once():
    found = {one.bus: one for one in budget.budgets(RobotConfig.model_validate(description(rates={"hal": RATE})))}
    assert found["can0"].frames == 1 + 2 + 1
    assert found["can0"].beside == 2 * 10 * 65 + budget.OWN_HEARTBEAT_RATE * 65


def test_the_refusal_has_the_arithmetic_and_what_would_fit():
    with pytest.raises(ConfigError) as caught:
        budget.check(chatterboxes(20))
    load = (20 * 135 * RATE + 20 * 100 * 120) / 1e6
    assert (
        f"20 frames of together 2700 bits at 200 Hz and 240.0 kbit/s beside the cycle are {load:.0%} of 1 Mbit/s"
        in str(caught.value)
    )
    assert "Lower rates.hal to 133 Hz, or move devices to another bus." in str(caught.value)


def test_where_no_rate_would_help_none_is_proposed():
    with pytest.raises(ConfigError, match=r"max_load is 60%\. Move devices to another bus\."):
        budget.check(chatterboxes(20, bitrate=250_000))
