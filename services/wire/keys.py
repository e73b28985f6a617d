"""The whole key space. Nouns are published, verbs are queried; docs/keys.md describes them."""

ROOT = "gemuco"
SERVICES = ("simulator", "hal", "vision", "model", "recorder")


def robot_key(robot: str, *parts: str) -> str:
    """Return `gemuco/<robot>/<parts...>`."""
    return "/".join((ROOT, robot, *parts))


def sample(robot: str) -> str:
    """Return the key that hal publishes every cycle: `messages.Sample`, the measured values."""
    return robot_key(robot, "hal", "sample")


def applied(robot: str) -> str:
    """Return the key that hal publishes every cycle: `messages.Applied`, the set-points sent to the drives."""
    return robot_key(robot, "hal", "applied")


def vision(robot: str) -> str:
    """Return the key that a camera's process publishes at its own rate: `messages.Sample`."""
    return robot_key(robot, "vision", "sample")


def command(robot: str) -> str:
    """Return the key that the commanding client publishes: `messages.Command`, the desired values."""
    return robot_key(robot, "hal", "command")


def holder(robot: str) -> str:
    """Return the key that hal publishes once a second and on a change: `messages.Holder`, the lease holder."""
    return robot_key(robot, "hal", "holder")


def estimate(robot: str) -> str:
    """Return the key that model publishes at the estimation rate: `messages.Estimates`."""
    return robot_key(robot, "model", "estimate")


def anomaly(robot: str) -> str:
    """Return the key that model publishes at the anomaly rate: `messages.Anomaly`."""
    return robot_key(robot, "model", "anomaly")


def update(robot: str) -> str:
    """Return the key that model publishes at the update rate: `messages.Update`."""
    return robot_key(robot, "model", "update")


def target(robot: str) -> str:
    """Return the key that the client of the controller publishes: `messages.Target`."""
    return robot_key(robot, "model", "target")


def truth(robot: str) -> str:
    """Return the key that only a simulator publishes: `messages.Sample` whose source is `truth`."""
    return robot_key(robot, "simulator", "truth")


def status(robot: str, service: str) -> str:
    """Return the key that every service publishes once a second: `messages.Status`."""
    return robot_key(robot, service, "status")


def verb(robot: str, service: str, name: str) -> str:
    """Return the key of a verb, which is queried (`hal/do/enable`, `model/do/estimate`, `simulator/do/fault`)."""
    return robot_key(robot, service, "do", name)


def alive(robot: str, service: str) -> str:
    """Return the key of a service's liveliness token."""
    return robot_key(robot, service, "alive")


def everything(robot: str) -> str:
    """Return the key expression that covers every key of a robot."""
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
