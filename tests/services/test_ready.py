"""Nothing that a service's ticks use is compiled in a tick: a sensor that fails must not cost a second."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

TICKS = """
import importlib, pkgutil
import numpy as np
import gemuco.compiled
from gemuco.normal import Normal
from gemuco.warm import warm
warm(is_service=True, has_p=False)
from arm_model import arm, fresh, small_model
from gemuco.adaption.config import UpdateConfig
from gemuco.warm import follow
from hal.clock import ManualClock
from services.model.anomaly_loop import AnomalyWatch
from services.model.estimation import Estimation, Freshness
from services.wire import messages
from services.wire.streams import Arrival

names = [one.name for one in pkgutil.iter_modules(gemuco.compiled.__path__, "gemuco.compiled.")]
modules = [importlib.import_module(name) for name in names]
kernels = {one for module in modules for one in vars(module).values() if hasattr(one, "signatures")}
before = {one: list(one.signatures) for one in kernels}
schema, clock, published = small_model(), ManualClock(), []
normal = Normal(np.zeros(schema.out_layout.size), np.eye(schema.out_layout.size), 1.0, 1e-3)
schema = schema.with_normal(normal)
assert not len(schema.bias)
newest = None
freshness = Freshness(arm(), lambda: newest, clock)
estimation = Estimation(freshness, lambda: schema, published.append, clock)
anomaly = AnomalyWatch(freshness, lambda: schema, 0.5, published.append, clock)
silences = ((), ("joint_position.elbow_pitch",), ("muscle_tension.biceps", "muscle_length.biceps"))
for number, silent in enumerate(silences):
    sample = messages.decode(messages.encode(fresh(number, 0.0, silent=silent).message), messages.Sample)
    newest = Arrival(sample, clock.monotonic())
    estimation.tick()
    anomaly.tick()
clock.advance(0.015)
estimation.tick()
follow(schema, schema.layout.split(np.zeros(schema.layout.size)), UpdateConfig(minimum=1))
assert any(one.estimated.flat.any() for one in published if hasattr(one, "estimated"))
new = {one.__name__: one.signatures[len(before[one]):] for one in kernels if len(one.signatures) > len(before[one])}
assert not new, new
"""


@pytest.mark.slow
def test_the_ticks_of_a_service_find_everything_compiled() -> None:
    here = Path(__file__).parent
    paths = os.pathsep.join([str(here), *sys.path])
    done = subprocess.run(
        [sys.executable, "-c", TICKS], capture_output=True, text=True, timeout=110, check=False, cwd=here.parents[1],
        env={**os.environ, "PYTHONPATH": paths},
    )  # fmt: skip
    assert not done.returncode, done.stderr
