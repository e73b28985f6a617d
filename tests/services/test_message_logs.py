"""Logs in which a row has one message: by columns, by names, and by files, each with stamps of its own."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from gemuco.errors import DatasetError
from hal.errors import ConfigError
from services.measured.alignment import aligned
from services.measured.description import load_measured
from services.measured.draft import draft
from services.measured.reading import read_measured

PERIODS = {"ABS": 0.01, "ESP": 0.02, "4F1": 0.1}
"""Messages and the time between them [s]."""
SIGNALS = {"ABS": ("left_mps", "right_mps"), "ESP": ("yaw_radps",), "4F1": ("supply_v",)}
LENGTH = 20.0


def value(column: int, t: np.ndarray) -> np.ndarray:
    return (column + 1.0) * np.sin((0.5 + 0.3 * column) * t)


def messages(seed: int) -> list[tuple[float, str, list[float]]]:
    """Return stamp, name and values of every message of a bus, in the order in which they arrived."""
    random, rows, first = np.random.default_rng(seed), [], 0
    for name, period in PERIODS.items():
        stamps = random.uniform(0.0, period) + np.arange(0.0, LENGTH, period)
        stamps += random.uniform(0.0, 0.1 * period, len(stamps))
        for t in stamps:
            rows.append((float(t), name, [float(value(first + k, t)) for k in range(len(SIGNALS[name]))]))
        first += len(SIGNALS[name])
    return sorted(rows)


def by_columns(folder: Path, run: int) -> None:
    columns = [column for part in SIGNALS.values() for column in part]
    lines = ["t," + ",".join(columns)]
    for t, name, values in messages(run):
        cells = dict(zip(SIGNALS[name], values, strict=True))
        lines.append(f"{t:.6f}," + ",".join(f"{cells[c]:.6f}" if c in cells else "" for c in columns))
    (folder / f"run_{run}.csv").write_text("\n".join(lines))


def by_signal_names(folder: Path, run: int) -> None:
    lines = ["time;signal;value"]
    for t, name, values in messages(run):
        lines += [f"{t:.6f};{c};{v:.6f}" for c, v in zip(SIGNALS[name], values, strict=True)]
    (folder / f"run_{run}.csv").write_text("\n".join(lines))


def by_message_ids(folder: Path, run: int) -> None:
    lines = ["Label,Time,ID,Signal1,Signal2"]
    for t, name, values in messages(run):
        lines.append(f"0,{1e3 * t:.3f},{name},{values[0]:.6f},{f'{values[1]:.6f}' if len(values) > 1 else ''}")
    (folder / f"run_{run}.csv").write_text("\n".join(lines))


def by_files(folder: Path, run: int) -> None:
    (folder / f"run_{run}").mkdir()
    for name in SIGNALS:
        rows = [",".join(map(str, (t, *values))) for t, own, values in messages(run) if own == name]
        (folder / f"run_{run}" / f"{name}.csv").write_text("\n".join((f"t,{','.join(SIGNALS[name])}", *rows)))


@pytest.mark.parametrize(
    "write",
    [by_columns, *(pytest.param(form, marks=pytest.mark.long) for form in (by_signal_names, by_message_ids, by_files))],
)
def test_a_draft_of_messages_gives_rows_of_all_signals(tmp_path, write: Callable[[Path, int], None]):
    for run in range(2):
        write(tmp_path, run)
    result = draft([tmp_path])
    assert result.alignment is not None
    (tmp_path / "log.yaml").write_text(result.text())
    config = load_measured(tmp_path / "log.yaml")
    data = read_measured(config, tmp_path)
    assert len(data.episodes) == 2
    assert config.rate == pytest.approx(1.0 / 0.015, rel=0.4)  # between the two that are fast
    assert config.interpolate == pytest.approx(0.3, rel=0.1)  # three steps of the slowest
    order = [column for part in SIGNALS.values() for column in part]
    labels = {"ABS.Signal1": 0, "ABS.Signal2": 1, "ESP.Signal1": 2, "4F1.Signal1": 3}
    columns = [labels.get(c, order.index(c) if c in order else -1) for s in data.layout.signals for c in s.elements]
    assert sorted(columns) == [0, 1, 2, 3]
    for run, episode in enumerate(data.episodes):
        rows = np.concatenate([episode.values[name] for name in data.layout.names], axis=1)
        assert len(rows) == pytest.approx(LENGTH * config.rate, abs=3)
        t = messages(run)[0][0] + np.arange(len(rows)) / config.rate
        known = np.isfinite(rows)
        assert known.mean() > 0.98
        expected = np.stack([value(column, t) for column in columns], axis=1)
        assert np.abs(rows - expected)[known].max() < 0.02  # of straight lines between samples 0.1 s apart


def test_a_pause_is_not_bridged():
    t = np.arange(0.0, 10.0, 0.01)
    slow = np.where(np.arange(len(t)) % 20 == 0, t, np.nan)
    fast = np.where((t > 4.0) & (t < 5.0), np.nan, t)
    rows = aligned(t, np.stack([slow, fast], axis=1), 50.0, 0.5)
    grid = np.arange(len(rows)) / 50.0
    assert np.isfinite(rows[:-10, 0]).all()  # every 0.2 s
    np.testing.assert_allclose(rows[np.isfinite(rows[:, 0]), 0], grid[np.isfinite(rows[:, 0])], atol=1e-9)
    assert np.isnan(rows[(grid > 4.0) & (grid < 5.0), 1]).all()
    assert np.isfinite(rows[(grid <= 4.0) | ((grid >= 5.01) & (grid < 9.9)), 1]).all()
    short = np.where((t > 4.0) & (t < 4.3), np.nan, t)  # within 0.5 s, but thirty of its own steps
    assert np.isnan(aligned(t, short[:, None], 50.0, 0.5)[(grid > 4.01) & (grid < 4.29), 0]).all()


def test_rows_out_of_order_are_sorted_and_a_clock_that_begins_anew_is_another_episode(tmp_path):
    random = np.random.default_rng(0)
    rows = [
        row for part in range(2) for row in sorted(messages(part), key=lambda row: row[0] + random.uniform(0, 0.02))
    ]
    lines = ["time,signal,value"]
    for t, name, values in rows:
        lines += [f"{t:.6f},{c},{v:.6f}" for c, v in zip(SIGNALS[name], values, strict=True)]
    (tmp_path / "run.csv").write_text("\n".join(lines))
    text = "recording: bus\nepisodes: run.csv\nnames: signal\ntime: {columns: time}\nrate: 50\ninterpolate: 0.3\n"
    (tmp_path / "bus.yaml").write_text(text + "signals: {left: {unit: m/s, columns: left_mps}}\n")
    data = read_measured(load_measured(tmp_path / "bus.yaml"), tmp_path)
    assert [len(episode.values["left"]) for episode in data.episodes] == pytest.approx([1000, 1000], abs=5)
    for part, episode in enumerate(data.episodes):
        left = episode.values["left"][:, 0]
        t = min(t for t, name, _ in messages(part) if name == "ABS") + np.arange(len(left)) / 50.0
        assert np.abs(left - value(0, t)).max() < 0.03


def test_a_pause_between_bursts_of_messages_does_not_end_an_episode(tmp_path):
    stamps = [0.1 * burst + 0.0005 * k for burst in range(100) for k in range(5)]
    lines = [f"{t:.4f},{'abcde'[k % 5]},{value(0, np.array(t)):.5f}" for k, t in enumerate(stamps)]
    (tmp_path / "run.csv").write_text("\n".join(("t,id,value", *lines)))
    text = "recording: bus\nepisodes: run.csv\nnames: id\ntime: {columns: t}\nrate: 10\ninterpolate: 0.5\n"
    (tmp_path / "bus.yaml").write_text(text + "signals: {all: {unit: m, columns: [a, b, c, d, e]}}\n")
    data = read_measured(load_measured(tmp_path / "bus.yaml"), tmp_path)
    assert [len(episode.values["all"]) for episode in data.episodes] == [100]


def test_the_time_of_a_row_is_right_after_a_pause_that_is_not_bridged(tmp_path):
    t = np.arange(0.0, 20.0, 0.05)
    t = t[(t < 5.0) | (t > 8.0)]
    lines = [f"{x:.2f},{'abc'[k % 3]},{x:.4f}" for k, x in enumerate(t)]
    (tmp_path / "run.csv").write_text("\n".join(("t,id,value", *lines)))
    text = "recording: bus\nepisodes: run.csv\nnames: id\ntime: {columns: t, gap: 5}\nrate: 10\ninterpolate: 0.5\n"
    (tmp_path / "bus.yaml").write_text(text + "signals: {all: {unit: s, columns: [a, b, c]}}\n")
    (episode,) = read_measured(load_measured(tmp_path / "bus.yaml"), tmp_path).episodes
    values = episode.values["all"]
    assert np.isnan(values[55:75]).all()
    number, known = np.arange(len(values)) / 10.0, np.isfinite(values)
    np.testing.assert_allclose(values[known], np.repeat(number[:, None], 3, axis=1)[known], atol=1e-6)


def test_sensors_of_different_runs_do_not_make_a_log_of_messages(tmp_path):
    random = np.random.default_rng(0)
    for run in range(2):
        rows = [f"{0.02 * k:.2f},{random.normal()},{','.join((['x', ''], ['', 'x'])[run])}" for k in range(200)]
        rows = [row.replace("x", f"{random.normal():.4f}") for row in rows]
        (tmp_path / f"run_{run}.csv").write_text("\n".join(("t,joint,left,right", *rows)))
    assert draft([tmp_path]).alignment is None


def test_a_folder_with_a_file_that_has_only_the_time_is_drafted(tmp_path):
    for run in range(2):
        (tmp_path / f"run_{run}").mkdir()
        by_time = "\n".join(f"{0.01 * k:.2f}" for k in range(300))
        (tmp_path / f"run_{run}" / "time.csv").write_text("t\n" + by_time)
        for name, step in (("arm", 0.02), ("hand", 0.05)):
            rows = [f"{step * k:.2f},{np.sin(k)}" for k in range(int(3.0 / step))]
            (tmp_path / f"run_{run}" / f"{name}.csv").write_text("\n".join((f"t,{name}", *rows)))
    result = draft([tmp_path])
    assert result.alignment is not None
    (tmp_path / "log.yaml").write_text(result.text())
    assert len(read_measured(load_measured(tmp_path / "log.yaml"), tmp_path).episodes) == 2


@pytest.mark.parametrize(
    ("head", "of"),
    [
        ("tool", lambda row: "hammer" if row % 100 < 50 else "brush"),  # stays for many rows
        ("lamp", lambda row: ("red", "green")[row % 2]),
        ("signal", lambda row: row * 7 % 5),  # a number, such as the strength of a radio signal
    ],
)
def test_a_remark_does_not_make_a_log_of_messages(tmp_path, head, of):
    lines = [f"t,{head},q0,q1"]
    for row in range(300):
        lines.append(f"{0.02 * row:.2f},{of(row)},{np.sin(0.1 * row):.4f},{np.cos(0.1 * row):.4f}")
    (tmp_path / "run.csv").write_text("\n".join(lines))
    result = draft([tmp_path / "run.csv"])
    assert result.alignment is None
    assert result.unused == ({} if head == "signal" else {head: "holds text"})


@pytest.mark.parametrize(
    ("keys", "sentence"),
    [
        ("interpolate: 0.5\n", "interpolate needs time and rate"),
        ("names: id\n", "names needs interpolate"),
        ("time: {columns: t}\nrate: 5\ninterpolate: 1\nepisode: e\n", "episode and interpolate cannot"),
    ],
)
def test_keys_that_do_not_fit_together_are_one_sentence(tmp_path, keys, sentence):
    (tmp_path / "x.yaml").write_text(
        f"recording: x\nepisodes: '*.csv'\nsignals: {{a: {{unit: m, columns: a}}}}\n{keys}"
    )
    with pytest.raises(ConfigError, match=sentence):
        load_measured(tmp_path / "x.yaml")


def test_an_unknown_message_is_one_sentence(tmp_path):
    by_signal_names(tmp_path, 0)
    text = "recording: bus\nepisodes: run_0.csv\nseparator: ';'\nnames: signal\ntime: {columns: time}\nrate: 50\n"
    (tmp_path / "bus.yaml").write_text(text + "interpolate: 1\nsignals: {left: {unit: m/s, columns: Left_mps}}\n")
    with pytest.raises(DatasetError, match=r"has no column 'Left_mps'.*Is 'left_mps' meant"):
        read_measured(load_measured(tmp_path / "bus.yaml"), tmp_path)


def test_a_log_of_frames_is_refused_with_what_to_do(tmp_path):
    (tmp_path / "drive.blf").write_bytes(b"LOGG\x90\x00")
    with pytest.raises(DatasetError, match=r"decode them with the DBC file of the bus"):
        draft([tmp_path / "drive.blf"])


def test_names_of_messages_are_of_text_files(tmp_path):
    np.savez(tmp_path / "run.npz", t=np.arange(9.0), value=np.arange(9.0))
    text = "recording: bus\nepisodes: run.npz\nnames: signal\ntime: {columns: t}\nrate: 1\ninterpolate: 3\n"
    (tmp_path / "bus.yaml").write_text(text + "signals: {left: {unit: m/s, columns: left}}\n")
    with pytest.raises(DatasetError, match="names is for text files; save the table as CSV"):
        read_measured(load_measured(tmp_path / "bus.yaml"), tmp_path)


def test_a_bus_with_one_message_of_numbers_is_drafted_and_read(tmp_path):
    lines = [f"{0.01 * k:.2f},{'ab'[k % 2]},{np.sin(k) if k % 2 else 'ON'}" for k in range(400)]
    (tmp_path / "run.csv").write_text("\n".join(("time,signal,value", *lines)))
    (tmp_path / "run.yaml").write_text(draft([tmp_path / "run.csv"]).text())
    assert len(read_measured(load_measured(tmp_path / "run.yaml"), tmp_path)) > 100
