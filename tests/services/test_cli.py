import subprocess
import sys
from importlib import metadata
from pathlib import Path

import pytest
import typer

from services.verbs.verb import report_errors
from services.wire import keys
from services.wire.session import endpoint

ROOT = Path(__file__).parents[2]


def gemuco(*words: str, folder: Path | None = None) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "services.cli", *words]
    return subprocess.run(command, capture_output=True, text=True, timeout=60, cwd=folder or ROOT, check=False)


VERBS = (
    "simulate, hal, serve, vision, collect, train, query, top, record, demo, reproduce, estop, scan, doctor, "
    "calibrate joint, calibrate cell, can dump, view, endpoint"
)


@pytest.mark.parametrize("verb", VERBS.split(", "))
@pytest.mark.long
def test_every_verb_explains_itself(verb: str) -> None:
    completed = gemuco(*verb.split(), "--help")
    assert completed.returncode == 0
    assert "ROBOT" in completed.stdout


@pytest.mark.long
def test_the_endpoint_of_a_service_is_printed_for_programs() -> None:
    assert gemuco("endpoint", "some_arm", "hal").stdout == f"{endpoint('some_arm', 'hal')}\n"
    asked = gemuco("endpoint", "some_arm")
    whole = asked.stdout
    assert "no robot file 'some_arm' here, and no service of it runs. Is the name right?" in asked.stderr
    assert not gemuco("endpoint", "musashi_arm").stderr
    assert [line.split()[0] for line in whole.splitlines()] == list(keys.SERVICES)
    assert endpoint("some_arm", "model") in whole and "not running" in whole
    wrong = gemuco("endpoint", "some_arm", "arm")
    assert wrong.returncode == 1 and "There is no service 'arm'" in wrong.stderr


def test_the_extra_of_the_page_is_named() -> None:
    assert "gemuco[view]" in gemuco("view", "--help").stdout


@pytest.mark.slow
def test_a_wrong_robot_file_is_one_sentence_and_exit_code_2(tmp_path: Path) -> None:
    wrong = tmp_path / "wrong.yaml"
    wrong.write_text((ROOT / "robots" / "musashi_arm.yaml").read_text() + "\ncolour: blue\n")
    for words, sentence in (
        (("hal", str(wrong)), "unknown key 'colour'. Known keys there: robot, description"),
        (("hal", "no_such_robot"), "There is no robot 'no_such_robot'"),
        (("collect", str(tmp_path / "none.yaml")), "There is no robot file"),
        (("collect", "musashi_arm", "--variant", "golden"), "no variant 'golden'. Known variants: geometric, actual."),
    ):
        completed = gemuco(*words)
        assert completed.returncode == 2
        assert sentence in completed.stderr.replace("\n", " ")
        assert "Traceback" not in completed.stderr


@pytest.mark.slow
def test_a_simulator_that_is_none_is_one_sentence(tmp_path: Path) -> None:
    text = (ROOT / "robots" / "musashi_arm.yaml").read_text()
    line = next(line for line in text.splitlines() if line.startswith("simulator:"))
    for name, sentence in (
        ("os:system", "'os:system' is a part of Python and not a simulator of a robot."),
        ("numpy:zeros", "'numpy:zeros' is not a simulator: it has no variants, no conditions, no rig."),
    ):
        robot = tmp_path / "wrong.yaml"
        robot.write_text(text.replace(line, f"simulator: {name}"))
        completed = gemuco("collect", str(robot))
        assert completed.returncode == 2 and sentence in completed.stderr and "Traceback" not in completed.stderr


def _because(text: str) -> OSError:
    error = OSError("a library cannot be found")
    error.__context__ = OSError(text)
    return error


@pytest.mark.parametrize(
    "error",
    [MemoryError(), ImportError("libtorch_cpu.so: failed to map segment"), RuntimeError("std::bad_alloc"),
     RuntimeError("can't start new thread"), _because("failed to map segment from shared object")],
    ids=str,
)  # fmt: skip
def test_a_want_of_memory_is_one_sentence(error: Exception, capsys: pytest.CaptureFixture[str]) -> None:
    @report_errors
    def verb() -> None:
        raise error

    with pytest.raises(typer.Exit) as caught:
        verb()
    completed = capsys.readouterr().err
    assert (
        caught.value.exit_code == 1
        and completed.startswith("gemuco: there is not enough memory.")
        and completed.count("\n") == 1
    )


def test_another_error_of_these_kinds_is_not_hidden() -> None:
    @report_errors
    def verb() -> None:
        raise RuntimeError("a mistake in gemuco")

    with pytest.raises(RuntimeError, match="a mistake"):
        verb()


@pytest.mark.slow
def test_what_is_missing_is_said(tmp_path: Path) -> None:
    robot = str(ROOT / "robots" / "musashi_arm.yaml")
    for words, sentence in (
        (("serve", robot), "There is no model in 'runs/musashi_arm/model'. Make one with `gemuco collect`"),
        (("train", robot), "There is no data file 'runs/musashi_arm/data.npz'. Record one with `gemuco collect`."),
        (("query", "nobody_here", "estimate", "joint_position"), "Is `gemuco serve` running?"),
        (("query", "nobody_here", "engage"), "Is `gemuco serve` running?"),
    ):
        completed = gemuco(*words, folder=tmp_path)
        assert completed.returncode == 1
        assert sentence in completed.stderr.replace("\n", " ")
        assert "Traceback" not in completed.stderr


def test_the_service_does_not_import_torch() -> None:
    program = "import sys, services.model.gemuco_service; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", program], timeout=60, check=False, cwd=ROOT).returncode == 0


@pytest.mark.slow
def test_collect_and_train_make_a_model(tmp_path: Path) -> None:
    text = (ROOT / "robots" / "musashi_arm.yaml").read_text()
    robot = tmp_path / "small_arm.yaml"
    text = text.replace("robot: musashi_arm", "robot: small_arm")
    text += "\n  training: {epochs: 5}\n"
    text = text.replace("structure: {", "structure: {epochs: 5, ").replace("threshold_in: 0.15", "threshold_in: 0.9")
    robot.write_text(text)
    collected = gemuco("collect", str(robot), "--samples", "1000", folder=tmp_path)
    assert collected.returncode == 0, collected.stderr
    assert "times real time" in collected.stdout
    trained = gemuco("train", str(robot), folder=tmp_path)
    assert trained.returncode == 0, trained.stderr
    assert "L_i" in trained.stdout
    assert "joint_position" in trained.stdout
    assert "rad" in trained.stdout
    assert (tmp_path / "runs" / "small_arm" / "model" / "manifest.json").exists()


def test_the_version_is_told() -> None:
    completed = gemuco("--version")
    assert completed.returncode == 0
    assert completed.stdout.strip() == f"gemuco {metadata.version('gemuco')}"
