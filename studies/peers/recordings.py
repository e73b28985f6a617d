"""Recordings of real robots: joint capsule, Schunk arm, KUKA KR300 and an arm with pneumatic muscles.

Their folder is $GEMUCO_DATA, ../shared/data if that is not set. Held out are blocks of time, whole paths, or a whole
trajectory, never single rows: neighbours in time are nearly equal.
"""

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cache, partial
from pathlib import Path

import numpy as np

from gemuco import TrainConfig
from services.learning.trainer import train_config
from services.measured.description import MeasuredConfig, load_measured
from services.measured.reading import read_measured
from studies.peers.question import Bar, Body, MissingData, Question, Rows, Trial

ROOT = Path(__file__).parents[2]
REAL = Bar("best", 1.05, in_std=True)
ANGLES, VELOCITY, EFFORT = "joint_position", "joint_velocity", "joint_effort"
BOARDS = tuple(f"board_{i}" for i in range(4))
MOTOR, SECOND = "motor_position", "second_encoder"
PRESSURE, PAST = "muscle_pressure", "past_pressure"
CAPSULE_BLOCKS = 40
"""Number of blocks into which the capsule's recording is cut for outer postures; a seed adds its number."""
KUKA_UNITS = {MOTOR: "rad", SECOND: "rad", VELOCITY: "rad/s", EFFORT: "N m"}
KUKA = Bar("if ridge", 0.02, in_std=True)
CAPSULE_UNITS = {**dict.fromkeys(BOARDS, "1"), ANGLES: "rad"}
SCHUNK_UNITS = {ANGLES: "rad", VELOCITY: "rad/s", EFFORT: "N m"}
PAM_UNITS = {ANGLES: "rad", PRESSURE: "1", PAST: "1"}
DEGREES = 180.0 / np.pi
GAP = 50
"""Rows on both sides of a held-out block of the KUKA that are not used [4 ms each]."""
PAM_EVERY, PAM_PAST = 20, (20, 45)
"""One of this many rows of the pneumatic arm is used; its past pressures are this many rows old."""


def folder(name: str) -> Path:
    """Return the folder of a recording.

    Raises:
        MissingData: It is not on this machine.
    """
    place = Path(os.environ.get("GEMUCO_DATA", ROOT.parent / "shared" / "data")) / name
    if not place.is_dir():
        raise MissingData(f"no recording '{place}'; GEMUCO_DATA names the folder of the recordings")
    return place


def whole(rows: Rows, parts: Sequence[np.ndarray]) -> list[Rows]:
    """Return parts of one recording, each an array of row numbers."""
    return [{name: values[part] for name, values in rows.items()} for part in parts if len(part)]


@cache
def described(name: str) -> tuple[MeasuredConfig, tuple[Rows, ...]]:
    """Return a description of examples/ and the episodes of its recording."""
    config = load_measured(ROOT / "examples" / f"{name}.yaml")
    return config, tuple(episode.values for episode in read_measured(config, folder(name)).episodes)


def _described_settings(name: str, seed: int) -> TrainConfig:
    config = load_measured(ROOT / "examples" / f"{name}.yaml")
    return train_config(config.model, config.training.epochs, seed)


def capsule(seed: int) -> Trial:
    """Hold out the last fifth."""
    rows = _joined("joint_capsule")
    count = len(rows[ANGLES])
    first = round(0.8 * count)
    return _one(whole(rows, [np.arange(first)]), whole(rows, [np.arange(first, count)])[0])


def _capsule_far(seed: int) -> Trial:
    """Learn from 40 % at one end of the recording, and judge the 40 % at the other end."""
    rows = _joined("joint_capsule")
    count = len(rows[ANGLES])
    ends = np.arange(round(0.4 * count)), np.arange(round(0.6 * count), count)
    learned, judged = ends if seed % 2 == 0 else ends[::-1]
    return _one(whole(rows, [learned]), whole(rows, [judged])[0])


def _capsule_outer(seed: int) -> Trial:
    """Learn from postures near the mean, and judge the half that is farther from it, by blocks of rows."""
    rows = _joined("joint_capsule")
    angles = rows[ANGLES]
    distance = np.linalg.norm((angles - angles.mean(axis=0)) / angles.std(axis=0), axis=1)
    blocks = np.array_split(np.arange(len(angles)), CAPSULE_BLOCKS + seed)
    far = np.array([distance[block].mean() for block in blocks])
    inner = [block for block, value in zip(blocks, far, strict=True) if value <= np.median(far)]
    outer = [block for block, value in zip(blocks, far, strict=True) if value > np.median(far)]
    return _one(whole(rows, inner), whole(rows, [np.concatenate(outer)])[0])


