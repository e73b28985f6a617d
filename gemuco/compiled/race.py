"""A race of masks: each is measured on more and more rows until it is surely on one side of the threshold.

Errors are means over several splits of the data, each with its own network; see `gemuco.structure.mask_judge`.
"""

import math
from typing import NamedTuple

import numpy as np

from gemuco.compiled.chain import Packed
from gemuco.compiled.jit import jit
from gemuco.compiled.masks import BLOCK, Room, Rows, begin, make_room, measure, usable


class Splits(NamedTuple):
    """Networks of one form, and the rows of each in the order of the race, one split behind the other.

    Attributes:
        flat: `Packed.flat` of every network, shape (splits, n).
        form: `Packed.form`.
        first: Where the rows of every split begin, and the last end, shape (splits + 1,).
        rows: The rows.
        liveliness: Variance of every element, shape (splits, size).
        signal: Of which signal every element is, shape (size,).
    """

    flat: np.ndarray
    form: np.ndarray
    first: np.ndarray
    rows: Rows
    liveliness: np.ndarray
    signal: np.ndarray


class Heats(NamedTuple):
    """The heats of a race.

    Attributes:
        rows: How many rows of each split a heat has, shape (heats,).
        tell: Facts about these rows, `gemuco.structure.row_draw.Heat` of every split,
            shape (heats, splits, rows, 3 + 2 k).
    """

    rows: np.ndarray
    tell: np.ndarray


WEIGHT, DOUBT, HIDDEN, KNOWN = range(4)


class Rule(NamedTuple):
    """When the race is over for a mask.

    Attributes:
        outputs: Which signals are judged, shape (signals,).
        is_masked: Whether those are not judged that the mask has.
        amounts: How much of each signal there is to explain, shape (signals,).
        limit: The threshold, a squared error.
        sure: What is so many standard errors away from it is out.
        bad: What is below must stay there with so many more bad rows.
        told: A signal's error is an estimate where at least so many rows tell of each of its living elements.
    """

    outputs: np.ndarray
    is_masked: bool
    amounts: np.ndarray
    limit: float
    sure: float
    bad: int
    told: int


@jit
def factors(rows, first, uses, tell, count, liveliness, signal, least, measured, out):
    """What makes weighted sums of an element's squares its share of the error of its signal, shape (size,), in `out`.

    NaN for a signal of which nothing living is measured, or that has a living element of which few rows tell.

    Args:
        rows: All rows.
        first: The first of those that were measured.
        uses: Which of these have all signals of the mask, shape (any,).
        tell: What they tell, shape (any, 3 + 2 k).
        count: How many they are.
        liveliness: Shape (size,).
        signal: Shape (size,).
        least: So many rows at least.
        measured: Room for a number of each signal, shape (signals,).
        out: Shape (size,).
    """
    size, there = len(out), np.zeros(len(out))
    for i in range(size):
        out[i] = 0.0
    for row in range(count):
        if uses[row]:
            weight = tell[row, WEIGHT]
            for i in range(size):
                counts = rows.known[first + row, i]
                there[i] += counts
                out[i] += weight * counts
    for i in range(len(measured)):
        measured[i] = 0.0
    for i in range(size):
        if there[i] > 0.0:
            measured[signal[i]] += liveliness[i]
    for i in range(size):  # what hardly weighs tells little
        if there[i] < least or 2.0 * count * out[i] < there[i]:
            out[i] = 1.0
            if liveliness[i] > 0.0:
                measured[signal[i]] = np.nan
    for i in range(size):
        whole = measured[signal[i]]
        out[i] = 1.0 / (out[i] * whole) if whole > 0.0 else np.nan


