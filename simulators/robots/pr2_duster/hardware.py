"""Drives of the arm's bus, each with its own electrical constants.

These are apart from the robot file on purpose: a robot file that disagrees with the hardware must read wrong values
here as it would on a bench. tests/simulators/test_robots_hardware.py checks that ours agrees.
"""

from simulators.nodes.canopen.spec import DriveConstants, NodeSpec

JOINTS: dict[str, tuple[float, int, float]] = {
    "shoulder_pan": (120.0, 1, -0.6),
    "shoulder_lift": (120.0, -1, 0.3),
    "upper_arm_roll": (80.0, 1, -0.9),
    "elbow_flex": (80.0, -1, -1.35),
    "forearm_roll": (50.0, 1, 0.1),
    "wrist_flex": (50.0, -1, -0.9),
    "wrist_roll": (50.0, 1, 0.1),
}
"""Joint -> gear, direction of the drive, and joint position [rad] at zero counts: the drives were zeroed at rest."""


def hardware() -> list[NodeSpec]:
    """Return seven drives, nodes 1 to 7 on can0."""
    return [
        NodeSpec(
            f"{name}_drive",
            "can0",
            1 + index,
            f"joint_position.{name}",
            DriveConstants(gear=gear, spool_radius=None, direction=direction, zero=zero),
        )
        for index, (name, (gear, direction, zero)) in enumerate(JOINTS.items())
    ]
