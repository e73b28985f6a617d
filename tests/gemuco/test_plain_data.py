"""A first program: plain arrays in, and one sentence where an argument is of the wrong kind."""

import numpy as np
import pytest

import gemuco
from gemuco import (
    Dataset,
    Episode,
    Layout,
    Signal,
    TrainConfig,
    adapt,
    control,
    determine,
    estimate,
    fit,
    judge,
    learn,
    save,
    score,
    simulate,
)
from gemuco.dataset import as_dataset
from gemuco.errors import DatasetError, NotEnoughData, SchemaError, WrongKind, WrongSize

UNITS = {"joint_position": "rad", "cable_length": "m"}
TINY = TrainConfig(hidden=(20,), latent=4, epochs=3)


def arrays(samples: int = 60, seed: int = 0) -> dict[str, np.ndarray]:
    q = np.random.default_rng(seed).uniform(-1.0, 1.0, samples)
    return {"joint_position": q, "cable_length": np.stack([np.sin(q), np.cos(q)], axis=1)}


def test_one_episode_is_a_dataset():
    data = as_dataset(arrays(), UNITS)
    assert [(s.name, s.size, s.unit) for s in data.layout.signals] == [
        ("joint_position", 1, "rad"),
        ("cable_length", 2, "m"),
    ]
    assert (len(data), data.conditions) == (60, ("default",))
    assert as_dataset(data) is data


@pytest.mark.parametrize(
    ("data", "conditions"),
    [
        ([arrays(20), arrays(30)], ("default", "default")),
        ({"light": [arrays(20)], "heavy": (arrays(20), arrays(10))}, ("light", "heavy", "heavy")),
        ({"light": arrays(20), "heavy": arrays(20)}, ("light", "heavy")),
        ({name: array.tolist() for name, array in arrays(20).items()}, ("default",)),
    ],
)
def test_episodes_and_conditions(data, conditions):
    assert tuple(e.condition for e in as_dataset(data, UNITS).episodes) == conditions


@pytest.mark.parametrize(
    ("data", "units", "kind", "text"),
    [
        (arrays(), None, DatasetError, "Signal 'joint_position' has no unit; give the units of plain data"),
        (arrays(), {**UNITS, "q": "m"}, DatasetError, "A unit of 'q' is given, but the data hold"),
        (arrays(), "rad", WrongKind, "The units must be a mapping of signal -> unit, not a str."),
        (np.zeros((3, 2)), UNITS, WrongKind, "The data must be a Dataset, .* not an array of shape"),
        ([np.zeros(3)], UNITS, WrongKind, "An episode of condition 'default' must be a mapping"),
        ([], UNITS, NotEnoughData, "hold no episode"),
        ({"joint_position": "a"}, {"joint_position": "rad"}, WrongSize, "needs an array of numbers, not a str"),
        ({"a": np.zeros(3), "b": np.zeros(4)}, {"a": "m", "b": "m"}, WrongSize, "Signal 'b' has shape"),
        ({"a": np.zeros((3, 2, 2))}, {"a": "m"}, WrongSize, "needs an array of shape"),
    ],
)
def test_says_what_is_wrong_with_plain_data(data, units, kind, text):
    with pytest.raises(kind, match=text):
        as_dataset(data, units)


def test_plain_data_train_as_a_dataset_does():
    plain = [arrays(40, seed) for seed in range(6)]
    masks = [{"cable_length"}]
    ours, _ = fit(plain, TINY, masks, units=UNITS)
    same, _ = fit(as_dataset(plain, UNITS), TINY, masks)
    assert all(np.array_equal(a, b) for a, b in zip(ours.weights.arrays(), same.weights.arrays(), strict=True))
    schema = learn(plain, TINY, masks, units=UNITS)
    assert estimate(schema, {"cable_length": np.array([0.5, 0.8])})["joint_position"].method == "mask"
    assert determine(plain, TINY, gemuco.Thresholds(1.0, 1.0), units=UNITS).layout.names == tuple(UNITS)


