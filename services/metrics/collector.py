"""The state of robots as Prometheus metrics, computed anew at every scrape from the newest messages."""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any

from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector
from typing_extensions import override

from services.watch.service_rows import LoopRow, service_rows
from services.watch.signal_rows import Kind, SignalRow, signal_rows
from services.watch.snapshot import RobotSnapshot
from services.watch.trouble import HEALTHY, troubles, verdict

Snapshots = Callable[[], Iterable[RobotSnapshot]]
ELEMENTS = ("measured", "estimated", "missing", "distrusted", "unsure")
"""Numbers of elements in these states are published; an unsure one is estimated outside of what was learned."""

FAMILIES: dict[str, tuple[str, tuple[str, ...]]] = {
    "gemuco_robot_severity": ("0 good, 1 note, 2 degraded, 3 anomaly, 4 trouble, 5 gone", ("robot",)),
    "gemuco_trouble": ("1 for each trouble that the robot has now", ("robot", "title", "severity")),
    "gemuco_service_up": ("1 if the service is present, 0 if it is gone, frozen or absent", ("robot", "service")),
    "gemuco_loop_rate_hertz": ("Rate of the loop in the last second", ("robot", "service", "loop")),
    "gemuco_loop_wanted_hertz": ("Rate of the loop in the robot file", ("robot", "service", "loop")),
    "gemuco_loop_late_seconds": ("Lateness of its recent ticks", ("robot", "service", "loop", "quantile")),
    "gemuco_loop_busy_ratio": ("Share of the time inside the tick", ("robot", "service", "loop")),
    "gemuco_loop_skipped": ("Ticks skipped since the start", ("robot", "service", "loop")),
    "gemuco_elements": ("Number of elements in this state; estimated ones may be distrusted", ("robot", "state")),
    "gemuco_element_estimated": ("1 if the element is estimated now", ("robot", "signal", "element")),
    "gemuco_element_missing": ("1 if it is neither measured nor estimated", ("robot", "signal", "element")),
    "gemuco_element_age_seconds": ("Time since the element was measured", ("robot", "signal", "element")),
    "gemuco_element_std": ("Std of an estimate, in the signal's unit", ("robot", "signal", "element", "unit")),
    "gemuco_anomaly_score": ("Score of the body's deviation from normal", ("robot",)),
    "gemuco_anomaly_threshold": ("Score above which the body is not normal", ("robot",)),
    "gemuco_anomaly": ("1 while the body is not as the model knows it", ("robot",)),
    "gemuco_motors": ("1 for the mode of the motors", ("robot", "mode")),
    "gemuco_lease_held": ("1 if a client holds the lease", ("robot",)),
    "gemuco_bus_load_ratio": ("Load of the bus as a share of its bit rate", ("robot", "bus")),
    "gemuco_bus_up": ("1 if the bus works", ("robot", "bus")),
    "gemuco_bus_events": ("Counters of the bus", ("robot", "bus", "event")),
    "gemuco_device_up": ("1 if the device is ready or enabled", ("robot", "device")),
}
"""Name -> description and labels."""
COUNTERS = ("gemuco_loop_skipped", "gemuco_bus_events")
"""These only grow; Prometheus adds `_total` to their names."""
WELL = ("ready", "enabled", "homing", "stopping", "opening")


class RobotCollector(Collector):
    """Source of the metrics of one or more robots.

    Args:
        snapshots: Returns a snapshot of each robot now.
    """

    def __init__(self, snapshots: Snapshots) -> None:
        self._snapshots = snapshots

    @override
    def collect(self) -> Iterator[Metric]:
        """Yield all metric families; a value that is not known now is absent."""
        families: dict[str, Any] = {
            name: (CounterMetricFamily if name in COUNTERS else GaugeMetricFamily)(name, text, labels=labels)
            for name, (text, labels) in FAMILIES.items()
        }
        for snapshot in self._snapshots():
            for name, labels, value in values_of(snapshot):
                if math.isfinite(value):
                    families[name].add_metric(labels, value)
        yield from families.values()


Value = tuple[str, tuple[str, ...], float]
"""A value has the name of its family, its labels, and a number that may be NaN."""


