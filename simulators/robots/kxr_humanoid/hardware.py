"""Nodes of the robot's bus, each with its own electrical constants.

These are apart from the robot file on purpose: a robot file that disagrees with the hardware must read wrong values
here as it would on a bench. tests/simulators/test_robots_hardware.py checks that ours agrees.
"""

from simulators.nodes.canopen.spec import CellConstants, DriveConstants, NodeSpec

SERVOS: dict[str, tuple[int, float]] = {
    "shoulder_pitch": (1, -0.6),
    "shoulder_yaw": (-1, 0.0),
    "elbow_pitch": (1, -0.9),
    "ankle_pitch": (-1, 0.0),
}
"""Joint -> direction of the drive, and joint position [rad] at zero counts: the drives were zeroed at the rest
posture.
"""

CORNERS: dict[str, float] = {
    "left_front_outer": 0.03,
    "left_front_inner": -0.02,
    "left_back_outer": 0.01,
    "left_back_inner": 0.04,
    "right_front_inner": -0.03,
    "right_front_outer": 0.02,
    "right_back_inner": 0.0,
    "right_back_outer": -0.01,
}
"""Every cell reads this without a load [N]; the robot file subtracts it."""


def hardware() -> list[NodeSpec]:
    """Return four drives (nodes 1 to 4) and eight load cells (11 to 18)."""
    nodes = []
    for index, (name, (direction, zero)) in enumerate(SERVOS.items()):
        drive = DriveConstants(
            counts_per_turn=4096, gear=200, spool_radius=None, direction=direction, zero=zero, rated_torque=0.007
        )
        nodes.append(NodeSpec(f"{name}_drive", "can0", 1 + index, f"joint_position.{name}", drive))
    for index, (name, unbalance) in enumerate(CORNERS.items()):
        cell = CellConstants(capacity=50.0, counts_per_newton=20_000.0, unbalance=unbalance, decimal_digits=3)
        nodes.append(NodeSpec(f"{name}_cell", "can0", 11 + index, f"foot_force.{name}", cell))
    return nodes
