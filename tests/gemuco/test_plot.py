"""Pictures show what the schema and the samples have: numbers, names, and where something is estimated."""

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import pytest

import gemuco
from gemuco import plot
from gemuco.errors import UnknownSignal, WrongKind, WrongSize
from gemuco.plot.model import MOST_ROWS, listed
from gemuco.signals import Layout, Signal

POSITION, TENSION, LENGTH = "joint_position", "muscle_tension", "muscle_length"


@pytest.fixture(autouse=True)
def closed():
    yield
    plt.close("all")


@pytest.fixture
def rows(arm):
    return dict(arm.sample(30, 5))


def texts(axes):
    return [text.get_text() for text in axes.texts]


def test_the_structure_has_a_row_per_mask_and_the_error_of_what_is_inferred(schema):
    axes = plot.structure(schema)
    assert [label.get_text() for label in axes.get_xticklabels()] == list(schema.layout.names)
    assert len(axes.patches) == 4  # two masks of two given signals each
    expected = sorted(
        f"{100.0 * np.sqrt(schema.mask_error(mask, name)):.0f}"
        for mask in schema.masks
        for name in schema.x_out
        if name not in mask
    )
    assert sorted(texts(axes)) == expected
    assert axes.get_xlabel() == "dark: given; number: error of what is inferred [% of std]"


def test_many_masks_are_drawn_as_the_best_and_the_smallest(schema, monkeypatch):
    names = tuple(f"s{number}" for number in range(20))
    masks = tuple(frozenset((names[i], names[j])) for i in range(20) for j in range(i))

    class Body:
        layout = Layout(tuple(Signal(name, 1, "1") for name in names))
        x_out = names

        def ranked(self, name):
            return tuple(sorted(self.masks, key=lambda mask: name in mask))

    Body.masks = masks
    assert len(listed(Body())) == MOST_ROWS
    assert all(any(name not in mask for mask in listed(Body())) for name in names)


def test_the_errors_are_those_of_the_best_mask_in_the_signals_unit(schema):
    axes = plot.errors(schema)
    assert [label.get_text() for label in axes.get_yticklabels()] == list(schema.x_out)
    best = next(mask for mask in schema.ranked(POSITION) if POSITION not in mask)
    rms = np.sqrt(np.mean(schema.out_layout.split(schema.errors["mask", best])[POSITION] ** 2))
    assert f"  {rms:.3g} rad from {TENSION} + {LENGTH}" in texts(axes)
    widths = dict(zip(schema.x_out, (bar.get_width() for bar in axes.patches), strict=True))
    assert widths[POSITION] == pytest.approx(100.0 * np.sqrt(schema.mask_error(best, POSITION)))


def test_the_map_of_p_names_the_conditions(schema):
    assert texts(plot.bias_map(schema)) == ["This model has no parametric bias p."]


@pytest.mark.parametrize("size", [1, 2, 4])
def test_the_map_of_p_is_flat_for_any_size(schema, monkeypatch, size):
    random = np.random.default_rng(0)

    class Body:
        bias = np.zeros(size)
        biases = {name: random.standard_normal(size) for name in ("light", "heavy", "long")}  # noqa: RUF012

    monkeypatch.setattr("gemuco.plot.model.check_schema", lambda schema: None)
    axes = plot.bias_map(Body())
    assert texts(axes) == ["light", "heavy", "long"]
    (drawn,) = (line for line in axes.lines if line.get_label() == "trained conditions")
    x, y = drawn.get_data()
    if size <= 2:
        np.testing.assert_allclose(x, [p[0] for p in Body.biases.values()])
        np.testing.assert_allclose(y, [p[1] if size == 2 else 0.0 for p in Body.biases.values()])
    else:  # the plane of three points keeps their distances
        apart = np.linalg.norm(np.subtract(*list(Body.biases.values())[:2]))
        assert np.hypot(x[0] - x[1], y[0] - y[1]) == pytest.approx(apart, rel=0.35)
    assert axes.get_xlabel().startswith("principal axis 1 of 4" if size == 4 else "p1")


def test_an_estimate_is_drawn_where_a_value_is_missing_and_with_its_spread(schema, rows):
    rows[POSITION] = rows[POSITION].copy()
    rows[POSITION][10:20, 1] = np.nan
    axes = plot.estimate(schema, rows)
    (line,) = (
        line for line in axes.lines if line.get_label() == f"{POSITION}.{schema.layout.signal(POSITION).elements[1]}"
    )
    drawn = line.get_ydata()
    assert np.flatnonzero(np.isfinite(drawn)).tolist() == list(range(10, 20))
    estimates = gemuco.estimate(schema, rows)[POSITION]
    np.testing.assert_allclose(drawn[10:20], estimates.value[10:20, 1])
    (band,) = axes.collections
    band_rows = band.get_paths()[0].vertices
    assert np.ptp(band_rows[band_rows[:, 0] == 12.0][:, 1]) == pytest.approx(4.0 * estimates.std[12, 1], rel=1e-6)


def test_a_hidden_signal_is_drawn_beside_what_was_measured(schema, rows):
    axes = plot.estimate(schema, rows, hide=POSITION)
    measured = [line for line in axes.lines if line.get_label().startswith("_")]
    assert len(measured) == schema.layout.signal(POSITION).size
    np.testing.assert_allclose(measured[0].get_ydata(), rows[POSITION][:, 0])
    assert axes.get_ylabel() == "[rad]"
    given = plt.figure().subplots()
    assert plot.estimate(schema, rows, hide=[POSITION], axes=given) is given
    with pytest.raises(UnknownSignal, match="Signal 'nose' is not in the schema"):
        plot.estimate(schema, rows, hide="nose")
    with pytest.raises(WrongSize, match="A picture needs several samples"):
        plot.estimate(schema, {name: values[0] for name, values in rows.items()})
    assert "everything is measured" in plot.estimate(schema, rows).get_title(loc="left")


def test_samples_above_the_threshold_are_marked(schema, rows):
    rows[POSITION] = rows[POSITION].copy()
    rows[POSITION][12:15] += 2.0  # rad, what the muscles contradict
    axes = plot.anomaly(schema, rows)
    (marks,) = (line for line in axes.lines if line.get_label().startswith("anomaly"))
    assert {12, 13, 14} <= set(marks.get_xdata().tolist())
    judged = [gemuco.score(schema, {name: values[number] for name, values in rows.items()}) for number in range(30)]
    assert axes.get_title(loc="left") == f"{sum(one.is_anomaly for one in judged)} of 30 samples above the threshold"
    np.testing.assert_allclose(axes.lines[0].get_ydata(), [one.score for one in judged])


def test_a_notebook_shows_a_small_table(schema):
    table = schema._repr_html_()
    assert table.count("<tr>") == 1 + len(schema.layout.names)
    assert f"<td>{POSITION}</td>" in table
    assert f"{TENSION} + {LENGTH}" in table
    assert "2 feasible masks; conditions: none" in table
    assert len(table) < 2000


def test_only_a_schema_is_drawn(rows):
    for draw in (plot.structure, plot.errors, plot.bias_map):
        with pytest.raises(WrongKind):
            draw({"joint_position": 1})
    for draw in (plot.estimate, plot.anomaly):
        with pytest.raises(WrongKind):
            draw("schema", rows)
    assert gemuco.plot is plot
