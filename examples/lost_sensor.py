"""A two-joint arm with a camera and three cable encoders loses its joint encoders. Plain arrays, no robot.

python examples/lost_sensor.py
"""

import numpy as np

from gemuco import Dataset, Episode, Layout, Signal, Thresholds, TrainConfig, determine, estimate, fit

ANCHORS = np.array([[-0.3, 0.0], [0.3, 0.0], [0.0, 0.4]])
"""Where the cables leave the frame [m]."""


def body(q: np.ndarray) -> dict[str, np.ndarray]:
    """What all sensors say at joint angles q [rad], shape (n, 2)."""
    elbow = 0.3 * np.stack([np.sin(q[:, 0]), -np.cos(q[:, 0])], axis=1)
    tip = elbow + 0.25 * np.stack([np.sin(q.sum(axis=1)), -np.cos(q.sum(axis=1))], axis=1)
    cables = np.linalg.norm(tip[:, None] - ANCHORS, axis=2)
    return {"joint_position": q, "tool_tip_position": tip, "cable_length": cables}


layout = Layout(
    (Signal("joint_position", 2, "rad"), Signal("tool_tip_position", 2, "m"), Signal("cable_length", 3, "m"))
)
random = np.random.default_rng(0)
episodes = tuple(Episode("bare", body(random.uniform([-1.0, 0.2], [1.0, 2.0], (200, 2)))) for _ in range(15))
config = TrainConfig(hidden=(60, 30), latent=6, epochs=80)

found = determine(Dataset(layout, episodes), config, Thresholds(0.15, 0.15))
print(found.report())
schema, _ = fit(Dataset(layout, episodes), config, found.masks, x_out=found.x_out)

now = {name: values[0] for name, values in body(np.array([[0.4, 1.1]])).items()}
joints = estimate(schema, now | {"joint_position": np.full(2, np.nan)})["joint_position"]
print(f"joints {now['joint_position']}, {joints.method} says {joints.value.round(3)} +- {joints.std.round(3)} rad")