@jit
def estimate(squared, judged, tell, count, mean):
    """What the first rows tell of all.

    Args:
        squared: Of `measure`, shape (any, size).
        judged: How much an element's squares add to the error of the mask, shape (size,).
        tell: See `Heats`, shape (any, 3 + 2 k).
        count: How many rows they are.
        mean: Set to the mean of every element, shape (size,).

    Returns:
        Of the error of the mask the variance, and what the worst unseen row may hide.
    """
    k, size = (tell.shape[1] - KNOWN) // 2, len(mean)
    value, part, variance, worst = np.empty(count), np.zeros(k), 0.0, 0.0
    for i in range(size):
        mean[i] = 0.0
    for row in range(count):
        weight, total = tell[row, WEIGHT], 0.0
        for i in range(size):
            mean[i] += weight * squared[row, i]
            total += judged[i] * squared[row, i]
        value[row] = total
        worst = max(worst, tell[row, HIDDEN] * total)
        for i in range(k):
            part[i] += tell[row, KNOWN + k + i] * total
    for row in range(count):
        left = value[row]
        for i in range(k):
            left -= tell[row, KNOWN + i] * part[i]
        variance += tell[row, DOUBT] * left * left
    return variance, worst


@jit
def weigh(bits, rule, factor, signal, out):
    """How much the error of each signal adds to that of a mask, to `out`, shape (signals,).

    Args:
        bits: The mask, shape (signals,).
        rule: What is judged.
        factor: Of `factors` of every split, shape (splits, size).
        signal: Shape (size,).
        out: 0 where the error of a signal is not known.

    Returns:
        Whether all are known that are asked for.
    """
    is_clear, total = True, 0.0
    for i in range(len(out)):
        is_asked = rule.outputs[i] and not (rule.is_masked and bits[i] > 0.0)
        out[i] = rule.amounts[i] if is_asked else 0.0
    for i in range(len(signal)):
        for split in range(len(factor)):
            if out[signal[i]] > 0.0 and math.isnan(factor[split, i]):
                out[signal[i]], is_clear = 0.0, False
    for i in range(len(out)):
        total += out[i]
    for i in range(len(out)):
        out[i] /= total if total > 0.0 else 1.0
    return is_clear and total > 0.0


class Lane(NamedTuple):
    """Where one core races masks.

    Attributes:
        room: For the network.
        seen: Squared errors of the rows so far, shape (splits, rows, size).
        uses: Which of these rows have all signals of the mask, shape (splits, rows).
        factor: Of `factors`, shape (splits, size).
        mean: Of `estimate`, shape (size,).
        judged: For `estimate`, shape (size,).
        weights: Of `weigh`, shape (signals,).
        some: Squared errors of other rows, shape (BLOCK, size).
    """

    room: Room
    seen: np.ndarray
    uses: np.ndarray
    factor: np.ndarray
    mean: np.ndarray
    judged: np.ndarray
    weights: np.ndarray
    some: np.ndarray


@jit
def make_lane(splits, most):
    """For heats of so many rows at most."""
    count, size = splits.liveliness.shape
    return Lane(
        make_room(Packed(splits.flat[0], splits.form), splits.rows.given.shape[1]),
        np.empty((count, most, size), np.float32),
        np.empty((count, most), np.bool_),
        np.empty((count, size)),
        np.empty(size),
        np.empty(size),
        np.empty(splits.rows.whole.shape[1]),
        np.empty((BLOCK, size), np.float32),
    )


@jit
def look(splits, gate, bits, before, now, inputs, lane):
    """Measure a mask on the rows of a heat that come after those of the one before.

    Args:
        splits: See `race`.
        gate: Of the mask.
        bits: The mask.
        before: So many rows of each split were measured.
        now: So many are to be.
        inputs: What the last call returned; there is none yet if `before` is 0.
        lane: Is changed.
    """
    for split in range(len(splits.flat)):
        chain = Packed(splits.flat[split], splits.form)
        if before == 0 or len(splits.flat) > 1:
            inputs = begin(chain, gate, bits, lane.room)
        first, seen = splits.first[split], lane.seen[split]
        for piece in range(before, now, BLOCK):
            count = min(BLOCK, now - piece)
            measure(chain, splits.rows, first + piece, count, bits, inputs, lane.room, seen, piece)
        for row in range(before, now):
            lane.uses[split, row] = usable(splits.rows, first + row, bits)
    return inputs


