"""Picture of the front page: a recorded joint angle while its encoder is silent for some seconds.

    gemuco record ROBOT run.mcap        # meanwhile: gemuco query ROBOT fault "sensor_silent elbow_pitch_encoder"
    python -m studies.picture run.mcap  # writes docs/images/lost_sensor.gif

All motion is from the recording: the estimates of the model service, and the truth of the simulator.
"""

import argparse
import json
from dataclasses import dataclass
from pathlib import Path

import matplotlib

matplotlib.use("agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.patches import Wedge
from mcap.reader import make_reader
from PIL import Image

SIGNAL, ELEMENT, UPPER = "joint_position", "elbow_pitch", "shoulder_pitch"
BEFORE, AFTER = 3.0, 3.0
"""Time shown before the loss and after the recovery [s]."""
SPEED, FRAMES_PER_SECOND = 2.0, 12.0
COLOURS = 48
MEASURED, ESTIMATED, TRUTH, LOST, INK = "#1f6fc4", "#f08c00", "#101418", "#d03030", "#20262e"
UPPER_LENGTH, FOREARM_LENGTH = 0.30, 0.34
"""Lengths of the drawn links, in units of the drawing."""


@dataclass(frozen=True, slots=True)
class Run:
    """One element of a recording on the time of the model's estimates.

    Attributes:
        time: Time since the loss [s], shape (n,).
        value: Published value [rad], shape (n,).
        std: Published standard deviation [rad], shape (n,); 0 while measured.
        is_estimated: Whether the value was estimated, shape (n,).
        truth: True value from the simulator [rad], shape (n,).
        upper: True angle of the link above [rad], shape (n,).
    """

    time: np.ndarray
    value: np.ndarray
    std: np.ndarray
    is_estimated: np.ndarray
    truth: np.ndarray
    upper: np.ndarray


def read(path: Path) -> Run:
    """Return the recorded element around the first loss of at least one second."""
    estimates: list[tuple[float, float, float, bool]] = []
    truths: list[tuple[float, float, float]] = []
    with path.open("rb") as file:
        for _, channel, message in make_reader(file).iter_messages():
            if channel.topic.endswith("/model/estimate"):
                body = json.loads(message.data)
                value, std, flag = (body[key][SIGNAL].get(ELEMENT) for key in ("values", "std", "estimated"))
                if value is not None:
                    estimates.append((1e-9 * body["stamp_ns"], value, std or 0.0, flag))
            elif channel.topic.endswith("/simulator/truth"):
                body = json.loads(message.data)
                angles = body["values"][SIGNAL]
                truths.append((1e-9 * body["stamp_ns"], angles[ELEMENT], angles[UPPER]))
    time, value, std, flag = (np.array(column) for column in zip(*estimates, strict=True))
    true_time, truth, upper = (np.array(column) for column in zip(*truths, strict=True))
    start, end = lost_period(time, flag.astype(bool))
    shown = (time > start - BEFORE) & (time < end + AFTER)
    return Run(
        time=time[shown] - start,
        value=value[shown],
        std=std[shown],
        is_estimated=flag[shown].astype(bool),
        truth=np.interp(time[shown], true_time, truth),
        upper=np.interp(time[shown], true_time, upper),
    )


def lost_period(time: np.ndarray, is_estimated: np.ndarray) -> tuple[float, float]:
    """Return when the first loss of at least one second begins and ends [s]."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], is_estimated, [False]]).astype(int)))
    for first, after in edges.reshape(-1, 2):
        if time[after - 1] - time[first] >= 1.0:
            return float(time[first]), float(time[after - 1])
    raise SystemExit(f"'{SIGNAL}.{ELEMENT}' is never estimated for a second in this recording.")


def draw_arm(axes: Axes, run: Run, index: int) -> None:
    """Draw the arm from the side: the true links in grey, the published elbow angle in colour."""
    axes.set(xlim=(-0.42, 0.66), ylim=(-0.72, 0.26), aspect="equal")
    axes.axis("off")
    shoulder, angle = np.array([0.0, 0.0]), -run.upper[index] - np.pi / 2
    elbow = shoulder + UPPER_LENGTH * np.array([np.cos(angle), np.sin(angle)])

    def hand(elbow_angle: float) -> np.ndarray:
        return elbow + FOREARM_LENGTH * np.array([np.cos(angle - elbow_angle), np.sin(angle - elbow_angle)])

    true_hand, shown_hand = hand(run.truth[index]), hand(run.value[index])
    for begin, end in ((shoulder, elbow), (elbow, true_hand)):
        axes.plot(*zip(begin, end, strict=True), color="#d5dae0", lw=22, solid_capstyle="round")
    is_estimated = bool(run.is_estimated[index])
    colour = ESTIMATED if is_estimated else MEASURED
    if is_estimated:
        centre, spread = np.degrees(angle - run.value[index]), np.degrees(run.std[index])
        fan = Wedge(
            tuple(elbow),
            FOREARM_LENGTH + 0.05,
            centre - 2.0 * spread,
            centre + 2.0 * spread,
            color=ESTIMATED,
            alpha=0.3,
            lw=0,
        )
        axes.add_patch(fan)
    axes.plot(*zip(elbow, shown_hand, strict=True), color=colour, lw=4, solid_capstyle="round")
    axes.plot(*shoulder, "o", color=INK, ms=9)
    axes.plot(*elbow, "o", color=LOST if is_estimated else MEASURED, ms=13)
    if is_estimated:
        axes.plot(*elbow, "x", color="white", ms=7, mew=2.5)
    text = "encoder lost: estimated" if is_estimated else "measured"
    axes.text(0.12, 0.17, text, color=colour, fontsize=14, weight="bold", ha="center")
    axes.text(0.12, -0.71, "grey: the real arm", color="#7b8590", fontsize=10, ha="center")


def draw_signal(axes: Axes, run: Run, index: int) -> None:
    """Draw the published signal until now, with the truth and a band of two standard deviations."""
    time, lost = run.time[: index + 1], run.is_estimated[: index + 1]
    bottom, top = run.truth.min() - 0.12, run.truth.max() + 0.3
    axes.set(xlim=(run.time[0], run.time[-1]), ylim=(bottom, top))
    axes.set_xlabel("time since the encoder fell silent [s]", color=INK)
    axes.set_ylabel("elbow angle [rad]", color=INK)
    axes.spines[["top", "right"]].set_visible(False)
    end = run.time[run.is_estimated][-1]
    if time[-1] >= 0.0:
        axes.axvspan(0.0, min(end, time[-1]), color=LOST, alpha=0.08, lw=0)
        axes.text(0.15, top - 0.06, "no encoder", color=LOST, fontsize=11, va="top")
    if time[-1] > end:
        axes.text(run.time[-1], top - 0.06, "measured again", color=MEASURED, fontsize=11, va="top", ha="right")
    value = run.value[: index + 1]
    low, high = (np.where(lost, value + sign * run.std[: index + 1], np.nan) for sign in (-2.0, 2.0))
    axes.fill_between(time, low, high, color=ESTIMATED, alpha=0.3, lw=0, label="± two standard deviations")
    axes.plot(time, np.where(lost, np.nan, value), color=MEASURED, lw=2.5, label="measured")
    axes.plot(time, np.where(lost, value, np.nan), color=ESTIMATED, lw=2.5, label="estimated, marked as estimated")
    axes.plot(time, run.truth[: index + 1], color=TRUTH, lw=1.2, ls=":", label="truth, hidden from the model")
    handles, labels = axes.get_legend_handles_labels()
    order = [1, 2, 0, 3]
    axes.legend(
        [handles[i] for i in order], [labels[i] for i in order],
        loc="upper center", bbox_to_anchor=(0.5, 1.22), ncols=2, frameon=False, fontsize=9.5,
    )  # fmt: skip


def frame(run: Run, now: float) -> Image.Image:
    """Return the picture at a moment [s]."""
    index = int(np.searchsorted(run.time, now, side="right")) - 1
    figure = plt.figure(figsize=(9.0, 3.6), dpi=100, facecolor="white")
    left, right = figure.add_axes((0.0, 0.02, 0.34, 0.96)), figure.add_axes((0.42, 0.16, 0.56, 0.66))
    draw_arm(left, run, max(index, 0))
    draw_signal(right, run, max(index, 0))
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    picture = Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB")
    plt.close(figure)
    return picture


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording", type=Path)
    parser.add_argument("--out", type=Path, default=Path("docs/images/lost_sensor.gif"))
    options = parser.parse_args()
    run = read(options.recording)
    moments = np.arange(run.time[0], run.time[-1], SPEED / FRAMES_PER_SECOND)
    pictures = [frame(run, moment) for moment in moments]
    palette = pictures[len(pictures) // 2].quantize(COLOURS)
    pictures = [picture.quantize(palette=palette, dither=Image.Dither.NONE) for picture in pictures]
    pause = [round(1e3 / FRAMES_PER_SECOND)] * (len(pictures) - 1) + [2000]
    pictures[0].save(options.out, save_all=True, append_images=pictures[1:], duration=pause, loop=0, optimize=True)
    lost = run.is_estimated
    error = np.abs(run.value - run.truth)[lost]
    print(f"{options.out}: {len(pictures)} frames, {options.out.stat().st_size / 1e6:.2f} MB; without the encoder the")
    print(f"estimate is wrong by {error.mean():.3f} rad on average and {error.max():.3f} rad at worst,")
    print(f"its mean standard deviation is {run.std[lost].mean():.3f} rad")


if __name__ == "__main__":
    main()
