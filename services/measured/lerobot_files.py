"""Datasets of LeRobot (v3.0) as tables: their files, and what a robot of gemuco only estimated."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from gemuco.errors import DatasetError

INFORMATION = Path("meta") / "info.json"
MARKS = "observation.estimated"
"""This feature of `gemuco export --format lerobot` says which elements were not measured."""

COUNTERS = ("frame_index", "index", "task_index")
"""These columns only count."""


def data_files(folder: Path) -> list[Path]:
    """Return the tables of a dataset; none if the folder is no dataset.

    Raises:
        DatasetError: It is a dataset without data, of another version, or its information cannot be read.
    """
    about = _information(folder)
    if about is None:
        return []
    version = str(about.get("codebase_version"))
    if not version.startswith("v3"):
        raise DatasetError(
            f"'{folder}' is a dataset of LeRobot in version {version}; v3.0 is read. LeRobot converts it: "
            "python -m lerobot.scripts.convert_dataset_v21_to_v30."
        )
    files = sorted((folder / "data").glob("chunk-*/file-*.parquet"))
    if not files:
        raise DatasetError(f"The dataset '{folder}' has no file data/chunk-*/file-*.parquet. Was it copied whole?")
    return files


def without_estimates(path: Path, columns: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the columns of a table; of a dataset with marks, what was estimated is NaN.

    Args:
        path: The table.
        columns: Column `FEATURE_k` -> its values, shape (rows,).
    """
    about = _information(path.parents[2]) if len(path.parents) > 2 else None
    if about is None:
        return columns
    columns = {name: values for name, values in columns.items() if name not in COUNTERS}
    features = about.get("features", {})
    marks = features.get(MARKS, {}).get("names") if isinstance(features, dict) else None
    if not marks:
        return columns
    estimated = {name: f"{MARKS}_{k}" for k, name in enumerate(marks)}
    kept = {name: values for name, values in columns.items() if not name.startswith(("observation.std_", f"{MARKS}_"))}
    for feature, description in features.items():
        if feature in (MARKS, "observation.std", "action"):
            continue
        for k, name in enumerate(description.get("names") or ()):
            column, mark = f"{feature}_{k}", columns.get(estimated.get(name, ""))
            if column in kept and mark is not None:
                kept[column] = np.where(mark > 0.5, np.nan, kept[column])
    return kept


def _information(folder: Path) -> dict[str, Any] | None:
    """Return what a dataset says of itself; None if the folder is no dataset.

    Raises:
        DatasetError: The file is not JSON.
    """
    path = folder / INFORMATION
    if not path.is_file():
        return None
    try:
        about = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise DatasetError(f"'{path}' cannot be read ({error}).") from None
    return about if isinstance(about, dict) and "codebase_version" in about else None
