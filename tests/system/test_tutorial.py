"""The code of docs/tutorial.md, run as it stands; only the training is shorter."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
DATA = Path(os.environ.get("GEMUCO_DATA", ROOT.parent / "shared" / "data"))
TEXT = (ROOT / "docs" / "tutorial.md").read_text()


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", TEXT, re.DOTALL)


def shortened(description: str) -> str:
    text = re.sub(r"splits: \d+", "splits: 1", description)
    text = re.sub(r"epochs: \d+", "epochs: 15", text)
    return re.sub(r"(threshold_\w+): [\d.]+", r"\1: 0.9", text)


@pytest.mark.skipif(not DATA.is_dir(), reason=f"no recordings in {DATA}; name their folder in GEMUCO_DATA")
def test_the_tutorial_runs(tmp_path):
    (tmp_path / "examples").mkdir()
    description = (ROOT / "examples" / "joint_capsule.yaml").read_text()
    (tmp_path / "examples" / "joint_capsule.yaml").write_text(shortened(description))
    # The command line of this very interpreter, under the name that the text uses.
    command = f'gemuco() {{ "{sys.executable}" -m services.cli "$@"; }}\n' + "".join(blocks("sh"))
    place = {**os.environ, "GEMUCO_DATA": str(DATA.resolve()), "PYTHONPATH": str(ROOT)}
    trained = subprocess.run(
        ["bash", "-ec", command], cwd=tmp_path, env=place, capture_output=True, text=True, timeout=100, check=False
    )
    assert trained.returncode == 0, trained.stderr
    assert "L_i" in trained.stdout
    assert (tmp_path / "runs" / "joint_capsule" / "model" / "structure.png").exists()
    told = subprocess.run(
        [sys.executable, "-c", "".join(blocks("python"))],
        cwd=tmp_path,
        env=place,
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert told.returncode == 0, told.stderr
    assert re.search(r"3 boards .* mask \[", told.stdout)


def test_the_description_in_the_text_is_that_of_the_example():
    example = (ROOT / "examples" / "joint_capsule.yaml").read_text()
    for line in blocks("yaml")[0].splitlines():
        assert line.split("#")[0].strip() in example
