"""Drawing and judging of arms from descriptions that were not chosen here."""

import subprocess
from pathlib import Path

import pytest

from studies.stack import foreign_arms
from studies.stack.foreign_arms import Played, drawn, play, table

SENTENCE = "arm.yaml: 6 joints from base to tip, reach 0.90 m, largest torque 40 N m.\n"
STORY = "true error of the tip meanwhile: mean 17.2 mm (1.6% of the reach of 1.07 m),\nworst 50.1 mm\n"
VERDICTS = "joint_position.elbow is distrusted: noise since 9:00.\nx and y are distrusted: offset since 9:01.\nReady.\n"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name in ("a/urdf/one.urdf", "a/urdf/two.urdf", "b/robots/three.urdf", "c/urdf/four.urdf", "c/readme.txt"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("<robot/>")
    return tmp_path


def test_one_file_of_each_description_is_drawn_by_the_seed(folder: Path) -> None:
    for seed in range(5):
        arms = drawn(folder, 3, seed)
        assert {arm.relative_to(folder).parts[0] for arm in arms} == {"a", "b", "c"}
        assert arms == drawn(folder, 3, seed)
    assert len({drawn(folder, 1, seed)[0] for seed in range(20)}) == 4
    assert len(drawn(folder, 9, 0)) == 3


@pytest.mark.parametrize(
    ("codes", "joints", "tip", "end"),
    [
        ((0, 0), 6, (17.2, 1.6), "green"),
        ((0, 1), 6, (17.2, 1.6), "NOT GREEN: worst 50.1 mm"),
        ((2,), 0, (), "refused: gemuco: it has no joint."),
    ],
)
def test_an_arm_is_green_refused_or_neither(
    folder: Path, monkeypatch: pytest.MonkeyPatch, codes: tuple[int, ...], joints: int, tip: tuple[float, ...], end: str
) -> None:
    left = list(codes)

    def run(work: Path, *words: str) -> subprocess.CompletedProcess[str]:
        code = left.pop(0)
        if words[0] == "init":
            return subprocess.CompletedProcess(words, code, SENTENCE, "gemuco: it has no joint.\n" if code else "")
        (work / "runs/demo").mkdir(parents=True)
        (work / "runs/demo/model.log").write_text(VERDICTS)
        return subprocess.CompletedProcess(words, code, STORY, "")

    monkeypatch.setattr(foreign_arms, "_run", run)
    kept = folder / "kept"
    played = play(folder / "b/robots/three.urdf", folder, kept)
    assert (kept / "three/demo.txt").exists() == end.startswith("NOT")
    assert (played.name, played.joints, played.tip, played.end) == ("b/robots/three.urdf", joints, tip, end)
    verdicts = ("joint_position.elbow distrusted: noise", "x and y distrusted: offset")
    assert played.accused == (verdicts if joints else ())
    assert not left


def test_the_table_counts_the_green_ones() -> None:
    tried = [Played("a", 6, 90.0, (3.0, 0.5), (), "green"), Played("b", 0, 1.0, (), (), "refused: no arm")]
    assert table(tried).title == "1 of 2 green"
