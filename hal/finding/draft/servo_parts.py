"""Parts of a drafted robot file for servos on a serial line."""

from hal.finding.draft.parts import Measure, Names, Part
from hal.finding.scan import Node
from hal.protocols import dynamixel_models, feetech

SLOW = 0.5
"""A temperature is stale after this time [s]."""
NO_WATCHDOG = "Feetech servos have no watchdog (docs/devices.md): provide another way to cut their power."


def servo_part(node: Node, names: Names, notes: list[str]) -> Part | None:
    """Return the part of a servo that a scan reported; None, and a note, if it is not supported.

    Args:
        node: Node of the scan; its state begins with the model.
        names: Names that are given.
        notes: Sentences on what was left out or guessed.
    """
    model = node.state.partition(",")[0]
    force = Measure("load", "joint_load", "", "1")
    if node.protocol == feetech.NAME:
        if model in feetech.BIG_ENDIAN.values():
            notes.append(
                f"Left out: servo {node.node} is a {model}, whose registers differ from those of the STS series."
            )
            return None
        settings: dict[str, object] = {"allow_no_watchdog": True}
        if NO_WATCHDOG not in notes:
            notes.append(NO_WATCHDOG)
    else:
        if model not in dynamixel_models.MODELS:
            known = ", ".join(dynamixel_models.MODELS)
            notes.append(f"Left out: servo {node.node} is a {model}. Known models: {known}.")
            return None
        settings = {"model": model}
        kind = dynamixel_models.MODELS[model]
        if not kind.stops_alone:
            settings["allow_no_watchdog"] = True
            notes.append(f"The watchdog of servo {node.node} does not stop it (docs/devices.md).")
        if kind.current_unit is not None:
            force = Measure("current", "joint_current", "", "A")
    name = names.new(f"servo_{node.node}")
    joint = f"joint_{node.node}"
    measures = (
        Measure("position", "joint_position", joint, "rad"),
        Measure("velocity", "joint_velocity", joint, "rad/s"),
        Measure(force.quantity, force.signal, joint, force.unit),
        Measure("temperature", "motor_temperature", joint, "degC", SLOW),
    )
    settings |= {"direction": 1, "zero": 0.0}
    return Part(
        name, node.protocol.lower(), settings, node.node, measures, f"servo {node.node}: {node.state}",
        "direction and zero", is_drive=True,
    )  # fmt: skip
