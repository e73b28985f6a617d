"""Publish the position of a marker, as the program of a real robot's camera does; `gemuco serve` uses it.

python examples/publish_marker.py [ROBOT] [SECONDS]
"""

import sys
import time

import numpy as np

from services import Sample, Service

robot = sys.argv[1] if len(sys.argv) > 1 else "pr2_duster"
end = time.monotonic() + float(sys.argv[2] if len(sys.argv) > 2 else 10)
frame = 0
with Service(robot, "vision") as camera:
    publish = camera.publisher(f"gemuco/{robot}/vision/sample", Sample).put
    while time.monotonic() < end:
        taken_ns, taken = time.time_ns(), time.monotonic()
        marker = {"tool_tip_position": np.array([0.6, -0.2, 0.8])}  # your detector's result [m]; NaN without a result
        frame += 1
        age = {name: np.full(value.shape, time.monotonic() - taken) for name, value in marker.items()}
        valid = {name: np.isfinite(value) for name, value in marker.items()}
        publish(
            Sample(stamp_ns=taken_ns, cycle=frame, source="camera", complete=True, values=marker, age=age, valid=valid)
        )
        time.sleep(1 / 30)
