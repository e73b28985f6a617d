"""Files as recorders and people leave them: what is taken, what is left out with a note, what is refused."""

import math
import re

import numpy as np
import pytest

from gemuco.errors import DatasetError
from hal.errors import ConfigError
from services.measured.description import load_measured
from services.measured.reading import read_measured

HEAD = "recording: rig\nepisodes: '*.csv'\n"
SIGNALS = "signals:\n  q: {unit: rad, columns: 'q{0..1}'}\n  f: {unit: N, columns: f}\n"
TIME = "time: {columns: t, gap: 1}\n"
LINES = ["t,q0,q1,f", *(f"{0.01 * k:.2f},{math.sin(k):.4f},{math.cos(k):.4f},{k % 7}.5" for k in range(300))]
CSV = "\n".join(LINES) + "\n"


class Rig:
    """A folder with one file and a description, and the notes of reading them."""

    def __init__(self, folder):
        self.folder, self.notes = folder, []

    def read(self, content, description=HEAD + SIGNALS, name="a.csv"):
        (self.folder / name).write_bytes(content.encode() if isinstance(content, str) else content)
        (self.folder / "rig.yaml").write_text(description)
        self.notes.clear()
        return read_measured(load_measured(self.folder / "rig.yaml"), self.folder, self.notes.append)


@pytest.fixture
def rig(tmp_path):
    return Rig(tmp_path)


def at(place, *lines):
    """Return the file with lines inserted before a line."""
    return "\n".join([*LINES[:place], *lines, *LINES[place:]]) + "\n"


@pytest.mark.parametrize(
    ("content", "more"),
    [
        (CSV.encode("utf-8-sig"), ""),
        (CSV.encode("utf-16"), ""),
        (CSV.replace("\n", "\r\n"), ""),
        (CSV.replace("\n", "\r"), ""),
        (CSV.replace("\n", ",\n"), ""),
        (LINES[0] + "\n" + "\n".join(line + "," for line in LINES[1:]), ""),
        (CSV.replace("t,q0,q1,f", 't, q0 ,"q1",f'), ""),
        ("# made by hand\n" + CSV, ""),
        ("# " + CSV, ""),
        (CSV.replace(",", ";"), "separator: ';'\n"),
        (CSV.replace(",", ";").replace(".", ","), "separator: ';'\ndecimal: ','\n"),
        (CSV.replace(",", "\t"), "separator: tab\n"),
        (CSV.replace(",", "   "), "separator: space\n"),
        (CSV.replace("t,q0,q1,f\n", ""), "header: false\n"),
        (CSV.replace("q1", "q0"), ""),
    ],
)
def test_the_same_rows_in_another_form(rig, content, more):
    by_number = "signals:\n  q: {unit: rad, columns: [1, 2]}\n  f: {unit: N, columns: 3}\n"
    numbered = "header" in more or "q0,q0" in str(content)
    data = rig.read(content, HEAD + (by_number if numbered else SIGNALS) + more)
    expected = np.array([[float(cell) for cell in line.split(",")[1:]] for line in LINES[1:]])
    np.testing.assert_array_equal(data.rows(), expected)
    assert rig.notes == []


@pytest.mark.parametrize(
    ("content", "rows", "note"),
    [
        (
            CSV + "3.00,1",
            300,
            r"a\.csv': the last line was cut off and is left out \(line 302: has 2 columns; the header has 4",
        ),
        (CSV + "3.00,1,2,3e", 300, r"last line was cut off .*line 302: column 'f': '3e' is not a number"),
        (CSV.encode() + b"3.0,1" + 500 * b"\0", 300, "last line was cut off"),
        (
            at(50, "1,2"),
            300,
            r"1 of 301 rows is broken and left out \(first in line 51: has 2 columns; the header has 4",
        ),
        (at(50, "0.5,1,2,err", "0.5,1,oops,2"), 300, r"2 of 302 rows are broken .*line 51: column 'f': 'err' is not"),
        (at(50, '"0.5,1,2,3'), 300, "1 of 301 rows is broken"),
        (at(1, "s,rad,rad,N"), 300, "1 of 301 rows is broken"),
    ],
)
def test_a_few_broken_rows_are_left_out_with_a_note(rig, content, rows, note):
    assert len(rig.read(content)) == rows
    assert len(rig.notes) == 1
    assert re.search(note, rig.notes[0])


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        (
            at(50, *["1,2"] * 4),
            r"line 51 has 2 columns; the header has 4\. .* 4 of 304 rows are broken; at most 1% may be",
        ),
        (
            CSV.replace(",1.5\n", ",on\n"),
            r"line 3, column 'f': 'on' is not a number\. An empty cell means .* 43 of 300",
        ),
        (
            CSV.replace(",1.5\n", ',"1,5"\n'),
            r"'1,5' is not a number\. If the comma is before the decimals, write decimal",
        ),
        (CSV.replace(",", ";"), r"no column 'q0'\. Columns: t;q0;q1;f\. Is the separator ';'\?"),
        (CSV.replace("t,q0,q1,f\n", ""), r"The first line holds numbers; if it is no header, write header: false"),
        ("made by hand\n" + CSV, r"the first line names 1 column, but the rows have 4\. Is it the header\?"),
        (CSV.replace("f\n", "F\n", 1), r"no column 'f'\. Columns: t, q0, q1, F\. Is 'F' meant\?"),
        (CSV.replace("q1", "q0"), r"has several columns 'q0'; give the number of one: 1, 2"),
        (CSV.replace("t,", "f,", 1), r"has several columns 'f'; give the number of one: 0, 3\."),
        (bytes(range(256)) * 9, "is not a text file of separated values"),
    ],
)
def test_what_is_refused_names_file_line_and_column(rig, content, sentence):
    with pytest.raises(DatasetError, match=rf"'.*a\.csv'.*{sentence}"):
        rig.read(content)


