"""Cost of the checks that distrust sensors and drives, per cycle of the HAL.

    python -m studies.bus.distrust

For each robot that comes along, with plausible values that flicker and set-points that move: the check of every
measured value (`hal.safety.plausibility`) and the following monitor (`hal.safety.following`), without the rest of the
cycle. The bar is 2 % of a core at the robot's rate.
"""

import time
from pathlib import Path

import numpy as np

from hal.clock import ManualClock
from hal.config import RobotConfig, load_robot
from hal.fleet import build
from hal.safety.following import Following
from hal.safety.plausibility import Plausibility

ROBOTS = Path(__file__).parents[2] / "robots"
NAMES = ("musashi_arm", "pr2_duster", "kxr_humanoid")
CYCLES = 20_000
BAR = 0.02


def cost(config: RobotConfig, cycles: int = CYCLES) -> np.ndarray:
    """Return the time of both checks in each cycle [s], shape (cycles,).

    Raises:
        AssertionError: A good value was called implausible.
    """
    _, devices = build(config, ManualClock(), {})
    check = Plausibility.of(config, config.measured, devices)
    following = Following(config, [device for device in devices if device.commands], "position")
    low, high = (np.concatenate(ends) for ends in zip(*map(config.bounds, config.measured), strict=True))
    middle = np.where(np.isfinite(low) & np.isfinite(high), 0.5 * (np.fmax(low, -1e6) + np.fmin(high, 1e6)), 1.0)
    signal = config.command.signal
    place = config.element_names(config.measured).index(config.element_names([signal])[0])
    own = slice(place, place + config.signals[signal].size)
    random = np.random.default_rng(0)
    values = middle + 1e-5 * random.standard_normal((64, len(middle)))
    valid, now, times = np.ones(len(middle), bool), 10.0, np.empty(cycles)
    for cycle in range(cycles):
        now += 1.0 / config.rates.hal
        measured, received = values[cycle % 64], np.full(len(middle), now)
        begun = time.perf_counter()
        following.problem({signal: measured[own]}, now)
        following.note(measured[own])
        check.command(measured[own])
        check.check(measured, received, valid)
        times[cycle] = time.perf_counter() - begun
    assert not check.count, check.texts()
    return times


def main() -> None:
    """Print one line per robot."""
    for name in NAMES:
        config = load_robot(ROBOTS / f"{name}.yaml")
        times = cost(config)
        share = float(np.median(times)) * config.rates.hal
        p50, p99 = 1e6 * np.percentile(times, [50, 99])
        elements = len(config.element_names(config.measured))
        print(
            f"{name:14}{elements:4} elements  {p50:5.1f} us median, {p99:6.1f} us p99, {share:.2%} of a core at "
            f"{config.rates.hal:g} Hz (bar {BAR:.0%})"
        )


if __name__ == "__main__":
    main()
