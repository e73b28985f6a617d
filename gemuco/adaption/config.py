"""Settings of the online update (paper, II-F)."""

from dataclasses import dataclass

from gemuco.errors import SchemaError, whole_number
from gemuco.optimiser import OPTIMISERS

WHAT = ("weights", "bias", "both", "bias_then_weights")
METHODS = ("ekf", "gauss_newton", "gradient")


@dataclass(frozen=True, slots=True)
class UpdateConfig:
    """Settings of the online update.

    Attributes:
        what: `weights`, `bias`, `both` at once by gradient, or `bias_then_weights`: W moves only while p is settled.
            Without parametric bias this is the same as `weights`.
        bias_method: `ekf`, `gauss_newton` (both from the first sample), or `gradient`, the paper's.
        window: Maximum number of samples kept; the oldest are dropped.
        minimum: Samples needed before the first gradient step.
        batch: Samples per gradient step, drawn from window, constraints and replay; each under every mask it covers.
        steps: Gradient steps for each new sample.
        repeats: In a window of few samples a new sample is followed by up to this many times `steps`; 1: never by more.
        rate: Learning rate of W.
        bias_rate: Learning rate of p, for `gradient` and `both`.
        optimiser: `adam` or `sgd` (with momentum 0.9), for W and p.
        replay: Weight of the training data, in window samples, each under the p of its own condition. So a young window
            cannot pull W far from the training data, and a full one outweighs them.
        held_out: k: every k-th sample only judges W, which goes back to the best one when its error there grows; 0: all
            samples are learned from, and W never goes back.
        seed: Seed of the draws.
    """

    what: str = "bias_then_weights"
    bias_method: str = "ekf"
    window: int = 6000
    minimum: int = 10
    batch: int = 100
    steps: int = 3
    repeats: int = 30
    rate: float = 1e-4
    bias_rate: float = 0.02
    optimiser: str = "adam"
    replay: int = 300
    held_out: int = 5
    seed: int = 0

    def __post_init__(self) -> None:
        for name, known in (("what", WHAT), ("bias_method", METHODS), ("optimiser", OPTIMISERS)):
            if getattr(self, name) not in known:
                raise SchemaError(f"{name} '{getattr(self, name)}' is not known. Known: {', '.join(known)}.")
        for name in ("window", "minimum", "batch", "repeats", "steps", "replay", "held_out"):
            least = 0 if name in ("steps", "replay", "held_out") else 1
            whole_number(f"Update: {name}", getattr(self, name), least)
        whole_number("Update: seed", self.seed, 0)
        for name in ("rate", "bias_rate"):
            if not 0.0 <= getattr(self, name) < float("inf"):
                raise SchemaError(f"Update: {name} is {getattr(self, name)}; it must be 0 or a positive number.")
        if self.held_out == 1:
            raise SchemaError("held_out 1 holds every sample out and leaves none to learn from; use 0 or 2 and more.")
