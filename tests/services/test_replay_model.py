"""A recording played to the model service brings about the estimates that the robot's own samples did."""

import threading
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
import pytest
from arm_model import arm, sample_of, small_model
from msgspec.structs import replace
from recorded_arm import BEGIN, SECOND
from small_arm import eventually

from gemuco.estimation import Completion, Recipe, fill
from gemuco.schema import BodySchema
from services.client import Client
from services.model.gemuco_service import GemucoService
from services.process.service import Service
from services.recording.replay import run_replay
from services.recording.schema import Catalogue
from services.recording.writer import Limits, RecordingWriter
from services.wire import keys, messages
from services.wire.messages import Estimates

COUNT = 12
PATIENT = 30.0
"""How long [s] a sample counts as fresh, so that none is missed on a busy machine."""
SILENT = "joint_position.elbow_pitch"
"""In every third sample."""


def silent(cycle: int) -> tuple[str, ...]:
    return () if cycle % 3 else (SILENT,)


@pytest.fixture
def model(robot: str) -> Iterator[GemucoService]:
    stop = threading.Event()
    with Service(robot, "model", (), dict) as service:
        signals = {name: one.model_copy(update={"stale_after": PATIENT}) for name, one in arm().signals.items()}
        config = arm().model_copy(update={"robot": robot, "signals": signals})
        made = GemucoService(config, small_model(), service)
        thread = threading.Thread(target=made.run, args=(stop,))
        thread.start()
        yield made
        stop.set()
        thread.join()


def recorded(path: Path) -> list[Path]:
    writer = RecordingWriter(path, "arm", Catalogue.of_robot(arm()), "", Limits())
    writer.open(BEGIN)
    for cycle in range(1, COUNT + 1):
        now = BEGIN + cycle * SECOND // 200
        sample = replace(sample_of(cycle, cycle, silent(cycle)), stamp_ns=now)
        writer.add(keys.sample("arm"), now + 200_000, messages.encode(sample))
    writer.finish(now + SECOND)
    return writer.paths


@pytest.mark.long
def test_the_estimates_are_those_of_the_recorded_samples(model: GemucoService, robot: str, tmp_path: Path) -> None:
    files, end = recorded(tmp_path / "arm.mcap"), threading.Event()
    replay = threading.Thread(target=run_replay, args=(files,), kwargs={"robot": robot, "speed": 0.0, "stop": end})
    replay.start()
    try:
        with Client(robot) as client:
            eventually(lambda: "hal" in client.alive() and _is_linked(model, robot))
            for cycle in range(1, COUNT + 1):
                client.ask("hal", "step", {"count": 1})
                eventually(lambda cycle=cycle: _of(client, cycle) is not None)
                seen, sample = _of(client, cycle), sample_of(cycle, cycle, silent(cycle))
                assert seen is not None
                completion = _completed(small_model(), sample.values, seen.method["joint_position"])
                for name, span in small_model().layout.slices.items():
                    np.testing.assert_allclose(seen.values[name], completion.value[span], atol=1e-9)
                    np.testing.assert_array_equal(seen.estimated[name], completion.recipe.estimated[span])
                assert seen.estimated["joint_position"][3] == (cycle % 3 == 0)
    finally:
        end.set()
        replay.join()


def _completed(schema: BodySchema, values: Mapping[str, np.ndarray], method: str) -> Completion:
    """Complete a sample by the way that was used: the one without a trial, or the one that a trial found better."""
    joined = schema.layout.join_one(values)
    joined.setflags(write=False)
    recipes = [Recipe.of(schema, np.isfinite(joined), is_tried) for is_tried in (False, True)]
    return fill(schema, joined, next(recipe for recipe in recipes if recipe.method["joint_position"] == method))


def _is_linked(model: GemucoService, robot: str) -> bool:
    return any(True for _ in model.service.session.liveliness().get(keys.alive(robot, "hal"), timeout=1.0))


def _of(client: Client, cycle: int) -> Estimates | None:
    found = client.estimate(timeout=0.2)
    return found if found is not None and found.cycle == cycle else None
