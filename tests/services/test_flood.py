"""One client floods the robot with commands as fast as it can; the holder goes on commanding, and is followed."""

import os
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from small_arm import Processes, eventually

FLOOD = """
import sys, time
import numpy as np
from services.wire import keys, messages
from services.wire.session import open_session

robot, seconds = sys.argv[1], float(sys.argv[2])
session = open_session(robot, "client")
data = [
    messages.encode(messages.Command(
        signal="muscle_length", values=np.zeros(2), cycle=1, hal_boot=1, boot=boot, seq=7, stamp_ns=time.time_ns()
    ))
    for boot in range(100, 100 + int(sys.argv[3]))
]
publisher = session.declare_publisher(keys.command(robot))
print("ready", flush=True)
sys.stdin.readline()
end, sent = time.monotonic() + seconds, 0
while time.monotonic() < end:
    for one in data:
        publisher.put(one)
    sent += len(data)
print(sent, flush=True)
"""


@pytest.mark.long
@pytest.mark.parametrize("senders", [1, 40])
def test_a_flood_of_commands_stops_neither_the_cycle_nor_the_holder(tmp_path: Path, senders: int) -> None:
    with Processes(f"flooded_{os.getpid()}", tmp_path) as arm:
        eventually(lambda: arm.mode() == "off")
        flooder = subprocess.Popen(
            ["nice", "-n", "19", sys.executable, "-c", FLOOD, arm.robot, "2.0", str(senders)],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
        )  # fmt: skip
        assert flooder.stdin is not None
        assert flooder.stdout is not None
        assert flooder.stdout.readline().strip() == "ready"
        calm = arm.client.status("hal", timeout=5.0)
        assert calm is not None
        arm.client.enable()
        eventually(lambda: arm.mode() == "hold")
        start, modes = arm.client.next_sample(), Counter[str]()
        assert start is not None
        begun = time.monotonic()
        flooder.stdin.write("go\n")
        flooder.stdin.flush()
        while time.monotonic() - begun < 2.5:
            sample = arm.client.next_sample()
            assert sample is not None
            arm.client.command("muscle_length", np.array([0.01, -0.01]), sample)
            if time.monotonic() - begun > 0.5:
                modes[arm.mode()] += 1
        sent = int(flooder.stdout.readline())
        flooder.wait(10.0)
        status = arm.client.status("hal", timeout=5.0)
        assert status is not None
        commands = status.facts["commands"]
        assert sent > 2000
        assert not set(modes) & {"fault", "stopping", "off"}, (modes, status.text)
        assert modes["follow"] > 0.8 * modes.total(), (modes, status.text)  # a busy machine delays the client itself
        assert commands["accepted"] > 100, commands
        assert commands["flooded"] > 0.5 * sent or commands["refused"] + commands["repeated"] > 100, (sent, commands)
        usual = min(calm.loops["hal"]["rate"], status.loops["hal"]["rate_wanted"])  # lower on a busy machine
        assert status.loops["hal"]["rate"] > 0.9 * usual, (calm.loops, status.loops)
        print(sent, dict(modes), commands, status.loops["hal"])
