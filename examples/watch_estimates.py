"""A remote client in ten lines: what of the arm is measured, what is estimated. Needs `gemuco hal` and `gemuco serve`.

python examples/watch_estimates.py [ROBOT] [SECONDS]
"""

import sys
import time

from services.client import Client

robot = sys.argv[1] if len(sys.argv) > 1 else "musashi_arm"
end = time.monotonic() + float(sys.argv[2] if len(sys.argv) > 2 else 10)
with Client(robot) as arm:
    while time.monotonic() < end:
        now = arm.estimate(timeout=2.0)
        if now is None:
            sys.exit(f"No fresh estimate of '{robot}' within 2 s. Is `gemuco serve {robot}` running?")
        angles = " ".join(f"{angle:+.3f}" for angle in now.values["joint_position"])
        print(f"{angles} rad, {now.method['joint_position']} from {now.mask['joint_position'] or 'sensors'}")
        time.sleep(0.5)