def _joined(name: str) -> Rows:
    _, episodes = described(name)
    return {signal: np.concatenate([e[signal] for e in episodes]) for signal in episodes[0]}


def _one(train: Sequence[Rows], test: Rows) -> Trial:
    return Trial({"default": train}, {"default": test})


def schunk(seed: int) -> Trial:
    """Hold out one of the five paths that are driven once; the first episode is the path that is driven 15 times."""
    _, episodes = described("schunk_arm")
    held = 1 + seed % (len(episodes) - 1)
    thin = [{name: values[::5] for name, values in episode.items()} for episode in episodes]
    return _one([episode for index, episode in enumerate(thin) if index != held], thin[held])


@cache
def kuka(trajectory: str) -> Rows:
    """Return the signals of a trajectory [rad, rad/s, N m]; the second encoders are on axes 1 to 3."""
    with np.load(folder("kuka_kr300") / f"trajectory_{trajectory}.npz") as file:
        return {
            MOTOR: np.radians(file["act_pos_mot_deg"].astype(float)),
            SECOND: np.radians(file["act_pos_se_deg"][:, :3].astype(float)),
            VELOCITY: np.radians(file["act_vel_mot_deg_per_s"].astype(float)),
            EFFORT: file["act_torque_abs_nm"].astype(float),
        }


def _kuka_rows(trajectory: str, names: Sequence[str], axes: slice) -> Rows:
    return {name: kuka(trajectory)[name][:, axes] for name in names}


def kuka_blocks(names: Sequence[str], axes: slice, seed: int) -> Trial:
    """Hold out one fifth of a trajectory, of A for even seeds, of B for odd ones."""
    rows = _kuka_rows("AB"[seed % 2], names, axes)
    count = len(next(iter(rows.values())))
    first, last = np.linspace(0, count, 6).round().astype(int)[[seed % 5, seed % 5 + 1]]
    known = [np.arange(max(0, first - GAP)), np.arange(min(count, last + GAP), count)]
    return _one(whole(rows, known), whole(rows, [np.arange(first, last)])[0])


def _kuka_other(names: Sequence[str], axes: slice, seed: int) -> Trial:
    """Learn from one trajectory and judge the other; even seeds learn from A."""
    learned, judged = ("A", "B") if seed % 2 == 0 else ("B", "A")
    return _one([_kuka_rows(learned, names, axes)], _kuka_rows(judged, names, axes))


@cache
def _pam_rows() -> Mapping[str, np.ndarray]:
    with np.load(folder("pam_arm") / "first_80_percent.npz") as file:
        episode, angles = file["episode"], file[ANGLES].astype(float)
        pressure = file[PRESSURE].astype(float)
    oldest = max(PAM_PAST)
    now = np.flatnonzero(episode[oldest:] == episode[: len(episode) - oldest]) + oldest
    past = np.concatenate([pressure[now - age] for age in PAM_PAST], axis=1)
    return {ANGLES: angles[now], PRESSURE: pressure[now], PAST: past}


def pam(seed: int) -> Trial:
    """Hold out the last fifth of the recording; seeds use different rows."""
    rows = {name: values[seed % PAM_EVERY :: PAM_EVERY] for name, values in _pam_rows().items()}
    count = len(rows[ANGLES])
    first = round(0.8 * count)
    return _one(whole(rows, np.array_split(np.arange(first), 40)), whole(rows, [np.arange(first, count)])[0])


def bodies() -> list[Body]:
    """Return every recording with its ways to hold rows out."""
    return [*_capsules(), _schunk_body(), *_kukas(), _pam_body()]


def _capsules() -> list[Body]:
    three = [tuple(b for b in BOARDS if b != lost) for lost in BOARDS]
    pairs = [(a, b) for i, a in enumerate(BOARDS) for b in BOARDS[i + 1 :]]
    masks = [BOARDS, *three, *pairs]

    def asked(given: tuple[str, ...], lost: str) -> Question:
        return Question(f"angles, {lost}", ANGLES, given, "deg", DEGREES, REAL)

    inside = [asked(BOARDS, "all boards"), *(asked(g, f"board {i} lost") for i, g in enumerate(three))]
    parts = (
        ("last fifth", capsule, inside),
        ("far end", _capsule_far, [inside[0], inside[2]]),
        ("outer postures", _capsule_outer, [inside[0], inside[2]]),
    )
    return [
        Body(f"joint_capsule, {name}", CAPSULE_UNITS, make, questions, partial(_described_settings, "joint_capsule"),
             "examples/joint_capsule.yaml", masks, (ANGLES,))
        for name, make, questions in parts
    ]  # fmt: skip


