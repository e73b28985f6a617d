"""Order of messages: a message that was heard before, or is older than one that was heard, is not fresh.

A network may deliver a message twice or late, and anyone may record one and send it again. Per sender (`boot`) number
and stamp of its messages grow. A message of which neither is newer is refused and counted, never used.
"""

import math
from collections import OrderedDict

from services.wire.records import Message

SENDERS = 16
"""The newest numbers of this many senders are kept."""
CLOCK_WAS_SET = 2.0
"""A new sender whose clock is behind that of the one before is believed after this silence [s]: its clock was set."""


class Order:
    """Numbers and stamps heard last on one key, by sender.

    Attributes:
        counters: Numbers of messages that came `repeated` or `late`.
        text: Sentence about the last of them; empty without one.
    """

    def __init__(self) -> None:
        self.counters = {"repeated": 0, "late": 0}
        self.text = ""
        self._heard: OrderedDict[int, tuple[int, int]] = OrderedDict()

    def problem(self, message: Message) -> str:
        """Note a message, and return the reason in a sentence if it is not newer than the sender's last one, else "".

        A message without number and stamp is always in order, because nothing says otherwise.
        """
        seq, stamp, boot = message.seq, message.stamp_ns, message.boot
        if not seq and not stamp:
            return ""
        before = self._heard.get(boot)
        if before is not None and seq <= before[0] and stamp <= before[1]:
            is_same = (seq, stamp) == before
            return self._refuse("repeated" if is_same else "late", f"number {seq} after number {before[0]}", message)
        self._heard[boot] = (seq, stamp)
        self._heard.move_to_end(boot)
        if len(self._heard) > SENDERS:
            self._heard.popitem(last=False)
        return ""

    def _refuse(self, counter: str, what: str, message: Message) -> str:
        self.counters[counter] += 1
        self.text = (
            f"A {message.TYPE} came {'twice' if counter == 'repeated' else 'late'} ({what}) and was not used. "
            "Does the network repeat messages, or does someone play a recording?"
        )
        return self.text


class StreamOrder(Order):
    """Order of the messages of a key with one sender, which another may follow after a restart."""

    def __init__(self) -> None:
        super().__init__()
        self._boot, self._stamp, self._at = 0, 0, -math.inf

    def problem_at(self, message: Message, now: float) -> str:
        """Note a message that arrives at `now` [monotonic s]; as `problem`, and for an old message of another run."""
        stamp = message.stamp_ns
        is_other = message.boot != self._boot
        if is_other and 0 < stamp <= self._stamp and now - self._at < CLOCK_WAS_SET:
            age = (self._stamp - stamp) * 1e-9
            return self._refuse("late", f"from another run, {age:.3g} s older than the newest", message)
        if text := self.problem(message):
            return text
        self._boot, self._at = message.boot, now
        if stamp:
            self._stamp = stamp
        return ""