@jit
def is_out(splits, heats, heat, rule, bits, lane, errors):
    """Whether a mask is surely on one side of the threshold by what was seen in a heat.

    Args:
        splits: See `race`.
        heats: See `race`.
        heat: Which.
        rule: See `race`.
        bits: The mask.
        lane: After `look`.
        errors: Set to an estimate of every signal's error, shape (signals,); NaN where it is not known.
    """
    count, size, now, signal = len(splits.flat), len(splits.signal), heats.rows[heat], splits.signal
    for split in range(count):
        first, tell, alive = splits.first[split], heats.tell[heat, split], splits.liveliness[split]
        factors(splits.rows, first, lane.uses[split], tell, now, alive, signal, rule.told, errors, lane.factor[split])
    is_clear, found, variance, hidden = weigh(bits, rule, lane.factor, signal, lane.weights), 0.0, 0.0, 0.0
    for i in range(len(errors)):
        errors[i] = 0.0
    for split in range(count):
        for i in range(size):
            weight = lane.weights[signal[i]]
            lane.judged[i] = weight * lane.factor[split, i] if weight > 0.0 else 0.0
        told = estimate(lane.seen[split], lane.judged, heats.tell[heat, split], now, lane.mean)
        variance, hidden = variance + told[0] / count**2, hidden + told[1] / count
        for i in range(size):
            errors[signal[i]] += lane.mean[i] * lane.factor[split, i] / count
    for i in range(len(errors)):
        errors[i] = errors[i] if not errors[i] < 0.0 else 0.0  # few rows may tell less than nothing
        if lane.weights[i] > 0.0:
            found += lane.weights[i] * errors[i]
    doubt, over = rule.sure * math.sqrt(variance), found - rule.limit
    return is_clear and (over > doubt or over + rule.bad * hidden < -doubt)


@jit
def add(splits, gate, bits, lane, total, done):
    """Add the squared errors of the other rows under a mask to those of the first ones, shape (splits, size)."""
    for split in range(len(total)):
        chain, last = Packed(splits.flat[split], splits.form), splits.first[split + 1]
        inputs = begin(chain, gate, bits, lane.room)
        for first in range(splits.first[split] + done, last, BLOCK):
            count = min(BLOCK, last - first)
            measure(chain, splits.rows, first, count, bits, inputs, lane.room, lane.some, 0)
            for row in range(count):
                for i in range(total.shape[1]):
                    total[split, i] += lane.some[row, i]


@jit
def race(splits, heats, rule, gates, masks, squared, total, done):
    """Race masks.

    Args:
        splits: What is measured, and on what.
        heats: On how many rows, and what these tell. Without heats all rows are measured that were not.
        rule: When it is over.
        gates: 1 for elements that a mask lets through, else 0, shape (masks, size).
        masks: 1 for the signals of a mask, else 0, shape (masks, signals).
        squared: Set to estimates of the errors of all signals, shape (masks, signals); NaN where they are not known.
        total: Sum of squared errors over the rows that were measured, shape (masks, splits, size); goes on from there.
        done: How many rows of each split these are, of the race before or 0; -1 for all of them; shape (masks,).
    """
    lane = make_lane(splits, heats.tell.shape[2])
    for index in range(len(masks)):
        bits, gate, is_over, inputs = masks[index], gates[index], False, 0
        for heat in range(len(heats.rows)):
            before, now = done[index], heats.rows[heat]
            inputs = look(splits, gate, bits, before, now, inputs, lane)
            for split in range(len(splits.flat)):
                for row in range(before, now):
                    for i in range(total.shape[2]):
                        total[index, split, i] += lane.seen[split, row, i]
            done[index] = now
            is_over = is_out(splits, heats, heat, rule, bits, lane, squared[index])
            if is_over:
                break
        if not is_over:
            add(splits, gate, bits, lane, total[index], done[index])
            done[index] = -1
