"""The body schema as the face of it all, on plain arrays."""

import pickle
from dataclasses import replace

import numpy as np

from gemuco.adaption.adapt import LIST, adapt
from gemuco.anomaly.score import score
from gemuco.checkpoint import load, save
from gemuco.controller import control
from gemuco.estimation import estimate
from gemuco.learning.train import TrainConfig
from gemuco.simulation import simulate
from gemuco.structure.determination import learn

LENGTH, TENSION, POSITION = "muscle_length", "muscle_tension", "joint_position"


def test_every_verb_from_arrays_to_a_stored_body(arm, data, tmp_path):
    config = TrainConfig(hidden=(60, 20), latent=7, epochs=40, batch=100)
    body = learn(data, config)  # structure determined on the way
    assert frozenset({TENSION, LENGTH}) in body.masks
    sample = {name: rows[0] for name, rows in arm.sample(1, 9).items()}

    position = estimate(body, {name: sample[name] for name in (LENGTH, TENSION)})[POSITION]
    assert np.linalg.norm(position.value - sample[POSITION]) < 0.3  # rad
    solution = control(body, {POSITION: sample[POSITION], TENSION: sample[TENSION]}, sample, command=LENGTH)
    assert solution.route == "mask"
    assert np.abs(solution.command - sample[LENGTH]).max() < 0.01  # m
    (state,) = simulate(body, [sample[LENGTH]], command=LENGTH, route="input", mask=frozenset({POSITION, TENSION}))
    assert np.abs(state.values[LENGTH] - sample[LENGTH]).max() < 0.02  # m
    assert not score(body, sample).is_anomaly

    lived = arm.sample(40, 11)
    wiser = adapt(body, ({name: rows[i] for name, rows in lived.items()} for i in range(40)), replace(LIST, batch=10))
    assert wiser is not body
    save(wiser, tmp_path)
    again = load(tmp_path)
    np.testing.assert_array_equal(estimate(again, sample)[POSITION].value, estimate(wiser, sample)[POSITION].value)
    other = pickle.loads(pickle.dumps(again))  # as to another process, after it was used
    np.testing.assert_array_equal(estimate(other, sample)[POSITION].value, estimate(wiser, sample)[POSITION].value)
