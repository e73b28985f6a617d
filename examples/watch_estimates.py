"""Print all estimates and their masks until the robot ends: a remote client in ten lines.

python examples/watch_estimates.py ROBOT [tcp/ROUTER:7447 or a role file]
"""

import sys
import time

from services import Client, ServiceError

try:
    with Client(sys.argv[1], sys.argv[2:]) as robot:
        for now in robot.estimates():
            for signal, values in now.values.items():
                print(f"{signal} {values.round(3)} {now.method[signal]} {now.mask[signal]}", flush=True)
            time.sleep(0.5)  # a slow client receives the newest estimate
except ServiceError as error:
    sys.exit(str(error))
