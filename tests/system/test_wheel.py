"""The wheel alone, installed in a fresh environment and used in an empty folder, is the whole package."""

import os
import shutil
import signal
import subprocess
import sys
import sysconfig
import tomllib
import zipfile
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml
from arm_stack import RATES, eventually

from services.extras import EXTRAS

ROOT = Path(__file__).parents[2]
SMALL = {
    "collect": {"motion": "simulators.robots.musashi_arm:random_motion", "rate": 10, "samples": 400},
    "network": {"hidden": [30], "latent": 15},
    "structure": {"threshold_out": 0.9, "threshold_in": 0.9, "epochs": 5, "splits": 1},
    "training": {"epochs": 20},
}
"""A model that is made in seconds: the wheel is tested, not the arm."""


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder, source = tmp_path_factory.mktemp("wheel"), tmp_path_factory.mktemp("source") / "gemuco"
    for name in ("gemuco", "hal", "robots", "services", "simulators", "studies"):  # a build leaves files in its folder
        shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    subprocess.run(
        [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-index", "--no-build-isolation",
         "--wheel-dir", folder, source],
        check=True, timeout=100,
    )  # fmt: skip
    (built,) = folder.glob("gemuco-*.whl")
    return built


@pytest.fixture(scope="module")
def fresh(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Python of an environment that has the wheel, and from this one only the other packages."""
    folder = tmp_path_factory.mktemp("fresh")
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", folder], check=True, timeout=60)
    python = folder / "bin" / "python"
    subprocess.run(
        [sys.executable, "-m", "pip", "--python", python, "install", "--quiet", "--no-deps", "--no-index", wheel],
        check=True, timeout=60, env=environment(),
    )  # fmt: skip
    (site,) = folder.glob("lib/*/site-packages")
    (site / "others.pth").write_text(sysconfig.get_path("purelib"))  # its own .pth files are not read this way
    return python


def environment() -> dict[str, str]:
    return {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}


def gemuco(fresh: Path, folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    command = [fresh.with_name("gemuco"), *words]
    return subprocess.run(
        command, capture_output=True, text=True, timeout=100, check=False, cwd=folder, env=environment()
    )


def test_every_optional_package_has_its_extra() -> None:
    imported_as = {"foxglove_sdk": "foxglove", "rerun_sdk": "rerun", "pyserial": "serial"}
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    names = {
        need.partition(">")[0].replace("-", "_"): extra for extra in set(EXTRAS.values()) for need in extras[extra]
    }
    assert {imported_as.get(name, name): extra for name, extra in names.items()} == EXTRAS
    in_all = extras["all"][0].partition("[")[2].rstrip("]").split(",")
    assert set(in_all) == set(EXTRAS.values()) - {"rerun"}, "rerun is half a gigabyte"


@pytest.mark.long
def test_robots_and_their_files_are_in_the_wheel(wheel: Path) -> None:
    names = set(zipfile.ZipFile(wheel).namelist())
    files = [
        path.relative_to(ROOT) for kind in ("*.yaml", "eds/*.eds", "dbc/*.dbc") for path in (ROOT / "robots").glob(kind)
    ]
    assert len(files) >= 9
    assert {str(path) for path in files if ".calibration" not in path.name} <= names
    assert {f"{package}/py.typed" for package in ("gemuco", "hal", "services", "simulators")} <= names
    assert any(name.endswith("musashi_arm.urdf") for name in names)
    assert not any(name.startswith(("tests/", "docs/")) for name in names)


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_the_wheel_collects_trains_and_plays_in_an_empty_folder(fresh: Path, tmp_path: Path) -> None:
    completed = gemuco(fresh, tmp_path, "simulate", "no_such_robot")
    assert "Known robots: kxr_humanoid, musashi_arm, pr2_duster" in completed.stderr
    where = subprocess.run(
        [fresh, "-c", "import services.model.artifacts as a; print(a.SHIPPED)"],
        capture_output=True, text=True, check=True, cwd=tmp_path, env=environment(),
    ).stdout.strip()  # fmt: skip
    assert where.startswith(str(fresh.parents[1]))
    body = yaml.safe_load((Path(where) / "musashi_arm.yaml").read_text())
    body["robot"], body["rates"], body["collect"] = f"wheel_{os.getpid()}", RATES, SMALL["collect"]
    body["model"] |= {key: SMALL[key] for key in ("network", "structure", "training")}
    for name, bus in body["buses"].items():
        bus["channel"] = f"{body['robot']}_{name}"
    for kind in body["kinds"].values():
        kind["settings"]["eds"] = str(Path(where) / kind["settings"]["eds"])
    (tmp_path / "arm.yaml").write_text(yaml.safe_dump(body, sort_keys=False))
    with (log := tmp_path / "demo.log").open("w") as sink:
        demo = subprocess.Popen(
            [fresh.with_name("gemuco"), "demo", "arm.yaml"], cwd=tmp_path, stdout=sink, stderr=sink, env=environment()
        )
    try:
        eventually(lambda: "targets, distance from the target" in log.read_text() or demo.poll() is not None, 240.0)
        assert demo.poll() is None, log.read_text()
        demo.send_signal(signal.SIGINT)
        assert demo.wait(30.0) != 0
    finally:
        demo.kill()
        demo.wait()


@pytest.fixture
def light(fresh: Path, tmp_path: Path) -> Iterator[Path]:
    """Folder in which the packages of the extras, and torch, cannot be imported."""
    hook = "import sys\n" + "\n".join(f"sys.modules[{name!r}] = None" for name in (*EXTRAS, "torch"))
    (tmp_path / "sitecustomize.py").write_text(hook)
    yield tmp_path


@pytest.mark.slow
def test_a_missing_extra_is_named_in_one_sentence(fresh: Path, light: Path) -> None:
    for words, extra in (
        (("collect", "musashi_arm", "--samples", "10"), "sim"),
        (("demo",), "train,sim"),
        (("view", "musashi_arm"), "view"),
    ):
        completed = subprocess.run(
            [fresh.with_name("gemuco"), *words], capture_output=True, text=True, timeout=60, check=False, cwd=light,
            env=environment() | {"PYTHONPATH": str(light)},
        )  # fmt: skip
        assert f"pip install 'gemuco[{extra}]'" in completed.stderr, completed.stderr
        assert completed.returncode == 1
        assert len(completed.stderr.strip().splitlines()) == 1


@pytest.mark.slow
def test_a_model_is_trained_without_an_extra(fresh: Path, light: Path) -> None:
    code = (
        "import gemuco, numpy; x = numpy.random.default_rng(0).normal(size=(200, 1)); data = {'a': x, 'b': 2.0 * x}; "
        "units = dict.fromkeys(data, 'rad'); settings = gemuco.TrainConfig(epochs=2); "
        "print(gemuco.fit(data, settings, [['a']], x_out=['b'], units=units)[0].x_out)"
    )
    completed = subprocess.run(
        [fresh, "-c", code], capture_output=True, text=True, timeout=240, check=False, cwd=light,
        env=environment() | {"PYTHONPATH": str(light)},
    )  # fmt: skip
    assert completed.stdout.strip() == "('b',)", completed.stderr
