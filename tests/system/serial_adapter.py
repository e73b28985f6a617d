"""A serial CAN adapter (slcan) played over a pseudo-terminal, so that a kernel's controller states are real.

The kernel's slcan driver takes what an adapter reports of its controller (`s` lines: state and error counters; `e`
lines: errors), runs the state machine of can_dev on it, and sends the error frames that any controller's driver sends.
Frames pass between the serial line and another interface, on which the nodes are.
"""

import contextlib
import os
import pty
import select
import subprocess
import threading
import time
import tty
from pathlib import Path

import can
from kernel_robot import PATIENCE, ip


class SerialAdapter:
    """The adapter: interface `name` at the computer's side, the wire at the other."""

    def __init__(self, name: str, wire: str) -> None:
        self.name = name
        self._wire = can.Bus(interface="socketcan", channel=wire)
        self._is_off = False
        self._plug_in()

    def _plug_in(self) -> None:
        self._line, terminal = pty.openpty()
        tty.setraw(terminal)
        self._attached = subprocess.Popen(["slcand", "-F", "-o", "-s8", os.ttyname(terminal), self.name])
        deadline = time.monotonic() + PATIENCE
        while not Path("/sys/class/net", self.name).exists():
            assert time.monotonic() < deadline, "slcand made no interface"
            time.sleep(0.05)
        os.close(terminal)
        self._closing = threading.Event()
        self._threads = [threading.Thread(target=job) for job in (self._to_wire, self._from_wire)]
        for thread in self._threads:
            thread.start()
        ip("link", "set", self.name, "up")

    def unplug(self) -> None:
        """The serial device vanishes, and with it the interface."""
        self._closing.set()
        for thread in self._threads:
            thread.join()
        self._attached.terminate()
        self._attached.wait(20)
        os.close(self._line)

    def plug_in_again(self) -> None:
        self._is_off = False
        self._plug_in()

    def close(self) -> None:
        self.unplug()
        self._wire.shutdown()

    def report(self, line: str) -> None:
        """Tell the kernel: `sw096000` is a state with both error counters, `e1a` a missing acknowledge."""
        os.write(self._line, line.encode() + b"\r")

    def leave_bus(self) -> None:
        """Bus-off: nothing passes any more."""
        self._is_off = True
        self.report("sb255000")

    def join_bus(self) -> None:
        self._is_off = False
        self.report("sa000000")

    def kernel_state(self) -> str:
        """What the kernel holds of the controller, as in `ERROR-PASSIVE`."""
        answer = subprocess.run(["ip", "-d", "link", "show", self.name], capture_output=True, text=True).stdout.split()
        return answer[answer.index("can", answer.index("link/can")) + 2]

    def _to_wire(self) -> None:
        rest = b""
        while not self._closing.is_set():
            if not select.select([self._line], [], [], 0.05)[0]:
                continue
            try:
                rest += os.read(self._line, 4096)
            except OSError:
                return
            *lines, rest = rest.split(b"\r")
            for line in lines:
                if line[:1] == b"t" and not self._is_off:
                    size = int(line[4:5])
                    data = bytes.fromhex(line[5 : 5 + 2 * size].decode())
                    with contextlib.suppress(can.CanError):
                        self._wire.send(
                            can.Message(arbitration_id=int(line[1:4], 16), data=data, is_extended_id=False), 0.1
                        )

    def _from_wire(self) -> None:
        while not self._closing.is_set():
            frame = self._wire.recv(0.05)
            if frame is None or self._is_off or frame.is_extended_id or frame.is_error_frame:
                continue
            data = bytes(frame.data).hex().upper()
            with contextlib.suppress(OSError):
                os.write(self._line, f"t{frame.arbitration_id:03X}{len(frame.data)}{data}\r".encode())
