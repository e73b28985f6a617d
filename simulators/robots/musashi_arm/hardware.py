"""Nodes of the arm's two buses, each with its own electrical constants.

These are apart from the robot file on purpose: a robot file that disagrees with the hardware must read wrong values
here as it would on a bench. tests/simulators/test_robots_hardware.py checks that ours agrees.
"""

import math

from simulators.nodes.canopen.spec import CellConstants, DriveConstants, EncoderConstants, NodeSpec

MUSCLES: dict[str, tuple[str, int, float]] = {
    "deltoid_front": ("can0", 1, 0.152),
    "deltoid_side": ("can0", -1, 0.253),
    "deltoid_back": ("can0", 1, 0.119),
    "pectoral": ("can0", -1, 0.129),
    "latissimus": ("can0", 1, 0.203),
    "infraspinatus": ("can1", -1, 0.099),
    "biceps": ("can1", 1, 0.419),
    "brachialis": ("can1", -1, 0.122),
    "triceps": ("can1", 1, 0.256),
    "pronator": ("can1", -1, 0.113),
}
"""Muscle -> bus, direction of the drive, and wire length [m] at zero counts: the drives were zeroed at about the rest
posture.
"""

JOINTS: dict[str, tuple[str, int]] = {
    "shoulder_roll": ("can0", 1),
    "shoulder_pitch": ("can0", -1),
    "shoulder_yaw": ("can0", 1),
    "elbow_pitch": ("can1", -1),
    "elbow_yaw": ("can1", 1),
}
"""Joint -> bus and direction of the encoder."""


def hardware() -> list[NodeSpec]:
    """Return ten drives (nodes 1 to 10), ten load cells (11 to 20), five encoders (21 to 25)."""
    nodes = []
    for index, (name, (bus, direction, zero)) in enumerate(MUSCLES.items()):
        drive = DriveConstants(direction=direction, zero=zero, load=f"muscle_tension.{name}")
        nodes.append(NodeSpec(f"{name}_drive", bus, 1 + index, f"muscle_length.{name}", drive))
    for index, (name, (bus, _, _)) in enumerate(MUSCLES.items()):
        nodes.append(NodeSpec(f"{name}_cell", bus, 11 + index, f"muscle_tension.{name}", CellConstants()))
    for index, (name, (bus, direction)) in enumerate(JOINTS.items()):
        encoder = EncoderConstants(direction=direction, zero=-direction * math.pi)
        nodes.append(NodeSpec(f"{name}_encoder", bus, 21 + index, f"joint_position.{name}", encoder))
    return nodes
