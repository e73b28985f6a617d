"""A body schema on plain arrays: two joints that hold sticks of several lengths recognise one they never held.

Run `python examples/another_tool.py`; it takes a few seconds.
"""

import numpy as np

from gemuco import BodySchema, TrainConfig, UpdateConfig, adapt, estimate, learn


def body(q: np.ndarray, stick: float) -> dict[str, np.ndarray]:
    """Return joint angles q [rad], shape (n, 2), and the position of the end of a stick [m]."""
    elbow = 0.3 * np.stack([np.sin(q[:, 0]), -np.cos(q[:, 0])], axis=1)
    tip = elbow + (0.25 + stick) * np.stack([np.sin(q.sum(axis=1)), -np.cos(q.sum(axis=1))], axis=1)
    return {"joint_position": q, "tool_tip_position": tip}


units = {"joint_position": "rad", "tool_tip_position": "m"}
random = np.random.default_rng(0)


def moves(count: int) -> np.ndarray:
    """Return random joint angles [rad], shape (count, 2)."""
    return random.uniform([-1.0, 0.2], [1.0, 2.0], (count, 2))


episodes = {f"stick {s:g}": [body(moves(100), s) for _ in range(5)] for s in (0.0, 0.1, 0.2, 0.3, 0.4)}
schema = learn(episodes, TrainConfig(hidden=(60, 30), latent=6, bias_size=1, epochs=120), units=units)
print("p of every stick:", ", ".join(f"{name} {p[0]:.2f}" for name, p in schema.biases.items()))

now = body(moves(50), 0.25)
first = [{name: values[i] for name, values in now.items()} for i in range(3)]


def error(model: BodySchema) -> float:
    """Return the mean error of the tip, estimated from the joints alone [m], over the samples after the third."""
    tip = estimate(model, {"joint_position": now["joint_position"][3:]})["tool_tip_position"].value
    return float(np.linalg.norm(tip - now["tool_tip_position"][3:], axis=1).mean())


believed = schema.under("stick 0")
adapted = adapt(believed, first, UpdateConfig(what="bias"))
print(f"a stick of 0.25 m: tip wrong by {1e3 * error(believed):.0f} mm,", end=" ")
print(f"after three samples by {1e3 * error(adapted):.0f} mm, p {adapted.bias.round(2)}")
