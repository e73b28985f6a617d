from types import SimpleNamespace

import numpy as np
import pytest
from muscle_arm import LAYOUT

from gemuco.dataset import Dataset, Episode
from gemuco.errors import NotEnoughData, SchemaError, UnknownSignal
from gemuco.learning.learner import Course, Learner
from gemuco.learning.train import TrainConfig, fit

MASKS = [{"joint_position", "muscle_tension"}, {"muscle_tension", "muscle_length"}]
TINY = TrainConfig(hidden=(20,), latent=5, epochs=3, batch=100)


def test_the_same_seed_gives_the_same_model(data):
    first, second = fit(data, TINY, MASKS)[0], fit(data, TINY, MASKS)[0]
    for one, other in zip(first.weights.arrays(), second.weights.arrays(), strict=True):
        np.testing.assert_array_equal(one, other)
    third = fit(data, TrainConfig(hidden=(20,), latent=5, epochs=3, batch=100, seed=1), MASKS)[0]
    assert not np.array_equal(first.weights.encoder[0].matrix, third.weights.encoder[0].matrix)


def test_tells_its_progress_and_its_history(data):
    prediction = []
    _, history = fit(data, TINY, MASKS, lambda share, text: prediction.append((share, text)))
    assert [share for share, _ in prediction] == pytest.approx([1 / 3, 2 / 3, 1.0])
    assert "held-out loss" in prediction[-1][1]
    assert len(history.train) == len(history.held_out) == 3
    assert history.best_epoch == int(np.argmin(history.held_out))


def test_stops_early(data):
    config = TrainConfig(hidden=(20,), latent=5, epochs=50, batch=100, rate=0.0, patience=2)
    assert len(fit(data, config, MASKS)[1].train) == 3


@pytest.mark.parametrize(
    ("train", "held_out", "ends"),
    [
        ([0.5, 0.3, 0.2, 0.1, 0.08], [0.4, 0.5, 0.55, 0.6, 0.65], True),  # learns by heart
        ([0.5, 0.6, 0.5, 0.6, 0.5], [0.2, 0.3, 0.25, 0.3, 0.25], False),  # W swings at a high rate
        ([0.5, 0.3, 0.2, 0.1, 0.08], [0.4, 0.3, 0.2, 0.15, 0.12], False),  # goes on falling
        ([0.5] * 9, [0.2, *[0.3] * 8], True),  # all epochs are done
    ],
)
def test_a_loss_that_has_stopped_falling_ends_the_training_only_if_that_on_the_training_data_is_lower(
    train, held_out, ends
):
    course = Course(train=train, held_out=held_out, least=min(held_out), best_epoch=int(np.argmin(held_out)))
    state = SimpleNamespace(epoch=len(train), epochs=9, course=course, config=TrainConfig(patience=3))
    assert Learner.is_done.fget(state) == ends


def test_trains_on_rows_with_gaps(arm):
    random = np.random.default_rng(0)
    episodes = []
    for seed in range(6):
        values = arm.sample(200, seed)
        values["joint_position"][random.random((200, 2)) < 0.3] = np.nan
        episodes.append(Episode("new", values))
    schema, history = fit(Dataset(LAYOUT, tuple(episodes)), TrainConfig(hidden=(40,), latent=7, epochs=40), MASKS)
    assert history.held_out[history.best_epoch] < 0.5 * history.held_out[0]
    assert all(np.isfinite(array).all() for array in schema.weights.arrays())


def test_one_bias_per_condition(arm):
    soft = type(arm)(softness=2.5)
    episodes = tuple(
        Episode(name, body.sample(200, seed)) for seed in range(4) for name, body in (("new", arm), ("worn", soft))
    )
    config = TrainConfig(hidden=(40, 20), latent=7, epochs=60, batch=100, bias_size=1)
    schema, _ = fit(Dataset(LAYOUT, episodes), config, MASKS)
    assert set(schema.biases) == {"new", "worn"}
    assert abs(schema.biases["new"][0] - schema.biases["worn"][0]) > 0.1


def test_says_what_is_wrong(data):
    with pytest.raises(SchemaError, match="Known activations: tanh, sigmoid, relu"):
        TrainConfig(activation="swish")
    with pytest.raises(UnknownSignal, match="Mask names 'wire'"):
        fit(data, TINY, [{"wire"}])
    with pytest.raises(NotEnoughData, match="at least one mask"):
        fit(data, TINY, [])


def test_rows_that_fit_no_mask(arm):
    values = arm.sample(200, 0)
    values["muscle_tension"][0::2, 0] = np.nan
    values["muscle_tension"][1::2, 1] = np.nan
    with pytest.raises(NotEnoughData, match="No sample has all signals of any mask"):
        fit(Dataset(LAYOUT, (Episode("new", values),)), TINY, [{"muscle_tension"}])
