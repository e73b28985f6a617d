"""The tutorial can be followed: its blocks run one after the other in an empty folder."""

import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).parents[2]
TEXT = (ROOT / "docs" / "tutorial.md").read_text()
BLOCKS = re.findall(r"^```(sh|python)\n(.*?)^```$", TEXT, re.MULTILINE | re.DOTALL)


@pytest.mark.slow
@pytest.mark.timeout(400)
def test_blocks_run_in_an_empty_folder(tmp_path):
    program = f'gemuco() {{ "{sys.executable}" -m services.cli "$@"; }}\n'
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    outputs = []
    for kind, block in BLOCKS:
        words = [sys.executable, "-c", block] if kind == "python" else ["bash", "-e", "-c", program + block]
        done = subprocess.run(
            words, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=300, check=False
        )
        assert done.returncode == 0, f"{block}\n{done.stdout}{done.stderr}"
        outputs.append(done.stdout)
    draft = re.search(r"^```yaml\n(.*?)^```$", TEXT, re.MULTILINE | re.DOTALL)
    assert draft is not None
    assert draft[1] in (tmp_path / "arm.yaml").read_text()
    values = [[float(cell) for cell in line.split("[")[1].split("]")[0].split()] for line in outputs[4].splitlines()]
    measured, lost, few, tension, unloaded = values[:5]
    assert max(abs(a - b) for a, b in zip(measured, lost, strict=True)) < 0.03
    assert max(abs(a - b) for a, b in zip(measured, few, strict=True)) < 0.12
    without_load = 40.0 + 15.0 * np.sin(
        np.array(measured) @ [[2.0, 1.0, 0.0], [0.0, -1.0, 2.0]]
    )  # as the tutorial's arm
    assert np.abs(unloaded - without_load).max() < 1.0
    assert np.abs(np.array(unloaded) - tension).max() > 10.0  # the load is in p
    lines = [" ".join(line.split()) for line in outputs[7].splitlines()]
    assert [line.split("│")[4:6] for line in lines if "heavy_4" in line] == [
        [" cable.cable_2_mm ", " offset "],
        [" joint.joint_1_deg ", " frozen "],
    ]
    assert sorted(path.name for path in (tmp_path / "repaired").iterdir()) == ["000_heavy_4_csv.csv"]
