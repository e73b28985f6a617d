"""A CAN bus between processes over a Unix socket: a python-can interface and the server that it talks to.

`can.Bus(interface="hub", channel="musashi_arm_can0")` joins the bus that a `HubServer` of that name serves. No frame
is lost between programs that read. A program that does not read is disconnected; it never receives frames with gaps.
A packet on the socket has one or more records of one frame each, so a burst of answers needs few packets.
"""

import contextlib
import select
import socket
import struct
import time
from collections import deque
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import can

from hal.protocols.can_frames import FD_SIZES, LONGEST
from simulators.hub_server import HubServer
from simulators.hub_socket import HELLOS, IS_FD, RECORD, RECORDS, channels, is_trusted, socket_path
from simulators.wire_time import ERROR, EXTENDED, FD, REMOTE

__all__ = ["HubBus", "HubServer"]

_PATIENCE = 1.0
"""The server must admit a program, or accept a frame sent without a timeout, within this time [s]."""


class HubBus(can.BusABC):
    """Connection of one program to a bus that a `HubServer` serves.

    Frames of CAN FD pass if the server is one for them. One thread may receive while others send. There is no `fileno`,
    because frames wait in the object as well as in the socket.
    """

    def __init__(
        self,
        channel: str,
        can_filters: can.typechecking.CanFilters | None = None,
        receive_own_messages: bool = False,
        **kwargs: Any,
    ) -> None:
        """Join a bus.

        Args:
            channel: Name of the channel, or the absolute path of its socket.
            can_filters: Filters as for every python-can bus.
            receive_own_messages: Also receive the frames that this object sends, at once.
            **kwargs: `bitrate` and the like, which concern the server.

        Raises:
            can.CanInitializationError: No server has the channel.
        """
        path = socket_path(str(channel))
        self._socket, self._record = _join(str(channel), path)
        self._largest = RECORDS * self._record.size
        self._socket.setblocking(False)
        self._readable = select.poll()
        self._readable.register(self._socket, select.POLLIN)
        self._writable = select.poll()
        self._writable.register(self._socket, select.POLLOUT)
        self._waiting: deque[can.Message] = deque()
        self._own = receive_own_messages
        self._channel = str(channel)
        self.channel_info = f"hub channel {channel}"
        super().__init__(channel=channel, can_filters=can_filters, **kwargs)

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Send one frame; wait up to `timeout` [s] (1 s if not given) while the bus accepts no frame.

        Raises:
            can.CanOperationError: The server is gone or takes no frames, or the channel is not one for such frames.
        """
        if msg.is_fd and (self._record is RECORD or len(msg.data) not in FD_SIZES):
            raise can.CanOperationError(
                f"A frame of CAN FD with {len(msg.data)} bytes does not pass {self.channel_info}. Is it one of "
                f"{', '.join(map(str, FD_SIZES))}, and has the bus a data_bitrate?"
            )
        if not msg.is_fd and (msg.dlc > LONGEST or len(msg.data) > LONGEST):
            raise can.CanOperationError(f"A classic CAN frame has at most {LONGEST} bytes.")
        if not 0 <= msg.arbitration_id <= (0x1FFFFFFF if msg.is_extended_id else 0x7FF):
            raise can.CanOperationError(f"Identifier 0x{msg.arbitration_id:X} is out of range.")
        length = len(msg.data) | IS_FD if msg.is_fd else msg.dlc
        self._put(self._record.pack(message_identifier(msg), length, time.time(), bytes(msg.data)), timeout)
        if self._own:
            self._waiting.append(msg)

    def send_frames(self, frames: Iterable[tuple[int, bytes]], timeout: float | None = None) -> None:
        """Send several data frames (identifier with flags, data) in few packets; otherwise as `send`."""
        now, pack = time.time(), self._record.pack
        records = b"".join(
            [
                pack(identifier & ~FD, len(data) | (IS_FD if identifier & FD else 0), now, data)
                for identifier, data in frames
            ]
        )
        for start in range(0, len(records), self._largest):
            self._put(records[start : start + self._largest], timeout)

    def _put(self, packet: bytes, timeout: float | None) -> None:
        deadline = None
        while True:
            try:
                self._socket.send(packet, socket.MSG_NOSIGNAL)
                return
            except BlockingIOError:
                now = time.monotonic()
                deadline = deadline or now + (_PATIENCE if timeout is None else timeout)
                if now >= deadline:
                    raise can.CanOperationError(
                        f"{self.channel_info} takes no frames: is the bus overloaded?"
                    ) from None
                self._writable.poll((deadline - now) * 1e3)
            except OSError:
                raise self._gone() from None

    def receive_frames(self, timeout: float | None) -> list[tuple[int, bytes]]:
        """Return the waiting frames, as identifiers with flags and data, without filters; empty after `timeout` [s].

        This is faster than `recv`, whose `can.Message` costs more than most handlers of a frame.
        """
        frames = [(message_identifier(message), bytes(message.data)) for message in self._waiting]
        self._waiting.clear()
        packet = self._packet(0.0 if frames else timeout)
        records = self._record.iter_unpack(packet)
        return frames + [(identifier, data[: length & ~IS_FD]) for identifier, length, _, data in records]

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        if not self._waiting:
            for identifier, length, stamp, data in self._record.iter_unpack(self._packet(timeout)):
                self._waiting.append(_message(identifier, length, stamp, data, self._channel))
        return (self._waiting.popleft() if self._waiting else None), False

    def _packet(self, timeout: float | None) -> bytes:
        """Return the next packet; empty after `timeout` [s]."""
        if not self._readable.poll(None if timeout is None else timeout * 1e3):
            return b""
        try:
            packet = self._socket.recv(self._largest)
        except BlockingIOError:
            return b""
        except OSError:
            raise self._gone() from None
        if not packet:
            raise self._gone()
        return packet

    def _gone(self) -> can.CanOperationError:
        if self._is_shutdown:
            return can.CanOperationError(f"{self.channel_info} is closed.")
        return can.CanOperationError(
            f"The server of {self.channel_info} is gone, or cut this program off because it did not read."
        )

    def shutdown(self) -> None:
        """Leave the bus; a thread that waits in `recv` gets a CanOperationError."""
        super().shutdown()
        with contextlib.suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)
        self._socket.close()

    @staticmethod
    def _detect_available_configs() -> list[can.typechecking.AutoDetectedConfig]:
        return [{"interface": "hub", "channel": channel} for channel in channels()]


def _join(channel: str, path: Path) -> tuple[socket.socket, struct.Struct]:
    """Return a socket that the server has admitted, and the records of the channel."""
    link = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    link.settimeout(_PATIENCE)
    try:
        link.connect(str(path))
        if not is_trusted(link):
            reason = "a program of another user answers"
        elif (record := HELLOS.get(link.recv(64))) is not None:
            return link, record
        else:
            reason = "another program answers"
    except OSError as error:
        reason = error.strerror or "no answer"
    link.close()
    raise can.CanInitializationError(
        f"No server has the hub channel '{channel}' ({path}: {reason}). Is `gemuco simulate` running?"
    )


def message_identifier(message: can.Message) -> int:
    """Return a message's identifier with the flags EXTENDED, REMOTE and ERROR."""
    identifier = message.arbitration_id
    identifier |= EXTENDED if message.is_extended_id else 0
    identifier |= REMOTE if message.is_remote_frame else 0
    return identifier | (ERROR if message.is_error_frame else 0)


def _message(identifier: int, length: int, stamp: float, data: bytes, channel: str) -> can.Message:
    is_fd, length = bool(length & IS_FD), length & ~IS_FD
    return can.Message(
        timestamp=stamp,
        arbitration_id=identifier & 0x1FFFFFFF,
        is_extended_id=bool(identifier & EXTENDED),
        is_remote_frame=bool(identifier & REMOTE),
        is_error_frame=bool(identifier & ERROR),
        channel=channel,
        is_fd=is_fd,
        bitrate_switch=is_fd,
        dlc=length,
        data=None if identifier & REMOTE else data[:length],
    )
