"""The key space, whole. Nouns are published, verbs are queried; docs/keys.md says it in words."""

ROOT = "gemuco"
SERVICES = ("simulator", "hal", "vision", "model", "recorder")


def robot_key(robot: str, *parts: str) -> str:
    """`gemuco/<robot>/<parts...>`."""
    return "/".join((ROOT, robot, *parts))


def sample(robot: str) -> str:
    """Published by hal every cycle: `messages.Sample`, what was measured."""
    return robot_key(robot, "hal", "sample")


def applied(robot: str) -> str:
    """Published by hal every cycle: `messages.Applied`, what was really sent to the drives."""
    return robot_key(robot, "hal", "applied")


def vision(robot: str) -> str:
    """Published by whatever looks at the robot, at its own rate: `messages.Sample` of what it sees."""
    return robot_key(robot, "vision", "sample")


def command(robot: str) -> str:
    """Put by whoever commands: `messages.Command`, what is desired."""
    return robot_key(robot, "hal", "command")


def holder(robot: str) -> str:
    """Published by hal once a second and when it changes: `messages.Holder`, who commands."""
    return robot_key(robot, "hal", "holder")


def estimate(robot: str) -> str:
    """Published by model at the estimation rate: `messages.Estimates`."""
    return robot_key(robot, "model", "estimate")


def anomaly(robot: str) -> str:
    """Published by model at the anomaly rate: `messages.Anomaly`."""
    return robot_key(robot, "model", "anomaly")


def update(robot: str) -> str:
    """Published by model at the update rate: `messages.Update`."""
    return robot_key(robot, "model", "update")


def target(robot: str) -> str:
    """Put by whoever directs the controller: `messages.Target`."""
    return robot_key(robot, "model", "target")


def truth(robot: str) -> str:
    """Published by a simulator only: `messages.Sample` whose source is `truth`."""
    return robot_key(robot, "simulator", "truth")


def status(robot: str, service: str) -> str:
    """Published by every service once a second: `messages.Status`."""
    return robot_key(robot, service, "status")


def verb(robot: str, service: str, name: str) -> str:
    """Queried: a verb of a service (`hal/do/enable`, `model/do/estimate`, `simulator/do/fault`)."""
    return robot_key(robot, service, "do", name)


def alive(robot: str, service: str) -> str:
    """Liveliness token of a service."""
    return robot_key(robot, service, "alive")


def everything(robot: str) -> str:
    """Key expression of all that a robot's services publish."""
    return robot_key(robot, "**")


def parse(key: str) -> tuple[str, str, str]:
    """Split a key into robot, service and the rest (`sample`, `do/enable`).

    Raises:
        ValueError: The key is not of this key space.
    """
    root, _, rest = key.partition("/")
    parts = rest.split("/", 2)
    if root != ROOT or len(parts) != 3 or not all(parts):
        raise ValueError(f"'{key}' is not a gemuco key; those read gemuco/<robot>/<service>/<noun>.")
    return parts[0], parts[1], parts[2]
