"""Scan of a serial line: every id is asked in the protocol of each make. It enables no servo and changes nothing."""

import time

from hal.config import BusConfig
from hal.errors import BusGone
from hal.finding.scan import Node, Scan
from hal.line.port import Port
from hal.protocols import dynamixel, dynamixel_models, feetech
from hal.protocols.serial_status import Packets, Status, StatusReader

ANSWER_TIME, SLOW_ANSWER_TIME = 0.005, 0.02
"""A servo answers within this time [s]; the second is for an adapter that keeps bytes for milliseconds."""
MAKES: tuple[Packets, ...] = (feetech, dynamixel)
"""Protocols in the order in which they are tried."""


def scan_line(name: str, config: BusConfig) -> Scan:
    """Find the servos of a line; takes about five seconds, since ids that did not answer are asked a second time.

    Args:
        name: Name of the line.
        config: Its interface, channel and bit rate.

    Raises:
        BusGone: The port does not open, as while a HAL uses it, or failed.
    """
    port = Port(config.interface, config.channel, config.bitrate)
    begun = time.monotonic()
    try:
        nodes = [node for packets in MAKES for node in _servos(port, packets)]
    finally:
        port.close()
    if not nodes:
        raise BusGone(
            f"No servo answers on '{name}' at {config.bitrate} bit/s, asked for {time.monotonic() - begun:.1f} s. Are "
            "they powered? New Dynamixel servos have 57600 bit/s: try --bitrate 57600."
        )
    return Scan(name, nodes, {}, 0.0, "")


def _servos(port: Port, packets: Packets) -> list[Node]:
    reader = packets.reader()
    nodes: dict[int, Node] = {}
    numbers = range(packets.HIGHEST_NODE + 1)
    for number in (*numbers, *numbers):
        if number in nodes:
            continue
        malformed = reader.malformed
        status = _ask(port, packets.ping(number), number, reader)
        is_garbled = status is None and reader.malformed > malformed
        if status is None and not is_garbled:
            continue
        state = "its answer is garbled" if status is None else _describe(port, packets, status, reader)
        nodes[number] = Node(number, packets.NAME, state, is_doubled=is_garbled)
    return [nodes[number] for number in sorted(nodes)]


def _ask(port: Port, packet: bytes, node: int, reader: StatusReader) -> Status | None:
    """Return the answer of a servo; None without one."""
    port.drain()
    reader.clear()
    port.write(packet)
    reader.sent(packet)
    deadline = time.monotonic() + (SLOW_ANSWER_TIME if port.is_slow else ANSWER_TIME)
    while (left := deadline - time.monotonic()) > 0:
        for status in reader.feed(port.read(left)):
            if status.node == node:
                return status
    return None


def _describe(port: Port, packets: Packets, pinged: Status, reader: StatusReader) -> str:
    """Return model, firmware, voltage and temperature of a servo in words."""

    def get(address: int, size: int) -> bytes:
        packet = packets.read(pinged.node, address, size)
        status = _ask(port, packet, pinged.node, reader) or _ask(port, packet, pinged.node, reader)
        return status.data if status is not None and len(status.data) == size else b""

    if packets.NAME == dynamixel.NAME:
        number, firmware = int.from_bytes(pinged.data[:2], "little"), str(pinged.data[2:3].hex() and pinged.data[2])
        model = dynamixel_models.NAMES.get(number, f"model {number}")
        supply = get(dynamixel.Register.VOLTAGE, 3)
        volts, degrees = int.from_bytes(supply[:2], "little") * dynamixel.VOLTAGE_UNIT, supply[2:]
    else:
        head = get(feetech.Register.FIRMWARE, 5)
        number = int.from_bytes(head[3:5], "little")
        firmware = ".".join(str(byte) for byte in head[:2])
        model = feetech.MODELS.get(number) or feetech.BIG_ENDIAN.get(number) or f"model {number}"
        supply = get(feetech.Register.VOLTAGE, 2)
        volts, degrees = (supply[0] * feetech.VOLTAGE_UNIT if supply else 0.0), supply[1:]
    warmth = f", {volts:.1f} V, {degrees[0]} degC" if degrees else ""
    return f"{model}, firmware {firmware}{warmth}"
