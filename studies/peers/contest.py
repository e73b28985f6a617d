"""The contest: the peers, from a cache, and the model on the same rows of a body."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import joblib
import numpy as np

from studies.peers import anomalies, detectors, estimators, ours
from studies.peers.anomalies import Fault, Watched, area
from studies.peers.question import Body, Question, Trial
from studies.peers.table import OURS, Figures, Row

BLOCKS = 10
"""An episode of more rows than this is cut into this many blocks of time, from which peers hold some out."""
ESTIMATORS, DETECTORS = tuple(estimators.METHODS), tuple(detectors.DETECTORS)

Pair = tuple[float, float]
"""An error in the shown unit and in standard deviations."""


class Peers:
    """The peers and their cache, whose keys are the data.

    Args:
        folder: Folder of the cache.
        only_cached: Whether results that are not in the cache are left out.
    """

    def __init__(self, folder: Path, only_cached: bool = False) -> None:
        memory = joblib.Memory(folder, verbose=0)
        self._answer = memory.cache(estimators.answer)
        self._detect = memory.cache(detectors.detect)
        self.record = memory.cache(anomalies.arm)
        self._only_cached = only_cached

    def errors(self, question: Question, trial: Trial, signals: Sequence[str], seed: int) -> dict[str, Pair]:
        """Return peer -> its errors."""
        arrays = problem(question, trial, signals)
        errors = {}
        for name in ESTIMATORS:
            call = (name, arrays, seed, estimators.VERSION)
            if not self._only_cached or self._answer.check_call_in_cache(*call):
                errors[name] = question.judge(trial, self._answer(*call))
        return errors

    def scores(self, watched: Watched, names: Sequence[str], seed: int) -> dict[str, list[np.ndarray]]:
        """Return peer -> scores of the healthy rows and of the rows with each fault."""
        join = lambda rows: np.concatenate([rows[name] for name in names], axis=1)
        sizes = [watched.healthy[name].shape[1] for name in names]
        parts = [join(watched.healthy), *(join(rows) for rows in watched.broken.values())]
        healthy = np.concatenate([join(rows) for rows in watched.train])
        scores = {}
        for name in DETECTORS:
            signal = np.repeat(np.arange(len(names)), sizes)
            call = (name, healthy, signal, np.concatenate(parts), seed, detectors.VERSION)
            if not self._only_cached or self._detect.check_call_in_cache(*call):
                scores[name] = np.split(self._detect(*call), np.cumsum([len(part) for part in parts])[:-1])
        return scores


def problem(question: Question, trial: Trial, signals: Sequence[str]) -> tuple[np.ndarray, ...]:
    """Return the arrays of a peer's problem; see `estimators.Problem`."""
    others = [name for name in signals if name not in question.given and name != question.target]
    owner, blocks, asked, known = [], [], [], 0
    for index, (condition, episodes) in enumerate(trial.train.items()):
        for episode in episodes:
            count = len(episode[question.target])
            parts = np.arange(count) * BLOCKS // count if count > BLOCKS else np.zeros(count, int)
            blocks.append(known + parts)
            owner.append(np.full(count, index))
            known += int(parts[-1]) + 1
        asked.append(np.full(len(trial.test[condition][question.target]), index))
    x, y = _columns(trial.learned, question.given), trial.learned(question.target)
    rest = _columns(trial.learned, others) if others else np.zeros((len(x), 0))
    query = _columns(trial.judged, question.given)
    return x, y, rest, np.concatenate(owner), np.concatenate(blocks), query, np.concatenate(asked)


def _columns(signal: Callable[[str], np.ndarray], names: Sequence[str]) -> np.ndarray:
    return np.concatenate([signal(name) for name in names], axis=1)


def estimates(body: Body, questions: Sequence[Question], seeds: int, peers: Peers, has_ours: bool) -> list[Row]:
    """Return the rows of one body; raises `MissingData` if its data are not on this machine."""
    theirs: list[dict[str, list[Pair]]] = [{} for _ in questions]
    mine: list[list[Pair]] = [[] for _ in questions]
    trained: list[ours.Trained] = []
    for seed in range(seeds):
        trial = body.trial(seed)
        if has_ours:
            trained.append(ours.train(body, trial, seed))
        for index, question in enumerate(questions):
            if has_ours:
                mine[index].append(question.judge(trial, ours.predict(trained[-1], question, trial)))
            for name, pair in peers.errors(question, trial, tuple(body.units), seed).items():
                theirs[index].setdefault(name, []).append(pair)
    return [
        Row(
            body=body.name,
            question=question.name,
            shown=question.shown,
            bar=question.bar,
            peers={name: _figures(pairs) for name, pairs in theirs[index].items() if len(pairs) == seeds},
            ours=_figures(mine[index]) if has_ours else None,
            settings=body.settings_name,
            **_record(trained),
        )
        for index, question in enumerate(questions)
    ]


def _figures(pairs: Sequence[Pair]) -> Figures:
    unit, std = zip(*pairs, strict=True)
    return Figures(unit, std)


def _record(trained: Sequence[ours.Trained]) -> dict[str, Any]:
    """Return the mean duration of the trainings [s], and the first refusal or an empty text."""
    seconds = float(np.mean([each.seconds for each in trained])) if trained else float("nan")
    return {"seconds": seconds, "refusal": next((each.refusal for each in trained if each.refusal), "")}


def detections(fault: Fault, windows: Sequence[int], seeds: int, peers: Peers, has_ours: bool) -> list[Row]:
    """Return the rows of one fault; raises `MissingData` if its data are not on this machine."""
    areas: dict[tuple[str, int], list[float]] = {}
    trained: list[ours.Trained] = []
    for seed in range(seeds):
        watched = fault.watched(seed)
        scores = peers.scores(watched, tuple(fault.units), seed)
        if has_ours:
            trained.append(ours.watch(fault, watched, seed))
            scores[OURS] = [ours.scores(trained[-1], rows) for rows in (watched.healthy, *watched.broken.values())]
        for name, (healthy, *broken) in scores.items():
            for window in windows:
                mean = float(np.mean([area(each, healthy, window) for each in broken]))
                areas.setdefault((name, window), []).append(mean)
    areas = {key: values for key, values in areas.items() if len(values) == seeds}
    return [
        Row(
            body=fault.name,
            question=anomalies.window_name(window),
            shown="AUROC",
            bar=fault.bar,
            peers={name: Figures(tuple(areas[name, window])) for name in DETECTORS if (name, window) in areas},
            ours=Figures(tuple(areas[OURS, window])) if has_ours else None,
            settings="default, structure determined",
            **_record(trained),
        )
        for window in windows
    ]
