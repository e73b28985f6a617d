"""A layout for Foxglove: the robot in 3D, plots of measured and estimated values, their states, the log, health."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from gemuco.writing import replace
from services.errors import ServiceError

MOST_ELEMENTS, MOST_PLOTS = 6, 3
"""A plot shows at most the first number of elements, and at most the second number of signals has a plot."""
COLORS = ("#4e98e2", "#f5774d", "#f7df71", "#5cd6a9", "#a395e2", "#e27cb6")
ESTIMATED = "#ffb04a"

Signals = Mapping[str, tuple[str, Sequence[str]]]
"""Signal -> unit and elements."""


def layout(robot: str, signals: Signals, root: str) -> dict[str, Any]:
    """Return a layout as Foxglove imports it.

    Args:
        robot: Name of the robot.
        signals: Its signals.
        root: Root frame of its URDF.
    """
    plotted = [name for name, (unit, _) in signals.items() if unit][:MOST_PLOTS]
    panels: dict[str, Any] = {
        "3D!robot": _scene(robot, root),
        "StateTransitions!states": {
            "isSynced": True,
            "paths": [
                {"value": f"/{robot}/{name}.{element}.kind", "timestampMethod": "receiveTime", "label": element}
                for name in plotted[:1]
                for element in signals[name][1][:MOST_ELEMENTS]
            ],
        },
        "RosOut!log": {"searchTerms": [], "minLogLevel": 1, "topicToRender": f"/{robot}/log"},
        "RawMessages!health": {
            "topicPath": f"/{robot}/health", "diffEnabled": False, "diffMethod": "custom",
            "diffTopicPath": "", "showFullMessageForDiff": False,
        },
    }  # fmt: skip
    for name in plotted:
        unit, elements = signals[name]
        panels[f"Plot!{name}"] = _plot(robot, name, unit, elements)
    plots = [f"Plot!{name}" for name in plotted]
    right = _stack([*plots, "StateTransitions!states"], "column")
    left = _stack(["3D!robot", "RosOut!log", "RawMessages!health"], "column", 60)
    return {
        "configById": panels,
        "globalVariables": {},
        "userNodes": {},
        "playbackConfig": {"speed": 1},
        "layout": {"first": left, "second": right, "direction": "row", "splitPercentage": 45},
    }


def write_layout(path: Path, robot: str, signals: Signals, root: str) -> None:
    """Write a layout file.

    Raises:
        ServiceError: It exists, or cannot be written.
    """
    if path.exists():
        raise ServiceError(f"'{path}' exists and is not replaced. Name another file.")
    try:
        replace(path, json.dumps(layout(robot, signals, root), indent=1).encode())
    except OSError as error:
        raise ServiceError(f"'{path}' cannot be written: {error.strerror}.") from None


def _scene(robot: str, root: str) -> dict[str, Any]:
    return {
        "followMode": "follow-none",
        "followTf": root,
        "scene": {"backgroundColor": "#15181d", "transforms": {"showLabel": False, "axisScale": 0.0}},
        "topics": {f"/{robot}/scene": {"visible": True}},
        "transforms": {},
        "layers": {
            "grid": {
                "layerId": "foxglove.Grid", "instanceId": "grid", "label": "Floor", "visible": True,
                "size": 4, "divisions": 16, "color": "#50586480", "frameId": root,
                "position": [0, 0, -1], "rotation": [0, 0, 0],
            },
        },
        "cameraState": {
            "perspective": True, "distance": 3.0, "phi": 65, "thetaOffset": 60, "fovy": 45, "near": 0.05, "far": 100,
            "targetOffset": [0, 0, 0], "target": [0, 0, 0], "targetOrientation": [0, 0, 0, 1],
        },
        "imageMode": {},
    }  # fmt: skip


def _plot(robot: str, name: str, unit: str, elements: Sequence[str]) -> dict[str, Any]:
    paths = []
    for index, element in enumerate(elements[:MOST_ELEMENTS]):
        place = f"/{robot}/{name}.{element}"
        for field, color, size in (
            ("measured", COLORS[index % len(COLORS)], 1.5), ("estimated", ESTIMATED, 2.5), ("low", ESTIMATED, 0.5),
            ("high", ESTIMATED, 0.5),
        ):  # fmt: skip
            label = element if field == "measured" else f"{element}, {field}"
            paths.append({
                "value": f"{place}.{field}", "enabled": True, "timestampMethod": "receiveTime", "label": label,
                "color": color, "lineSize": size, "showLine": True,
            })  # fmt: skip
    return {
        "foxglovePanelTitle": f"{name} [{unit}]", "paths": paths, "showXAxisLabels": True, "showYAxisLabels": True,
        "showLegend": False, "legendDisplay": "none", "showPlotValuesInLegend": False, "isSynced": True,
        "xAxisVal": "timestamp", "sidebarDimension": 240, "followingViewWidth": 30,
    }  # fmt: skip


def _stack(panels: list[str], direction: str, first: float | None = None) -> Any:
    """Return panels beside or below one another, all of the same size but for the first [%]."""
    if len(panels) == 1:
        return panels[0]
    share = 100.0 / len(panels) if first is None else first
    rest = _stack(panels[1:], direction)
    return {"first": panels[0], "second": rest, "direction": direction, "splitPercentage": share}
