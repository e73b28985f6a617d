"""Random motion of every variant of the Musashi-like arm: how safe, how far from the designer's model, how fast.

    python -m studies.accuracy.arm_variants [--minutes 10] [--seeds 5]

Runs the direct backend under the real Robot cycle, one line per arm. Speed is simulated time over process time.
"""

import argparse
import time
from pathlib import Path

import numpy as np

from hal.config import RobotConfig, load_robot
from simulators.robots.musashi_arm import gravity_torque, random_motion, simulator
from simulators.robots.musashi_arm.model import chain, designed_elastic, designed_paths
from simulators.robots.musashi_arm.motion import SETTLE

ROBOT = Path(__file__).parents[2] / "robots" / "musashi_arm.yaml"


def designed_posture(length: np.ndarray, near: np.ndarray) -> np.ndarray:
    """Joint positions [rad], shape (5,), at which the designer's model rests on wires of `length` [m] (10,)."""
    elastic, position = designed_elastic(), near
    for _ in range(40):
        path, arms = designed_paths().solve(position)
        tension = elastic.tension(path - length)
        stiffness = (arms.T * elastic.stiffness(tension)) @ arms
        torque = -arms.T @ tension - gravity_torque(position)
        position = position + np.clip(np.linalg.solve(stiffness, torque), -0.1, 0.1)
    return position


def run(config: RobotConfig, variant: str, seed: int, minutes: float) -> str:
    """Move one arm at random; one line of what was measured."""
    robot = simulator.direct(config, variant, seed)
    motion = random_motion(config, seed)
    history = np.empty((round(minutes * 60.0 / robot.period), 15))
    postures = []
    begun = time.process_time()
    with robot:
        robot.cycle()
        robot.enable()
        tick, rest, is_rest = robot.clock.monotonic(), 0.0, False
        command = np.empty(0)
        for turn in range(len(history)):
            tick += robot.period
            robot.clock.sleep_until(tick)
            sample, _ = robot.cycle()
            history[turn, :5] = sample.values["joint_position"]
            history[turn, 5:] = sample.values["muscle_tension"]
            if robot.mode == "fault":
                return f"{variant:10} {seed:4}  {robot.fault_text}"
            if rest < 1e-9:
                if is_rest:
                    postures.append((command, sample.values["joint_position"]))
                command, duration = next(motion)
                rest, is_rest = rest + duration, duration == SETTLE
            rest -= robot.period
            if robot.mode in ("hold", "follow"):
                robot.command(command, sample.cycle)
    speed = minutes * 60.0 / (time.process_time() - begun)
    missed = [np.linalg.norm(designed_posture(command, reached) - reached) for command, reached in postures]
    position, tension = history[:, :5], history[:, 5:]
    beyond = max((chain().low - position).max(), (position - chain().high).max())
    soft = 100.0 * np.mean(tension.max(axis=1) > (config.limits["muscle_tension"].soft_high or np.inf))
    return (
        f"{variant:10} {seed:4} {len(missed):9} {np.mean(missed):13.3f} {np.percentile(missed, 95):8.3f}"
        f" {tension.max():9.0f} {soft:9.2f} {max(beyond, 0.0):11.3f} {speed:12.1f}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=10.0, help="simulated minutes per arm")
    parser.add_argument("--seeds", type=int, default=5, help="how many seeds of each variant")
    arguments = parser.parse_args()
    config = load_robot(ROBOT)
    print(
        "missed: between the posture that the designer's model commands and the one reached; soft: share of time over\n"
        "soft_high; stops: how far a joint went into its mechanical stops\n"
        "variant    seed  postures  missed [rad]      p95  peak [N]  soft [%]  stops [rad]  x real time"
    )
    for variant in simulator.variants:
        for seed in range(arguments.seeds):
            print(run(config, variant, seed, arguments.minutes), flush=True)


if __name__ == "__main__":
    main()
