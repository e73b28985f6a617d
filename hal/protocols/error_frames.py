"""Error frames: reports of a CAN controller on itself and on the bus, in the format of Linux.

Source: include/uapi/linux/can/error.h (classes in the identifier, details in eight data bytes). Error counters go up by
8 per bad frame and down by 1 per good one; from 96 the controller warns, from 128 it is error passive, and when its
transmit counter exceeds 255 it leaves the bus (ISO 11898-1, fault confinement).
"""

from dataclasses import dataclass
from enum import IntEnum

TX_TIMEOUT = 0x001
LOST_ARBITRATION = 0x002
CONTROLLER = 0x004
PROTOCOL = 0x008
TRANSCEIVER = 0x010
NO_ACKNOWLEDGE = 0x020
BUS_OFF = 0x040
BUS_ERROR = 0x080
RESTARTED = 0x100
COUNTERS = 0x200

_RX_OVERFLOW, _TX_OVERFLOW = 0x01, 0x02
_WARNING, _PASSIVE, _ACTIVE = 0x0C, 0x30, 0x40
_VIOLATIONS = {
    0x01: "a single bit was wrong",
    0x02: "a frame had the wrong form",
    0x04: "bit stuffing was wrong",
    0x08: "a dominant bit could not be sent",
    0x10: "a recessive bit could not be sent",
    0x20: "the bus is overloaded",
}
_COUNT_WARNING, _COUNT_PASSIVE = 96, 128
_NO_TROUBLE = LOST_ARBITRATION | CONTROLLER | RESTARTED | COUNTERS


class Controller(IntEnum):
    """Fault confinement of a controller, worst last."""

    ACTIVE = 0
    WARNING = 1
    PASSIVE = 2
    OFF = 3


@dataclass(frozen=True, slots=True)
class ErrorFrame:
    """The content of an error frame.

    Attributes:
        controller: Present state of the controller; None if it is not in the frame.
        text: The error in a sentence; empty without one, as when the controller has recovered.
        counters: The controller's transmit and receive error counters; None if the frame has none.
    """

    controller: Controller | None
    text: str
    counters: tuple[int, int] | None


_STATES: dict[Controller | None, str] = {
    Controller.WARNING: "The controller counts many errors. Check wiring, termination and bit rate.",
    Controller.PASSIVE: "The controller is error passive. Check wiring, termination and bit rate.",
    Controller.OFF: "The controller is bus-off. Check wiring, termination and bit rate; set restart-ms.",
}


def error_frame(kind: int, data: bytes | bytearray) -> ErrorFrame:
    """Parse an error frame; missing bytes are zero.

    Args:
        kind: Error classes, from its identifier.
        data: At most eight bytes.
    """
    detail = bytes(data[:8]).ljust(8, b"\0")
    counters = (detail[6], detail[7]) if kind & COUNTERS or (kind & CONTROLLER and any(detail[6:])) else None
    controller = _controller(kind, detail, counters)
    text = "" if controller is Controller.OFF else _text(kind, detail)
    return ErrorFrame(controller, text or _STATES.get(controller, ""), counters)


def _controller(kind: int, detail: bytes, counters: tuple[int, int] | None) -> Controller | None:
    if kind & BUS_OFF:
        return Controller.OFF
    if kind & RESTARTED:
        return Controller.ACTIVE
    if kind & CONTROLLER:
        if detail[1] & _PASSIVE:
            return Controller.PASSIVE
        if detail[1] & _WARNING:
            return Controller.WARNING
        if detail[1] & _ACTIVE:
            return Controller.ACTIVE
    if not kind & COUNTERS or counters is None:
        return None
    worst = max(counters)
    if worst >= _COUNT_PASSIVE:
        return Controller.PASSIVE
    return Controller.WARNING if worst >= _COUNT_WARNING else Controller.ACTIVE


def _text(kind: int, detail: bytes) -> str:
    if kind & NO_ACKNOWLEDGE:
        return "No node acknowledges frames. Is any node powered, is the cable in?"
    if kind & CONTROLLER:
        if detail[1] & _RX_OVERFLOW:
            return "The controller's receive buffer overflowed, frames were lost. Is this machine overloaded?"
        if detail[1] & _TX_OVERFLOW:
            return "The controller's transmit buffer overflowed, frames were lost."
    if kind & TRANSCEIVER:
        return f"The transceiver reports a fault of the wires ({detail[4]:02X}h)."
    if kind & PROTOCOL:
        violations = [text for bit, text in _VIOLATIONS.items() if detail[2] & bit] or ["the protocol was violated"]
        return f"Frames are disturbed: {', '.join(violations)}. Check wiring and termination."
    if kind & BUS_ERROR:
        return "Frames are disturbed. Check wiring, termination and bit rate."
    if kind & TX_TIMEOUT:
        return "The controller could not send a frame in time."
    return "" if kind & _NO_TROUBLE else f"The controller reports an error of class {kind:X}h."
