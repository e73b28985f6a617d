"""Read a sensor sample with zenoh and msgpack alone; any language that has both can do this.

python examples/read_wire.py [ROBOT [ENDPOINT]], such as musashi_arm tcp/127.11.74.180:32306. On the robot's machine
`gemuco endpoint ROBOT hal` prints the endpoint, and this program asks it if none is given.
"""

import json
import subprocess
import sys

import msgpack
import numpy as np
import zenoh

robot, *given = sys.argv[1:] or ["musashi_arm"]
command = [sys.executable, "-m", "services.cli", "endpoint", robot, "hal"]  # as `gemuco endpoint`
endpoint = given[0] if given else subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()
config = zenoh.Config()
config.insert_json5("connect/endpoints", json.dumps([endpoint]))
config.insert_json5("scouting/multicast/enabled", "false")
with zenoh.open(config) as session, session.declare_subscriber(f"gemuco/{robot}/hal/sample") as samples:
    body = msgpack.unpackb(samples.recv().payload.to_bytes())
values, valid = np.frombuffer(body["values"], "<f8"), np.frombuffer(body["valid"], "?")
start = 0
for signal, count in body["elements"].items():
    print(signal, values[start : start + count].round(4), valid[start : start + count])
    start += count