def test_cells_that_were_not_measured(rig):
    data = rig.read(at(50, "0.49,,NaN,inf", "0.49,N/A,--,true", "0.49,,,"))
    assert len(data) == 301  # rows without any measured value are left out
    np.testing.assert_array_equal(data.rows()[49], [np.nan, np.nan, 1.0])
    assert rig.notes == []


def test_a_broken_row_of_one_file_does_not_shift_those_of_another(tmp_path):
    folder = tmp_path / "run_1"
    folder.mkdir()
    (folder / "q.csv").write_text("q\n" + "\n".join(map(str, range(100))) + "\n1\n".replace("1", "bad") + "101\n")
    (folder / "f.csv").write_text("f\n" + "\n".join(map(str, range(102))))
    (tmp_path / "rig.yaml").write_text(
        "recording: rig\nepisodes: run_*\nsignals: {q: {unit: rad, file: q.csv, columns: q}, "
        "f: {unit: N, file: f.csv, columns: f}}\n"
    )
    notes = []
    rows = read_measured(load_measured(tmp_path / "rig.yaml"), tmp_path, notes.append).rows()
    np.testing.assert_array_equal(rows[-2:], [[np.nan, 100.0], [101.0, 101.0]])
    assert "line 102: column 'q': 'bad' is not a number" in notes[0]


@pytest.mark.parametrize(
    ("more", "rows", "note"),
    [
        ("every: 10\n", 30, "Thinned out: 30 of 300 rows are used."),
        (TIME + "rate: 10\n", 30, "Thinned out: 30 of 300 rows are used."),
        (TIME + "rate: 25\n", 75, "Thinned out: 75 of 300 rows are used."),
        (TIME + "rate: 1000\n", 300, "rate: 1000 Hz is not below the rate of the data; every row is used."),
        ("time: t\nrate: 10\n", 30, "Thinned out: 30 of 300 rows are used."),
    ],
)
def test_rows_are_thinned_out(rig, more, rows, note):
    data = rig.read(CSV, HEAD + SIGNALS + more)
    assert len(data) == rows
    assert rig.notes == [note]
    steps = 300 // rows
    np.testing.assert_allclose(data.rows()[:3, 0], [round(math.sin(steps * k), 4) for k in range(3)])


def test_every_episode_is_thinned_out_by_itself(rig):
    data = rig.read(at(151, *["9.0,1,1,1"] * 1), HEAD + SIGNALS + TIME + "rate: 10\n")
    assert [len(episode.values["f"]) for episode in data.episodes] == [15, 1, 15]


@pytest.mark.parametrize(
    ("stamp", "more"),
    [
        (lambda k: f"{100 * k}", ", written_in: ms"),
        (lambda k: f"{1_700_000_000_000_000_000 + 100_000_000 * k}", ", written_in: ns"),
        (
            lambda k: (
                f"2024-05-01 23:59:{50 + k // 10:02d}.{k % 10}"
                if k < 100
                else f"2024-05-02T00:00:{k // 10 - 10:02d}.{k % 10}Z"
            ),
            "",
        ),
    ],
)
def test_stamps_in_other_units(rig, stamp, more):
    rows = "\n".join(f"{stamp(k)},1,2,{k}" for k in [*range(150), *range(170, 200)])
    data = rig.read(f"t,q0,q1,f\n{rows}\n", HEAD + SIGNALS + f"time: {{columns: t, gap: 1.5{more}}}\nrate: 2\n")
    assert [len(episode.values["f"]) for episode in data.episodes] == [30, 6]


