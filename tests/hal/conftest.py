import pytest
from hal_bench import Bench


@pytest.fixture
def bench():
    bench = Bench().open()
    yield bench
    bench.close()
