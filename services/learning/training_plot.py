"""Picture of a training."""

from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt

from gemuco.learning.history import History


def plot(history: History, title: str, path: Path) -> None:
    """Draw the learning curve into a PNG."""
    figure, axis = plt.subplots(figsize=(8, 4.5), layout="constrained")
    axis.semilogy(history.train, color="tab:blue", label="training data, while learned")
    axis.semilogy(history.held_out, color="tab:orange", label="held-out data")
    axis.axvline(history.best_epoch, color="0.6", linestyle=":", label=f"kept: {history.best:.4g} held out")
    if history.resumed:
        axis.axvline(history.resumed, color="0.8", label="went on after an interruption")
    axis.set_title(title)
    axis.set_xlabel("epoch")
    axis.set_ylabel("loss [standard deviations squared]")
    axis.legend()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)
    plt.close(figure)
