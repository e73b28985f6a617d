"""Every way to get a command of the small arm wrong."""

from typing import Any

import msgpack
import numpy as np

from services.wire import messages
from services.wire.messages import Command, Sample


def bad_commands(sample: Sample) -> dict[str, tuple[bytes, str, str]]:
    """What is wrong -> the bytes, the counter that must count it, and what must be said.

    Args:
        sample: A fresh one, so that nothing else is wrong.
    """

    def command(values: Any = (0.1, 0.1), **change: Any) -> bytes:
        fields = {"signal": "muscle_length", "cycle": sample.cycle, "hal_boot": sample.boot, "boot": 5, **change}
        return messages.encode(Command(values=np.asarray(values, float), **fields))

    later: bytes = msgpack.packb(msgpack.unpackb(command()) | {"v": 3})
    return {
        "not msgpack": (b"\xc1\x00", "malformed", "not msgpack"),
        "another type": (messages.encode(sample), "malformed", "Expected a command message"),
        "a later version": (later, "malformed", "has version 3"),
        "far too long": (command(np.zeros(200_000)), "malformed", "over the limit"),
        "not finite": (command((np.nan, 0.1)), "refused", "muscle_length.biceps is nan"),
        "infinite": (command((0.1, np.inf)), "refused", "muscle_length.triceps is inf"),
        "too few": (command((0.1,)), "refused", "has 2 values, not shape"),
        "too many": (command(np.zeros(3)), "refused", "has 2 values, not shape"),
        "another signal": (command(signal="joint_position"), "refused", "takes 'muscle_length'"),
        "another run": (command(hal_boot=1), "refused", "another run of the HAL"),
        "without a sender": (command(boot=0), "refused", "without its sender's `boot`"),
        "an old cycle": (command(cycle=1), "refused", "ycle 1"),
        "a future cycle": (command(cycle=10**9), "refused", "ycle 1000000000"),
    }