def values_of(snapshot: RobotSnapshot) -> Iterator[Value]:
    """Yield everything that is known of a robot now."""
    robot = snapshot.robot
    rows = [row for row in signal_rows(snapshot) if row.unit] if snapshot.has_streams else []
    present = troubles(snapshot, rows)
    yield "gemuco_robot_severity", (robot,), float((present[0] if present else HEALTHY).level)
    for title, level in {trouble.title: trouble.level for trouble in reversed(present)}.items():
        yield "gemuco_trouble", (robot, title, level.name.lower()), 1.0
    for service in service_rows(snapshot):
        yield "gemuco_service_up", (robot, service.name), float(service.is_present)
        for loop in service.loops if service.is_present else ():
            yield from _of_loop((robot, service.name, loop.name), loop)
    yield from _of_elements(snapshot, rows)
    yield from _of_body(snapshot)
    yield from _of_hal(robot, snapshot.facts("hal"))


def _of_loop(labels: tuple[str, ...], loop: LoopRow) -> Iterator[Value]:
    yield "gemuco_loop_rate_hertz", labels, loop.rate
    yield "gemuco_loop_wanted_hertz", labels, loop.wanted
    for quantile, late in (("0.5", loop.p50), ("0.99", loop.p99), ("1", loop.worst)):
        yield "gemuco_loop_late_seconds", (*labels, quantile), late
    yield "gemuco_loop_busy_ratio", labels, loop.busy
    yield "gemuco_loop_skipped", labels, loop.skipped


def _of_elements(snapshot: RobotSnapshot, rows: Sequence[SignalRow]) -> Iterator[Value]:
    robot = snapshot.robot
    for row in rows:
        labels = (robot, row.signal, row.element)
        yield "gemuco_element_estimated", labels, float(row.kind is Kind.ESTIMATED)
        yield "gemuco_element_missing", labels, float(row.kind in (Kind.MASKED, Kind.OLD))
        yield "gemuco_element_age_seconds", labels, row.age
        if row.kind is Kind.ESTIMATED:
            yield "gemuco_element_std", (*labels, row.unit), row.std
    for state, count in (_counted(rows) if rows else _reported(snapshot)).items():
        yield "gemuco_elements", (robot, state), float(count)


def _counted(rows: Sequence[SignalRow]) -> dict[str, int]:
    is_in = {
        "measured": lambda row: row.kind is Kind.MEASURED,
        "estimated": lambda row: row.kind is Kind.ESTIMATED,
        "missing": lambda row: row.kind in (Kind.MASKED, Kind.OLD),
        "distrusted": lambda row: bool(row.distrust),
        "unsure": lambda row: row.kind is Kind.ESTIMATED and row.state == "unknown",
    }
    return {state: sum(map(is_in[state], rows)) for state in ELEMENTS}


def _reported(snapshot: RobotSnapshot) -> dict[str, int]:
    """Return the numbers in the model's status; they are of signals, because a fleet's streams are not read."""
    counts = snapshot.facts("model").get("signals")
    if not isinstance(counts, Mapping):
        return {}
    names = {"measured": "measured", "estimated": "estimated", "missing": "none"}
    return {state: int(counts[name]) for state, name in names.items() if isinstance(counts.get(name), int)}


def _of_body(snapshot: RobotSnapshot) -> Iterator[Value]:
    robot = snapshot.robot
    if (judged := verdict(snapshot)) is not None:
        yield "gemuco_anomaly_score", (robot,), judged.score
        yield "gemuco_anomaly_threshold", (robot,), judged.threshold
        yield "gemuco_anomaly", (robot,), float(judged.is_anomaly)
    if snapshot.motors:
        yield "gemuco_motors", (robot, snapshot.motors), 1.0
    if snapshot.holder is not None and snapshot.holder.is_fresh:
        yield "gemuco_lease_held", (robot,), float(bool(snapshot.holder.message.holder))


def _of_hal(robot: str, facts: Mapping[str, Any]) -> Iterator[Value]:
    """Yield what the HAL's status says of buses and devices."""
    for bus, health in _maps(facts.get("buses")):
        labels = (robot, bus)
        yield "gemuco_bus_up", labels, float(health.get("state") == "ok")
        if isinstance(load := health.get("load"), int | float):
            yield "gemuco_bus_load_ratio", labels, float(load)
        counters = health.get("counters")
        for event, count in counters.items() if isinstance(counters, Mapping) else ():
            if isinstance(count, int):
                yield "gemuco_bus_events", (*labels, str(event)), float(count)
    for device, health in _maps(facts.get("devices")):
        yield "gemuco_device_up", (robot, device), float(health.get("state") in WELL)


def _maps(facts: object) -> Iterator[tuple[str, Mapping[str, Any]]]:
    """Yield the maps in a part of a status; another program may publish anything under this key."""
    for name, part in facts.items() if isinstance(facts, Mapping) else ():
        if isinstance(part, Mapping):
            yield str(name), part
