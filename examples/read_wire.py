"""Read a sensor sample with zenoh and msgpack alone; any language that has both can do this.

python examples/read_wire.py tcp/127.0.0.1:PORT [ROBOT]
"""

import json
import sys

import msgpack
import numpy as np
import zenoh

endpoint, robot = sys.argv[1], sys.argv[2] if len(sys.argv) > 2 else "musashi_arm"
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