def test_repeated_stamps_stay_and_rows_without_a_stamp_do_not(rig):
    data = rig.read(at(50, "0.48,1,1,1", ",1,1,1"), HEAD + SIGNALS + TIME)
    assert (len(data), len(data.episodes)) == (301, 1)
    assert "1 row without a stamp left out" in rig.notes[0]


def test_a_column_can_number_the_episodes(rig):
    data = rig.read(
        "t,q0,q1,f,trial\n" + "\n".join(f"0,1,2,{k},{k // 4}" for k in range(12)), HEAD + SIGNALS + "episode: trial\n"
    )
    assert [len(episode.values["f"]) for episode in data.episodes] == [4, 4, 4]


def test_conditions_by_folder_and_by_number(tmp_path):
    for load in ("light", "heavy"):
        (tmp_path / load).mkdir()
        (tmp_path / load / "run.csv").write_text(CSV)
    text = HEAD.replace("*.csv", "*/*.csv") + SIGNALS + "conditions: {'light/*': 0.5, 'heavy/*': 2, '*x*': none}\n"
    (tmp_path / "rig.yaml").write_text(text)
    notes = []
    data = read_measured(load_measured(tmp_path / "rig.yaml"), tmp_path, notes.append)
    assert {episode.condition for episode in data.episodes} == {"0.5", "2"}
    assert notes == ["conditions: '*x*' is of no episode, or an earlier pattern has them all."]
    (tmp_path / "rig.yaml").write_text(text.replace("'light/*': 0.5, ", ""))
    with pytest.raises(DatasetError, match=r"No condition is given for 'light/run\.csv'\. Patterns: heavy/\*"):
        read_measured(load_measured(tmp_path / "rig.yaml"), tmp_path)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        (HEAD + SIGNALS + "rate: 10\n", "rate needs the column of the time"),
        (HEAD + SIGNALS + TIME + "rate: 10\nevery: 3\n", "every and rate both leave rows out"),
        (HEAD + SIGNALS + "decimal: ','\n", "separator and decimal are both ','; is the separator ';'?"),
        (HEAD + SIGNALS.replace("columns: f", "columns: q1"), "column 'q1' is in signal 'q' and in 'f'"),
        (HEAD + SIGNALS.replace("{0..1}", "{1..0}"), "a range counts up, such as {0..5}"),
        (HEAD + SIGNALS.replace("unit: N", "unit: Nm"), "the unit 'Nm' is written 'N m'"),
        (HEAD + SIGNALS.replace("unit: rad", "unit: °"), "the unit '°' is written 'deg'"),
        (
            HEAD + SIGNALS + "time: {columns: t, written_in: years}\n",
            "'years' cannot be converted to 's'; to 's' can be",
        ),
        (HEAD + SIGNALS + SIGNALS, "in line 6: 'signals' is given twice"),
        (HEAD + "signals:\n\tq: 1\n", "in line 4: found character"),
    ],
)
def test_a_description_that_contradicts_itself_is_one_sentence(tmp_path, text, sentence):
    (tmp_path / "rig.yaml").write_text(text)
    with pytest.raises(ConfigError) as raised:
        load_measured(tmp_path / "rig.yaml")
    assert sentence in str(raised.value)


@pytest.mark.parametrize(
    ("pattern", "sentence"),
    [
        ("run*.csv", r"matches 'run\*\.csv'\. .* It holds a\.csv, rig\.yaml; name another with --data"),
        ("/tmp/*.csv", "must be a pattern below the folder of the data"),
        ("", "must be a pattern below the folder of the data"),
    ],
)
def test_a_pattern_that_matches_nothing(rig, pattern, sentence):
    with pytest.raises(DatasetError, match=sentence):
        rig.read(CSV, HEAD.replace("*.csv", pattern) + SIGNALS)


def test_files_and_folders_that_were_mixed_up(rig):
    with pytest.raises(DatasetError, match=r"a\.csv' is a file, but `file: x\.csv` is read from a folder"):
        rig.read(CSV, HEAD + "signals: {q: {unit: rad, file: x.csv, columns: q0}}\n")
    with pytest.raises(DatasetError, match=r"a\.xlsx' cannot be read as a table\. Save the sheet as CSV"):
        rig.read(b"PK", HEAD.replace("csv", "xlsx") + SIGNALS, "a.xlsx")
