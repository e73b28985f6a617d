"""Several jobs at once."""

import threading
import time

import pytest

from gemuco.learning import cores


@pytest.fixture(params=[1, 2, 8])
def count(request, monkeypatch):
    monkeypatch.setattr(cores, "count", lambda: request.param)
    return request.param


def test_what_they_return_is_in_order(count):
    def job(index):
        return lambda: time.sleep(0.02 / (1 + index)) or index

    assert cores.run([job(index) for index in range(9)]) == list(range(9))
    assert cores.run([]) == []


def test_one_that_fails_stops_the_others_and_is_told(count):
    stop, begun = threading.Event(), []

    def patient():
        begun.append(1)
        assert stop.wait(20.0) or count == 1

    def failing():
        raise ValueError("it is me")

    with pytest.raises(ValueError, match="it is me"):
        cores.run([failing, patient, patient], stop)
    assert len(begun) < 3
    assert stop.is_set() or count == 1


def test_a_single_one_runs_in_this_thread(count):
    assert cores.run([threading.current_thread]) == [threading.current_thread()]
