"""Programs of other authors, in the environment that `make test-ros2` fills."""

import os
import subprocess
from pathlib import Path

ROOT = Path(__file__).parents[2]
OTHERS = Path(os.environ.get("ROS2_ENVIRONMENT", ROOT / "build" / "ros2"))
"""This folder has the environment."""
SCRIPT = Path(__file__).parent / "other_hands.py"


class OtherHands:
    """Programs of other authors."""

    def script(self, *arguments: object) -> "subprocess.Popen[str]":
        command = [str(OTHERS / "bin" / "python"), str(SCRIPT), *map(str, arguments)]
        return subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=OTHERS)

    def cli(self, port: int, *arguments: str, timeout: float = 1.0) -> str:
        """Run `zenoh-ros2` for the router at this port, with this time for discovery [s]."""
        options = ("--no-daemon", "--timeout", str(timeout), "--router", f"127.0.0.1:{port}", "--domain-id", "0")
        command = [str(OTHERS / "bin" / "zenoh-ros2"), *options, *arguments]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout
