"""Asking every node of a bus who it is: reads that change nothing, paced so that they fit into an interface's queue.

Source: CiA 301, version 4.2: 7.5.2 (1000h, 1008h, 1009h, 100Ah, 1018h).
"""

import math
import time
from collections import deque
from dataclasses import dataclass

from hal.finding.book import Frame
from hal.finding.heard import Heard
from hal.finding.tap import Tap
from hal.protocols import cia301, sdo
from hal.protocols.mit import Special, special
from hal.protocols.sdo import Upload
from hal.wire.budget import frame_bits

TRIES = 2
BURST = 4
"""Requests in one go, and then a pause of twice their time on the wire: an interface's queue may have ten places."""
AFTERWARDS = 0.05
"""How long to wait [s] for the answer of a second node with the same id."""
MIT_IDS = range(1, 33)
MIT_ANSWER_TIME = 0.02
_IDENTITY = ((0x1018, 1), (0x1018, 2), (0x1018, 3), (0x1018, 4), (0x1008, 0), (0x1009, 0), (0x100A, 0))


@dataclass(slots=True)
class _Talk:
    """Questions to one node, one after the other."""

    node: int
    uploads: deque[Upload]
    sent: float = -math.inf
    tries: int = 0


def ask_all(tap: Tap, heard: Heard, patience: float) -> None:
    """First who is there, then who it is."""
    barred = heard.odrives()  # an SDO request to id n is a command to ODrive 48 + n // 32
    ids = [node for node in range(1, 128) if (cia301.SDO_REQUEST + node) >> 5 not in barred]
    _converse(tap, heard, {node: [(cia301.DEVICE_TYPE, 0)] for node in ids}, patience)
    there = [found.node for found in heard.nodes.values() if found.protocol == "CANopen" and found.objects]
    _converse(tap, heard, {node: list(_IDENTITY) for node in there}, patience)


def _converse(tap: Tap, heard: Heard, questions: dict[int, list[tuple[int, int]]], patience: float) -> None:
    """Ask many nodes at the same time, each one question at a time; whoever does not answer is asked no more."""
    talks = {node: _Talk(node, deque(Upload(*key) for key in keys)) for node, keys in questions.items()}
    pause = max(0.002, 2 * BURST * frame_bits(sdo.LENGTH) / tap.config.bitrate)
    ended = next_burst = time.monotonic()
    while talks or time.monotonic() < ended + AFTERWARDS:
        now = time.monotonic()
        if now >= next_burst:
            next_burst = now + pause
            due = [talk for talk in talks.values() if now - talk.sent > patience]
            for talk in due[:BURST]:
                _ask_again(tap, heard, talks, talk, now)
        frame = tap.receive(0.002)
        heard.note(frame)
        if frame is not None and _is_sdo_answer(frame):
            _take(tap, heard, talks, frame)
        if talks:
            ended = now


def _ask_again(tap: Tap, heard: Heard, talks: dict[int, _Talk], talk: _Talk, now: float) -> None:
    """A question that was not asked yet, or not answered in time."""
    if talk.tries == TRIES:
        del talks[talk.node]
        return
    if talk.tries:
        heard.retried.add(talk.node)
    talk.sent, talk.tries = now, talk.tries + 1
    tap.send(cia301.SDO_REQUEST + talk.node, talk.uploads[0].request)


def _is_sdo_answer(frame: Frame) -> bool:
    is_data = not (frame.is_extended or frame.is_remote or frame.is_error)
    answers = frame.identifier & 0x780 == cia301.SDO_ANSWER and frame.identifier & 0x7F != 0
    return is_data and answers and len(frame.data) == sdo.LENGTH


def _take(tap: Tap, heard: Heard, talks: dict[int, _Talk], frame: Frame) -> None:
    """An SDO answer has come."""
    node = frame.identifier & 0x7F
    found = heard.found("CANopen", node)
    talk = talks.get(node)
    if talk is None or not talk.uploads[0].answer(frame.data):
        command, *key = sdo.HEAD.unpack_from(frame.data)
        found.is_doubled |= command >> 5 == sdo.UPLOAD and tuple(key) in found.objects and node not in heard.retried
        return
    upload = talk.uploads[0]
    if upload.is_done:
        if upload.value is not None:
            found.objects[upload.index, upload.subindex] = upload.value
        talk.uploads.popleft()
        if not talk.uploads:
            del talks[node]
            return
    talk.sent, talk.tries = time.monotonic(), 1
    tap.send(cia301.SDO_REQUEST + node, talk.uploads[0].request)


def look_for_mit(tap: Tap, heard: Heard, patience: float) -> None:
    """End the motor mode of every possible MIT drive; one that is there answers with its id in the first byte."""
    before = set(heard.counts)
    odrives = heard.odrives()  # an identifier below 33 is a command to ODrive 0 or 1
    asked: list[int] = []
    for node in MIT_IDS:
        if node >> 5 in odrives:
            continue
        tap.send(node, special(Special.EXIT))
        asked.append(node)
        _take_mit(tap, heard, asked, before, MIT_ANSWER_TIME)
    _take_mit(tap, heard, asked, before, patience)


def _take_mit(tap: Tap, heard: Heard, asked: list[int], before: set[int], duration: float) -> None:
    """Whose answers come within `duration` [s]; a late one may be of any drive that was asked."""
    deadline = time.monotonic() + duration
    while (remaining := deadline - time.monotonic()) > 0:
        frame = tap.receive(remaining)
        if frame is None or frame.is_extended or frame.is_error or frame.identifier in before:
            continue
        if len(frame.data) not in (6, 7, 8):
            continue
        first = frame.data[0]  # the id, or with Damiao's state above its lower four bits
        likely = [node for node in reversed(asked) if first == node or first & 0x0F == node & 0x0F]
        if likely:
            node = first if first in likely else likely[0]
            heard.found("MIT", node).state = f"answers on {frame.identifier:03X}h"
