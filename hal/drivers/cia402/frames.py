"""The frames that command a servo drive in a cycle."""

from collections.abc import Sequence

import can

from hal.commissioning.pdo_map import Pdo, describe
from hal.commissioning.pdos import cob_id
from hal.errors import ConfigError
from hal.protocols import cia301, cia402
from hal.protocols.cia301 import Mapped
from hal.wire.bus import Bus


class CommandFrames:
    """Controlword, mode and target, in the RPDOs that carry them."""

    def __init__(self, pdos: Sequence[Pdo], node: int, target: Mapped, label: str) -> None:
        """Prepare the frames.

        Args:
            pdos: The RPDOs.
            node: Node id.
            target: The object that takes the set-point.
            label: Named in what is raised.

        Raises:
            ConfigError: They carry an object that nobody here has a value for.
        """
        known = (cia402.CONTROLWORD, cia402.MODE_OF_OPERATION, target)
        unknown = [item for pdo in pdos for item in pdo.objects if item not in known]
        if unknown:
            raise ConfigError(
                f"{label}: pdo.receives has {describe(unknown)}, which would be sent as 0. "
                f"In this mode it may have {describe(known)}."
            )
        self._frames = []
        for pdo in pdos:
            identifier = cob_id(cia301.RPDO1, pdo.number, node)
            message = can.Message(arbitration_id=identifier, is_extended_id=False, data=bytearray(pdo.size))
            places = tuple(known.index(item) for item in pdo.objects)
            self._frames.append((message, pdo.layout, places))

    def send(self, bus: Bus, word: int, mode: int, target: int) -> None:
        """Put them on the bus; for the cycle's thread, which fills the same frames again and again."""
        values = (word, mode, target)
        for message, layout, places in self._frames:
            layout.pack_into(message.data, 0, *[values[place] for place in places])
            bus.send(message)

    def send_anew(self, bus: Bus, word: int, mode: int, target: int) -> None:
        """Put them on the bus from any thread, in frames that no other thread fills meanwhile."""
        values = (word, mode, target)
        for message, layout, places in self._frames:
            data = layout.pack(*[values[place] for place in places])
            bus.send(can.Message(arbitration_id=message.arbitration_id, is_extended_id=False, data=data))
