"""A two-joint arm with a camera and three cable encoders loses its joint encoders. Plain arrays, no robot.

python examples/lost_sensor.py
"""

import numpy as np

from gemuco import Thresholds, TrainConfig, determine, estimate, fit

ANCHORS = np.array([[-0.3, 0.0], [0.3, 0.0], [0.0, 0.4]])
"""The cables leave the frame at these points [m]."""


def body(q: np.ndarray) -> dict[str, np.ndarray]:
    """Return what all sensors measure at joint angles q [rad], shape (n, 2)."""
    elbow = 0.3 * np.stack([np.sin(q[:, 0]), -np.cos(q[:, 0])], axis=1)
    tip = elbow + 0.25 * np.stack([np.sin(q.sum(axis=1)), -np.cos(q.sum(axis=1))], axis=1)
    cables = np.linalg.norm(tip[:, None] - ANCHORS, axis=2)
    return {"joint_position": q, "tool_tip_position": tip, "cable_length": cables}


units = {"joint_position": "rad", "tool_tip_position": "m", "cable_length": "m"}
random = np.random.default_rng(0)
episodes = [body(random.uniform([-1.0, 0.2], [1.0, 2.0], (200, 2))) for _ in range(15)]
config = TrainConfig(hidden=(60, 30), latent=6, epochs=80)

structure = determine(episodes, config, Thresholds(0.15, 0.15), units=units)
print(structure.report())
schema, _ = fit(episodes, config, structure.masks, x_out=structure.x_out, units=units)

now = {name: values[0] for name, values in body(np.array([[0.4, 1.1]])).items()}
joints = estimate(schema, now | {"joint_position": np.full(2, np.nan)})["joint_position"]
print(f"joints {now['joint_position']}, {joints.method} says {joints.value.round(3)} +- {joints.std.round(3)} rad")
