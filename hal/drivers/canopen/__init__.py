"""CANopen nodes, and sensors of CiA 401, CiA 404 and CiA 406."""

from hal.drivers.canopen.analog import Cia401Input, Cia404Cell
from hal.drivers.canopen.cia406 import Cia406Encoder

__all__ = ["Cia401Input", "Cia404Cell", "Cia406Encoder"]