def _schunk_body() -> Body:
    questions = [
        Question("velocity from position + torque", VELOCITY, (ANGLES, EFFORT), "rad/s", 1.0, REAL),
        Question("torque from position + velocity", EFFORT, (ANGLES, VELOCITY), "N m", 1.0, REAL),
    ]
    masks = [(ANGLES, EFFORT), (ANGLES, VELOCITY)]
    config = partial(_described_settings, "schunk_arm")
    return Body("schunk_arm, a path", SCHUNK_UNITS, schunk, questions, config, "examples/schunk_arm.yaml", masks)


def _kukas() -> list[Body]:
    both, every = (MOTOR, SECOND), (MOTOR, SECOND, VELOCITY, EFFORT)
    forth = _to_second("second encoders from motors", (MOTOR,))
    back = Question("motors from second encoders", MOTOR, (SECOND,), "deg", DEGREES, REAL)
    useless = _to_second("second encoders from motors, velocities, torques", every[:1] + every[2:])
    bodies: list[Body] = []
    for place, make in (("held-out fifth", kuka_blocks), ("other trajectory", _kuka_other)):

        def body(
            name: str,
            axes: slice,
            questions: Sequence[Question],
            masks: Sequence[Sequence[str]] | None,
            outputs: Sequence[str] | None = None,
            signals: Sequence[str] = both,
            place: str = place,
            make: Callable[[Sequence[str], slice, int], Trial] = make,
        ) -> Body:
            asked = [part for question in questions for part in (question, *_by_axis(question, place))]
            words = "default" if masks else "default, structure determined"
            units = {signal: KUKA_UNITS[signal] for signal in signals}
            return Body(f"kuka_kr300, {name}{place}", units, partial(make, signals, axes), asked, _default, words,
                        masks, outputs)  # fmt: skip

        bodies += [
            body("", slice(6), [forth], [(MOTOR,)], (SECOND,)),
            body("axes 1 to 3, ", slice(3), [forth, back], [(MOTOR,), (SECOND,)]),
            body("useless inputs, ", slice(6), [useless], None, None, every),
        ]
    return [*bodies, *(_kuka_axis(axis) for axis in range(3))]


def _kuka_axis(axis: int) -> Body:
    """Return the two encoders of one axis, without the others."""
    forth = Question("second encoder from motor", SECOND, (MOTOR,), "deg", DEGREES, KUKA)
    back = Question("motor from second encoder", MOTOR, (SECOND,), "deg", DEGREES, KUKA)
    return Body(
        f"kuka_kr300, axis {axis + 1} alone, other trajectory",
        {signal: KUKA_UNITS[signal] for signal in (MOTOR, SECOND)},
        partial(_kuka_other, (MOTOR, SECOND), slice(axis, axis + 1)),
        [forth, back],
        _default,
        "default",
        [(MOTOR,), (SECOND,)],
    )


def _to_second(name: str, given: tuple[str, ...]) -> Question:
    return Question(name, SECOND, given, "deg", DEGREES, REAL)


def _by_axis(question: Question, place: str) -> list[Question]:
    """Return the question for each of three axes, if a whole trajectory is held out."""
    if place != "other trajectory":
        return []
    return [replace(question, name=f"{question.name}, axis {k + 1}", bar=KUKA, elements=(k,)) for k in range(3)]


def _default(seed: int) -> TrainConfig:
    return TrainConfig(seed=seed)


def _pam_body() -> Body:
    questions = [
        Question("angles from pressures", ANGLES, (PRESSURE,), "deg", DEGREES, REAL),
        Question("angles from pressures now and before", ANGLES, (PRESSURE, PAST), "deg", DEGREES, REAL),
    ]
    return Body("pam_arm, last fifth of the day", PAM_UNITS, pam, questions, _default, "default",
                [(PRESSURE,), (PRESSURE, PAST)], (ANGLES,))  # fmt: skip
