"""Generic input modules: analogue inputs in their several types, and the switch that lets them be sent.

Source: CiA 401, version 3: 6401h, 6402h, 6403h (analogue inputs; the sub-index is the channel), 6423h (global interrupt
enable: while it is FALSE, as after power-on, no PDO with an analogue input is sent on an event). An input with fewer
bits than the object is shifted to the left, so that full scale is full scale of the object.
"""

from hal.protocols.cia301 import Mapped

PROFILE = 401

INTERRUPT_ENABLE = Mapped(0x6423, 0, 8)
"""BOOLEAN, which SDO carries in one byte."""

INPUTS = {
    "int16": Mapped(0x6401, 0, 16, "signed"),
    "int32": Mapped(0x6402, 0, 32, "signed"),
    "float32": Mapped(0x6403, 0, 32, "float"),
}
"""Read analogue input, without its channel."""
