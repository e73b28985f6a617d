"""Move the simulated arm behind the robot contract, without a bus and faster than real time.

python examples/move_without_bus.py
"""

from itertools import islice
from pathlib import Path

from hal import load_object, load_robot

config = load_robot(Path(__file__).parents[1] / "robots" / "musashi_arm.yaml")
motion = load_object(config.collect["motion"])(config, seed=0)
with load_object(config.simulator, "simulator", ("direct",)).direct(config, "geometric", seed=0) as robot:
    deadline = robot.clock.monotonic()
    sample, _ = robot.cycle()
    robot.enable()
    for lengths, duration in islice(motion, 200):
        end = deadline + duration
        while deadline < end:
            if robot.mode in ("hold", "follow"):
                robot.command(lengths, sample.cycle)
            sample, applied = robot.cycle()
            deadline += robot.period
            robot.clock.sleep_until(deadline)
print(f"{deadline:.1f} s, mode {applied.mode}, joints {sample.values['joint_position'].round(3)} rad")
