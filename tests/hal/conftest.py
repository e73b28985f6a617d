import functools

import dbc_wire
import pytest
from hal_bench import Bench
from mit_bench import mit_bench

from hal.wire import bus


@pytest.fixture(autouse=True)
def buses_close_at_once(monkeypatch):
    """A bus is closed when its thread has waited for a frame once more; hundreds of tests close some."""
    monkeypatch.setattr(bus, "RECEIVE_TIMEOUT", 0.01)


@pytest.fixture
def bench():
    bench = Bench().open()
    bench.until(lambda: bench.states() == {"ready"}, "on a busy machine a node may need a second try")
    yield bench
    bench.close()


@pytest.fixture
def open_mit():
    """Opens benches with drives in MIT mode, and closes them."""
    benches = []

    def open_bench(config=None, nodes=None, world=None):
        benches.append(mit_bench(config, nodes, world).open())
        return benches[-1]

    yield open_bench
    for bench in benches:
        bench.close()


@pytest.fixture
def open_wire(tmp_path):
    """Returns the frames of a node with a DBC file; see `dbc_wire.open_wire`."""
    return functools.partial(dbc_wire.open_wire, tmp_path)
