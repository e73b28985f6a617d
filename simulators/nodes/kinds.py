"""Constants -> class of the simulated node: one line per kind."""

from collections.abc import Callable

from simulators.nodes.canopen.analog_input import AnalogConstants, AnalogInput
from simulators.nodes.canopen.encoder import JointEncoder
from simulators.nodes.canopen.load_cell import LoadCell
from simulators.nodes.canopen.spec import CellConstants, DriveConstants, EncoderConstants, NodeSpec
from simulators.nodes.cia402.drive import ServoDrive
from simulators.nodes.dbc.sensor import DbcConstants
from simulators.nodes.dbc.servo import make_dbc_node
from simulators.nodes.dbc_cell import DbcCell, DbcCellConstants
from simulators.nodes.mit_drive import MitConstants, MitDriveNode
from simulators.nodes.node import Frame, SimulatedNode
from simulators.nodes.odrive import OdriveAxis, OdriveConstants
from simulators.nodes.plant import Plant

KINDS: dict[type, Callable[[NodeSpec, Plant, list[Frame]], SimulatedNode]] = {
    DriveConstants: ServoDrive,
    CellConstants: LoadCell,
    AnalogConstants: AnalogInput,
    EncoderConstants: JointEncoder,
    MitConstants: MitDriveNode,
    OdriveConstants: OdriveAxis,
    DbcCellConstants: DbcCell,
    DbcConstants: make_dbc_node,
}


def make(spec: NodeSpec, plant: Plant, outbox: list[Frame]) -> SimulatedNode:
    """Make the node of a spec, not powered yet."""
    return KINDS[type(spec.constants)](spec, plant, outbox)
