"""A body schema on plain arrays: two joints that hold sticks of several lengths recognise one they never held.

Run `python examples/another_tool.py`; it takes a few seconds.
"""

import numpy as np

from gemuco import BodySchema, Dataset, Episode, Layout, Signal, TrainConfig, UpdateConfig, adapt, estimate, learn


def body(q: np.ndarray, stick: float) -> dict[str, np.ndarray]:
    """Joint angles q [rad], shape (n, 2), and where the end of a stick [m] is."""
    elbow = 0.3 * np.stack([np.sin(q[:, 0]), -np.cos(q[:, 0])], axis=1)
    tip = elbow + (0.25 + stick) * np.stack([np.sin(q.sum(axis=1)), -np.cos(q.sum(axis=1))], axis=1)
    return {"joint_position": q, "tool_tip_position": tip}


layout = Layout((Signal("joint_position", 2, "rad"), Signal("tool_tip_position", 2, "m")))
random = np.random.default_rng(0)


def moves(count: int) -> np.ndarray:
    """Random joint angles [rad], shape (count, 2)."""
    return random.uniform([-1.0, 0.2], [1.0, 2.0], (count, 2))


episodes = [
    Episode(f"stick {stick:g}", body(moves(100), stick)) for stick in (0.0, 0.1, 0.2, 0.3, 0.4) for _ in range(5)
]
schema = learn(Dataset(layout, tuple(episodes)), TrainConfig(hidden=(60, 30), latent=6, bias_size=1, epochs=120))
print("p of every stick:", ", ".join(f"{name} {p[0]:.2f}" for name, p in schema.biases.items()))

now = body(moves(50), 0.25)
samples = [{name: values[i] for name, values in now.items()} for i in range(50)]


def error(model: BodySchema) -> float:
    """How far from the truth the tip is estimated from the joints alone [m], over the samples after the third."""
    found = [estimate(model, {"joint_position": s["joint_position"]})["tool_tip_position"].value for s in samples[3:]]
    return float(np.mean([np.linalg.norm(f - s["tool_tip_position"]) for f, s in zip(found, samples[3:], strict=True)]))


believed = schema.under("stick 0")
adapted = adapt(believed, samples[:3], UpdateConfig(what="bias"))
print(f"a stick of 0.25 m: tip wrong by {1e3 * error(believed):.0f} mm,", end=" ")
print(f"after three samples by {1e3 * error(adapted):.0f} mm, p {adapted.bias.round(2)}")
