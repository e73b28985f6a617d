"""Which class plays which kind of node: one line per kind."""

from simulators.nodes.analog_input import AnalogConstants, AnalogInput
from simulators.nodes.drive import ServoDrive
from simulators.nodes.encoder import JointEncoder
from simulators.nodes.load_cell import LoadCell
from simulators.nodes.mit_drive import MitConstants, MitDriveNode
from simulators.nodes.node import Frame, SimulatedNode
from simulators.nodes.plant import Plant
from simulators.nodes.spec import CellConstants, DriveConstants, EncoderConstants, NodeSpec

KINDS = {
    DriveConstants: ServoDrive,
    CellConstants: LoadCell,
    AnalogConstants: AnalogInput,
    EncoderConstants: JointEncoder,
    MitConstants: MitDriveNode,
}


def make(spec: NodeSpec, plant: Plant, outbox: list[Frame]) -> SimulatedNode:
    """The node that a spec describes, not powered yet."""
    return KINDS[type(spec.constants)](spec, plant, outbox)
