"""Estimates of one lost element: by whole signals, by all measured elements, and by ordinary ridge regression.

    python -m studies.accuracy.lost_elements [--robots kxr_humanoid pr2_duster musashi_arm kuka car]

Bodies and motion are those of `studies.accuracy.lies`, which no model was trained on. Every element is hidden in turn.
`whole signals` is the mask or search that is used until ways were tried; `used` is what `estimate` returns. Ridge
regression predicts each element from all others, and was fitted to the model's normal samples, for all tools at once.
The errors are geometric means over the elements, of root mean square errors [standard deviations of the element].
"""

import argparse

import numpy as np
from rich.console import Console
from rich.table import Table

from gemuco.certainty.certainty import NINETY
from gemuco.estimation import Recipe, fill
from studies.accuracy.lies import BODIES, Body, body_of, under

SAMPLES = 300
"""This many samples of all motion are judged."""


def errors_of(body: Body, column: int) -> tuple[np.ndarray, str]:
    """Return errors by whole signals, as used and by ridge, and whether each is in its interval; and the used method.

    Args:
        body: A body.
        column: Index of the element among the judged ones.

    Returns:
        Shape (4, samples) [standard deviations], and the method.
    """
    element, rows, method = int(body.columns[column]), [], ""
    for condition, motion in body.motion.items():
        schema = under(body.schema, condition)
        finite = np.arange(schema.layout.size) != element
        recipes = Recipe.of(schema, finite), Recipe.of(schema, finite, is_tried=True)
        method = recipes[1].method[schema.layout.element(element).split(".")[0]]
        for row in motion[:: max(1, len(motion) * len(body.motion) // SAMPLES)]:
            hidden = np.where(finite, schema.scaler.restore(row), np.nan)
            hidden.setflags(write=False)
            both = [fill(schema, hidden, recipe) for recipe in recipes]
            scale, truth = schema.scaler.std[element], schema.scaler.restore(row)[element]
            off = [(one.value[element] - truth) / scale for one in both]
            ridge = np.append(row[body.columns], 1.0) @ body.ridge[:, column] - row[element]
            within = abs(off[1]) <= NINETY * both[1].std[element] / scale
            rows.append([*off, ridge, float(within)])
    return np.array(rows).T, method


def row_of(name: str) -> tuple[str, ...]:
    """Return the row of one body."""
    body, errors, methods = body_of(name), [], []
    for column in range(len(body.columns)):
        parts, method = errors_of(body, column)
        errors.append([*np.sqrt(np.mean(parts[:3] ** 2, axis=1)), parts[3].mean()])
        methods.append(method)
    table = np.array(errors)
    means = np.exp(np.log(table[:, :3]).mean(axis=0))
    ways = ", ".join(f"{method} {methods.count(method)}" for method in sorted(set(methods)))
    behind = np.sum(table[:, 1] > 1.05 * table[:, 2])
    return (name, *(f"{mean:.3f}" for mean in means), f"{behind} of {len(table)}", f"{table[:, 3].mean():.0%}", ways)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robots", nargs="+", default=list(BODIES), choices=list(BODIES))
    heads = ("robot", "whole signals", "used", "ridge", "worse than ridge", "in 90 % interval", "elements by method")
    result = Table(*heads)
    for robot in parser.parse_args().robots:
        result.add_row(*row_of(robot))
    Console(width=160).print(result)
