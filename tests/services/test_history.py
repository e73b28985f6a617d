"""The last minute of estimates: a ring that takes no memory while it runs, and pages that fit into messages."""

import threading
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from services.client import Client
from services.errors import BadArguments, ServiceUnavailable, TooSlow
from services.process.service import Service
from services.wire import history
from services.wire.history import HistoryRing, fetch
from services.wire.messages import MAX_BYTES, Estimates

SIGNALS = {"joint_position": 2, "muscle_length": 3}
RATE = 100.0


def estimates(row: int) -> Estimates:
    """Values that can be told from those of any other row."""
    return Estimates(
        stamp_ns=10_000_000 * row,
        cycle=row,
        values={name: row + np.arange(size) / 10 for name, size in SIGNALS.items()},
        estimated={name: np.arange(size) == row % size for name, size in SIGNALS.items()},
        std={name: np.zeros(size) for name, size in SIGNALS.items()},
        method=dict.fromkeys(SIGNALS, "measured"),
        mask=dict.fromkeys(SIGNALS, ""),
        residual=dict.fromkeys(SIGNALS, 0.0),
    )


def filled(rows: int) -> HistoryRing:
    ring = HistoryRing(SIGNALS, RATE)
    for row in range(rows):
        ring.add(estimates(row), row / RATE)
    return ring


def asking(ring: HistoryRing, now: float, boot: int = 1) -> Any:
    return lambda arguments, left: ring.answer(arguments, boot, now)


def test_memory_is_bounded_in_seconds_and_in_bytes() -> None:
    ring = filled(0)
    assert ring.capacity == history.WINDOW * RATE
    assert ring.nbytes == ring.capacity * (9 * 5 + 16)
    before = ring.nbytes
    for row in range(2 * ring.capacity):
        ring.add(estimates(row), row / RATE)
    assert ring.nbytes == before
    large = HistoryRing({"skin": 1000}, 1000.0)
    assert 0.99 * history.MOST_BYTES < large.nbytes <= history.MOST_BYTES


@pytest.mark.parametrize("rows", [0, 1, 500, 6000, 9999])
def test_the_last_seconds_come_back_row_by_row(rows: int) -> None:
    found = fetch(asking(filled(rows), (rows - 1) / RATE), 2.0, (), 10.0)
    expected = [estimates(row) for row in range(max(0, rows - 201), rows)]
    assert found.stamp_ns.tolist() == [one.stamp_ns for one in expected]
    for name, size in SIGNALS.items():
        assert found.values[name].shape == found.estimated[name].shape == (len(expected), size)
        for row, one in enumerate(expected):
            np.testing.assert_array_equal(found.values[name][row], one.values[name])
            np.testing.assert_array_equal(found.estimated[name][row], one.estimated[name])
    if rows:
        assert found.seconds[-1] == 0.0
        assert found.seconds[0] == pytest.approx(-(len(expected) - 1) / RATE)


def test_more_than_is_kept_gives_what_is_kept_and_signals_can_be_chosen() -> None:
    ring = filled(9000)
    found = fetch(asking(ring, 90.0), 1e6, ["muscle_length"], 10.0)
    assert list(found.values) == list(found.estimated) == ["muscle_length"]
    assert len(found.stamp_ns) == ring.capacity
    assert found.stamp_ns[-1] == estimates(8999).stamp_ns


def test_pages_are_joined_and_each_fits_into_a_message(monkeypatch: pytest.MonkeyPatch) -> None:
    assert history.PAGE_BYTES <= MAX_BYTES / 2
    monkeypatch.setattr(history, "PAGE_BYTES", 5000)
    monkeypatch.setattr(history, "PAGE_EVERY", 0.0)
    ring, sizes = filled(1000), []

    def ask(arguments: dict[str, Any], left: float) -> dict[str, Any]:
        page = ring.answer(arguments, 1, 10.0)
        sizes.append(
            len(page["stamp_ns"]) + sum(len(b) for part in ("values", "estimated") for b in page[part].values())
        )
        ring.add(estimates(ring.rows), 10.0 + ring.rows / RATE)  # rows come in while pages are asked for
        return page

    found = fetch(ask, 5.0, (), 10.0)
    assert found.stamp_ns.tolist() == [estimates(row).stamp_ns for row in range(500, 1000)]
    assert len(sizes) > 4
    assert max(sizes) <= 5000


def test_rows_that_are_overwritten_meanwhile_are_left_out() -> None:
    ring = filled(6000)
    for row in range(6000, 6100):
        ring.add(estimates(row), row / RATE)
    page = ring.page(50, 200, ["joint_position"])
    assert (page["begin"], page["end"]) == (100, 200)
    assert ring.page(0, 40, ["joint_position"])["begin"] == ring.page(0, 40, ["joint_position"])["end"]


@pytest.mark.long
def test_a_reader_never_gets_a_torn_row() -> None:
    ring, done = filled(6000), threading.Event()

    def write() -> None:
        while not done.is_set():
            ring.add(estimates(ring.rows), ring.rows / RATE)

    thread = threading.Thread(target=write)
    thread.start()
    try:
        for _ in range(200):
            page = ring.page(ring.rows - ring.capacity, ring.rows, SIGNALS)
            stamps = np.frombuffer(page["stamp_ns"], "<i8")
            rows = np.arange(page["begin"], page["end"])
            np.testing.assert_array_equal(stamps, 10_000_000 * rows)
            values = np.frombuffer(page["values"]["joint_position"], "<f8").reshape(-1, 2)
            np.testing.assert_array_equal(values[:, 0], rows)
    finally:
        done.set()
        thread.join()


@pytest.mark.parametrize(
    "arguments",
    [
        {},
        {"seconds": 0},
        {"seconds": "1"},
        {"seconds": float("inf")},
        {"seconds": float("nan")},
        {"seconds": True},
        {"begin": 0},
        {"begin": -1, "end": 2},
        {"begin": 0, "end": 1 << 70},
        {"begin": 0.0, "end": 2},
        {"seconds": 1, "signals": ["elbow"]},
        {"seconds": 1, "signals": "joint_position"},
        {"seconds": 1, "signals": [["joint_position"]]},
    ],
)
def test_wrong_arguments_are_refused(arguments: dict[str, Any]) -> None:
    with pytest.raises(BadArguments):
        filled(10).answer(arguments, 1, 1.0)


def test_a_service_that_was_started_anew_is_told_and_a_slow_one_too(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(history, "PAGE_BYTES", 1000)
    ring, boots = filled(1000), iter(range(100))
    with pytest.raises(ServiceUnavailable, match="restarted while its history was read"):
        fetch(lambda arguments, left: ring.answer(arguments, next(boots), 10.0), 5.0, (), 10.0)

    def slow(arguments: dict[str, Any], left: float) -> dict[str, Any]:
        raise TooSlow("not within")

    with pytest.raises(TooSlow):
        fetch(slow, 5.0, (), 0.2)


@pytest.fixture
def client(robot: str) -> Iterator[Client]:
    ring = filled(6000)
    with Service(robot, "model") as service, Client(robot) as far:
        service.verb("history", lambda arguments: ring.answer(arguments, service.boot, 60.0))
        yield far


def test_a_client_gets_the_history(client: Client) -> None:
    found = client.history(1.0, ["joint_position"], timeout=20.0)
    assert found.values["joint_position"].shape == (100, 2)
    assert found.values["joint_position"][-1].tolist() == [5999.0, 5999.1]
    with pytest.raises(BadArguments, match="must be a list of these names: joint_position, muscle_length"):
        client.history(1.0, ["elbow"], timeout=20.0)
