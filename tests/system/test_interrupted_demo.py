"""The demo, interrupted while its processes start. Away from the other stack, or two arms would share this machine."""

import os
import signal
import subprocess
from pathlib import Path

import pytest
from arm_stack import PATIENCE, Stack, eventually

from services.process.supervisor import gemuco_command


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupted_demo_leaves_no_process(tmp_path: Path, number: signal.Signals) -> None:
    stack = Stack(tmp_path, f"demo_{number.name.lower()}_{os.getpid()}")
    log = tmp_path / "demo.log"
    with log.open("w") as sink:
        demo = subprocess.Popen(
            gemuco_command("demo", str(stack.file)), cwd=tmp_path, stdout=sink, stderr=sink, start_new_session=True
        )
    try:
        eventually(lambda: "Processes:" in log.read_text() or demo.poll() is not None)
        line = next((line for line in log.read_text().splitlines() if line.startswith("Processes:")), None)
        assert line is not None, log.read_text()
        pids = [int(word.strip(",")) for word in line.split() if word.strip(",").isdigit()]
        assert len(pids) >= 3
        demo.send_signal(number)
        assert demo.wait(PATIENCE) != 0
        eventually(lambda: not any(Path(f"/proc/{pid}").exists() for pid in pids))
    finally:
        demo.kill()
        demo.wait()
