"""Arms from descriptions that were not chosen here: `gemuco init FILE`, then `gemuco demo` without an edit.

    python -m studies.stack.foreign_arms FOLDER --count 12 --seed 0 [--keep FOLDER]

FOLDER has URDF files anywhere below it, as an unpacked package of robot descriptions. One file is drawn from each of
`count` of its description folders. Every arm has a folder and a home of its own. An arm is refused if `gemuco init`
ends with one sentence, and green if its demo ends with 0: the tip is within 3 % of the reach while its camera is
covered, and every event was observed. With `--keep` all that an arm which is not green has written is kept.
"""

import argparse
import os
import random
import re
import shutil
import subprocess
import tempfile
import time
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console
from rich.table import Table

from services.process.supervisor import gemuco_command

LIMIT = 600.0
"""A demo is ended after this time [s]."""
JOINTS = re.compile(r": (\d+) joints from")
VERDICT = re.compile(r"^(?:.*: )?(.+?) (?:is|are) (distrusted: \w+)", re.MULTILINE)
TIP = re.compile(r"true error of the tip meanwhile: mean ([\d.]+) mm \(([\d.]+)% of the reach")


@dataclass(frozen=True, slots=True)
class Played:
    """An arm that was tried.

    Attributes:
        name: The file, below its folder.
        joints: Number of joints; 0 if it was refused.
        seconds: Duration of both commands [s].
        tip: Mean error of the tip while its camera is covered [mm], and in per cent of the reach; empty if unknown.
        accused: Verdicts against sensors; none of them lies, so all are wrong.
        end: `green`, `refused: ` with the sentence, or `NOT GREEN: ` with the last line.
    """

    name: str
    joints: int
    seconds: float
    tip: tuple[float, float] | tuple[()]
    accused: tuple[str, ...]
    end: str


def drawn(folder: Path, count: int, seed: int) -> list[Path]:
    """Return one URDF of each of `count` description folders, which are those that hold a folder of URDF files."""
    groups: dict[Path, list[Path]] = defaultdict(list)
    for path in sorted(folder.rglob("*.urdf")):
        groups[path.parent.parent].append(path)
    random_numbers = random.Random(seed)
    chosen = random_numbers.sample(sorted(groups), min(count, len(groups)))
    return [random_numbers.choice(groups[group]) for group in chosen]


def play(path: Path, folder: Path, keep: Path | None) -> Played:
    """Try one arm, in a home of its own that is copied into a folder if the arm is not green."""
    with tempfile.TemporaryDirectory(prefix="arm") as work:
        began = time.monotonic()
        made = _run(Path(work), "init", str(path.resolve()), "--out", "arm.yaml")
        name = str(path.relative_to(folder))
        if made.returncode:
            return Played(name, 0, time.monotonic() - began, (), (), f"refused: {made.stderr.strip()}")
        demo = _run(Path(work), "demo", "arm.yaml")
        seconds = time.monotonic() - began
        joints, text = JOINTS.search(made.stdout), " ".join(demo.stdout.split())
        tip = TIP.search(text)
        if demo.returncode and keep is not None:
            Path(work, "demo.txt").write_text(demo.stdout + demo.stderr)
            shutil.copytree(work, keep / path.stem, symlinks=True, dirs_exist_ok=True)
        log = Path(work) / "runs/demo/model.log"
        last = (demo.stderr.strip() or demo.stdout.strip()).splitlines()[-1:]
        return Played(
            name,
            int(joints[1]) if joints else 0,
            seconds,
            (float(tip[1]), float(tip[2])) if tip else (),
            tuple(map(" ".join, VERDICT.findall(log.read_text()))) if log.exists() else (),
            "green" if demo.returncode == 0 else f"NOT GREEN: {' '.join(last)}",
        )


def _run(work: Path, *words: str) -> subprocess.CompletedProcess[str]:
    command = gemuco_command(*words)
    home = os.environ | {"HOME": str(work)}
    try:
        return subprocess.run(command, cwd=work, env=home, capture_output=True, text=True, timeout=LIMIT, check=False)
    except subprocess.TimeoutExpired:
        return subprocess.CompletedProcess(command, 1, "", f"It did not end within {LIMIT:g} s.")


def table(tried: list[Played]) -> Table:
    """Return the arms as a table."""
    shown = Table(title=f"{sum(arm.end == 'green' for arm in tried)} of {len(tried)} green")
    for column in ("arm", "joints", "time [s]", "tip, mean error [mm]", "% of the reach", "wrongly distrusted", "end"):
        shown.add_column(column)
    for arm in tried:
        tip = [f"{value:g}" for value in arm.tip] or ["", ""]
        shown.add_row(arm.name, str(arm.joints or ""), f"{arm.seconds:.0f}", *tip, "; ".join(arm.accused), arm.end)
    return shown


def main() -> None:
    """Read the arguments, and try the arms."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--count", type=int, default=12)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--keep", type=Path, help="Folder for the files of arms that are not green.")
    options = parser.parse_args()
    console = Console(width=180)
    tried = []
    for path in drawn(options.folder, options.count, options.seed):
        tried.append(play(path, options.folder, options.keep))
        console.print(f"{tried[-1].name}: {tried[-1].end}, {tried[-1].seconds:.0f} s")
    console.print(table(tried))


if __name__ == "__main__":
    main()