def test_estimates_a_batch_as_sample_by_sample(schema, arm):
    values = arm.sample(6, 3)
    values["joint_position"][:, 0] = np.nan
    values["muscle_length"][2] = np.nan
    values["muscle_tension"][3] = np.nan
    together = estimate(schema, values)
    for row in range(6):
        alone = estimate(schema, {name: array[row] for name, array in values.items()})
        for name, known in alone.items():
            for attribute in ("value", "std", "estimated", "residual"):
                np.testing.assert_array_equal(getattr(together[name], attribute)[row], getattr(known, attribute))
            assert (together[name].method[row], together[name].mask[row]) == (known.method, known.mask)
    assert set(together["joint_position"].method) == {"mask", "latent", "regression"}


def test_a_schema_shows_itself(schema):
    assert repr(schema).splitlines()[0] == "BodySchema of 3 signals (12 elements), 2 masks, p of 0"
    assert "conditions  none" in repr(schema)
    table = schema.summary()
    assert "muscle_tension         5  N      x_in, x_out" in table
    assert "joint_position [rad]" in table
    assert len(table.splitlines()) == 8


@pytest.mark.parametrize(
    ("wrong", "text"),
    [
        (lambda s: Signal("q", "2", "rad"), "The size of signal 'q' must be a whole number, not a str."),
        (lambda s: Signal("q", "rad", 2), "The size of signal 'q' must be a whole number, not a str."),
        (lambda s: Signal(2, 2, "rad"), "The name of a signal must be text, not an int."),
        (lambda s: Signal("q", 2, "rad", "ab"), "The elements of signal 'q' must be a tuple of names, not a str."),
        (lambda s: Layout(Signal), "The signals of a layout must be a tuple of Signal, not the class Signal."),
        (lambda s: Layout(Signal("q", 2, "rad")), "The signals of a layout must be a tuple of Signal, not a Signal."),
        (lambda s: Layout({}), "The signals of a layout must be a tuple of Signal, not a dict."),
        (lambda s: Layout(("q",)), "Every entry of a layout must be a Signal, not a str."),
        (lambda s: Episode({"q": np.zeros((3, 2))}, "bare"), "The condition of an episode must be text, not a dict."),
        (lambda s: Episode("bare", np.zeros(3)), "The values of an episode must be a mapping of signal -> array, "),
        (lambda s: Dataset((), s.layout), "The layout of a dataset must be a Layout, not a tuple."),
        (lambda s: Dataset(s.layout, Episode("bare", {})), "The episodes of a dataset must be a tuple of Episode, "),
        (lambda s: TrainConfig(hidden=60), "Training: hidden must be a tuple of widths, such as .200, 30., not "),
        (lambda s: estimate(s, np.zeros(3)), "Values must be a mapping of signal -> array, not an array of shape"),
        (lambda s: estimate({}, s), "The first argument must be a BodySchema, not a dict."),
        (lambda s: score(s, [1.0]), "Values must be a mapping of signal -> array, not a list."),
        (lambda s: adapt(s, {"joint_position": np.zeros(2)}), "Samples must be a list of mappings of signal -> "),
        (lambda s: adapt([{}], s), "The first argument must be a BodySchema, not a list."),
        (lambda s: adapt(s, [], "bias"), "The settings of an update must be an UpdateConfig, not a str."),
        (lambda s: judge(s, {"joint_position": np.zeros(2)}), "Samples must be a list of mappings"),
        (lambda s: control(s, np.zeros(2), command="muscle_length"), "The target must be a mapping of signal -> refer"),
        (lambda s: control(s, {"joint_position": np.zeros(2)}, [0.0], command="muscle_length"), "Values must be a"),
        (lambda s: control({}, s, command="muscle_length"), "The first argument must be a BodySchema, not a dict."),
        (lambda s: simulate(s, np.zeros((1, 5)), command=np.zeros(5)), "The command must be the name of a signal, "),
        (lambda s: control(s, {}, command="muscle_length", terms=gemuco.Match("q")), "The terms must be a tuple"),
        (lambda s: save("model", s), "The first argument must be a BodySchema, not a str."),
        (lambda s: fit({}, [{"a"}], TINY), "The settings of a training must be a TrainConfig, not a list."),
        (lambda s: determine(arrays(), {}, units=UNITS), "The settings of a training must be a TrainConfig, not a"),
    ],
)  # fmt: skip
def test_a_wrong_kind_gets_one_sentence(schema, wrong, text):
    with pytest.raises(SchemaError, match=text) as caught:
        wrong(schema)
    assert "\n" not in str(caught.value)
