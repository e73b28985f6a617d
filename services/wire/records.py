"""Typed records of all messages between the processes; `services.wire.messages` encodes and decodes them."""

from typing import TYPE_CHECKING, Any, ClassVar, Self

import msgspec
import numpy as np
from msgspec.structs import force_setattr
from numpy import frombuffer
from numpy.typing import NDArray

from hal.by_signal import KEPT, LONGEST, NOTHING, BySignal, Elements, Numbers, Truths

__all__ = [
    "Anomaly", "Applied", "Array", "Command", "Elements", "Estimates", "Holder", "Message", "Numbers", "OfSignals",
    "Sample", "Status", "Target", "Truths", "Update",
]  # fmt: skip

Array = NDArray[np.float64]
if TYPE_CHECKING:
    import hal

    WireElements = Elements
    WireNumbers = Numbers
    WireTruths = Truths
else:  # the decoder leaves them as bytes; `OfSignals` reads them, which is quicker than a hook of msgspec for each
    WireElements = msgspec.Raw
    WireNumbers = WireTruths = bytes


class Message(msgspec.Struct, frozen=True, kw_only=True, tag_field="type", tag=str.lower):
    """The fields of every message. Its type on the wire is the name of its class in lower case.

    Attributes:
        v: Version of the wire format.
        stamp_ns: The sender's wall clock when the content was true [ns since 1970].
        seq: Number of the message of this key and sender; a gap is a loss.
        boot: Random number of the sending process; it changes when the process restarts.
    """

    TYPE: ClassVar[str]
    v: int = 0
    stamp_ns: int = 0
    seq: int = 0
    boot: int = 0

    @classmethod
    def of(cls, record: "hal.Sample | hal.Applied", **more: Any) -> Self:
        """Make a message from a record of the HAL, whose fields have the same names, and from `more` fields."""
        return cls(**{name: getattr(record, name) for name in record.__slots__}, **more)


class OfSignals(Message, frozen=True, kw_only=True):
    """A message with several fields for the same signals. A field is one array; a map of one per signal is joined.

    Attributes:
        elements: Signal -> number of its elements, in the order of the arrays.
    """

    BY_ELEMENT: ClassVar[tuple[tuple[str, type[BySignal]], ...]] = ()
    """These fields have a value for each element."""
    BY_SIGNAL: ClassVar[tuple[str, ...]] = ()
    """These fields have a value for each signal."""
    parts: ClassVar[tuple[tuple[str, type[BySignal], np.dtype[Any], int], ...]] = ()
    """These are the `BY_ELEMENT` with the dtype and the bytes of one value."""
    elements: WireElements = NOTHING

    def __init_subclass__(cls, **_: Any) -> None:
        cls.parts = tuple((name, kind, kind.DTYPE, kind.DTYPE.itemsize) for name, kind in cls.BY_ELEMENT)

    def __post_init__(self) -> None:
        if type(self.elements) is msgspec.Raw:
            self._read(bytes(self.elements))
        else:
            self._join()
        for name in self.BY_SIGNAL:
            if getattr(self, name).keys() != self.elements.counts.keys():
                raise ValueError(f"Expected the same signals in '{name}' as in 'elements'")

    def _read(self, counts: bytes) -> None:
        """Replace the fields in wire form by read-only arrays."""
        elements = _known_elements.get(counts) or _read_elements(counts)
        force_setattr(self, "elements", elements)
        size = elements.size
        for name, kind, dtype, width in self.parts:
            data = getattr(self, name)
            if len(data) != size * width:
                raise ValueError(_misfit(name, len(data), width, size))
            flat = frombuffer(data, dtype)
            if kind is Truths and data.strip(b"\0\1"):  # any byte but zero is true
                flat = frombuffer(data, "u1") != 0
            force_setattr(self, name, kind(flat, elements))

    def _join(self) -> None:
        """Make one array of a field that has one per signal."""
        elements = self.elements
        for name, kind in self.BY_ELEMENT:
            values: BySignal | bytes = getattr(self, name)
            if isinstance(values, bytes):
                raise ValueError(f"Expected a map 'elements' with the signals of '{name}'")
            if type(values) is not kind or values.elements is not elements:
                try:
                    joined = kind.of(values, elements if elements.size else None)
                except ValueError as error:
                    raise ValueError(f"{error} in '{name}'") from None
                elements = joined.elements
                force_setattr(self, name, joined)
                force_setattr(self, "elements", elements)


_known_elements: dict[bytes, Elements] = {}
"""This cache holds elements by their wire form."""


def _read_elements(wire: bytes) -> Elements:
    counts = msgspec.msgpack.decode(wire)
    if not isinstance(counts, dict):
        raise ValueError("Expected a map from signal to its number of elements in 'elements'")
    elements = Elements.of(counts)
    if len(_known_elements) >= KEPT:
        _known_elements.clear()
    if len(wire) <= LONGEST:
        _known_elements[wire] = elements
    return elements


def _misfit(name: str, length: int, width: int, size: int) -> str:
    if length % width:
        return f"Expected a binary of little-endian float64 in '{name}', found {length} bytes"
    return f"Expected {size} elements in '{name}', found {length // width}"


class Sample(OfSignals, frozen=True, kw_only=True):
    """One coherent cycle of the robot's sensors, or one frame of a camera.

    Attributes:
        cycle: The HAL's cycle number, or the number of the frame.
        source: `can`, `camera`, `ros2`, `simulated`, `truth` or `replay`.
        complete: Whether every device answered in this cycle.
        values: Signal -> values [the signal's unit], shape (n,); NaN where not valid.
        age: Signal -> age of each value when published [s], shape (n,); inf if never measured.
        valid: Signal -> whether each value may be used, shape (n,).
    """

    TYPE: ClassVar[str] = "sample"
    BY_ELEMENT: ClassVar[tuple[tuple[str, type[BySignal]], ...]] = (
        ("values", Numbers), ("age", Numbers), ("valid", Truths),
    )  # fmt: skip
    cycle: int
    source: str
    complete: bool
    values: WireNumbers
    age: WireNumbers
    valid: WireTruths


class Command(Message, frozen=True, kw_only=True):
    """Desired values of the drives.

    Attributes:
        signal: The commanded signal.
        values: Desired values [its unit], shape (n,).
        cycle: `Sample.cycle` that the command answers; the HAL computes the command's age from it, on its own clock.
        hal_boot: `Sample.boot` of that sample.
        name: Name of the client, for people; only the first command of a stream needs it.
    """

    TYPE: ClassVar[str] = "command"
    signal: str
    values: Array
    cycle: int
    hal_boot: int
    name: str = ""


class Holder(Message, frozen=True, kw_only=True):
    """The holder of the lease, the client that commands the robot.

    Attributes:
        name: Name for people; empty without a holder.
        holder: `boot` of the holder; 0 without one.
        through: `boot` of the service that commands for the holder; 0 if the holder does so itself.
        left: Remaining time of the lease [s].
    """

    TYPE: ClassVar[str] = "holder"
    name: str
    holder: int
    through: int = 0
    left: float = 0.0


class Applied(Message, frozen=True, kw_only=True):
    """The set-points that were sent to the drives in a cycle.

    Attributes:
        cycle: The HAL's cycle number.
        mode: `off`, `enabling`, `hold`, `follow`, `homing`, `stopping` or `fault`.
        signal: The commanded signal.
        desired: Newest accepted command [its unit], shape (n,); NaN without a current one.
        values: Applied set-points [its unit], shape (n,); NaN while off.
        limited_by: Limits that acted (`acceleration`, `effort`, `range`, `rate`, `tension`, `velocity`), sorted.
        sender: `Command.boot` of the command that was followed; 0 if none.
    """

    TYPE: ClassVar[str] = "applied"
    cycle: int
    mode: str
    signal: str
    desired: Array
    values: Array
    limited_by: list[str]
    sender: int


class Estimates(OfSignals, frozen=True, kw_only=True):
    """All signals of the body: measured values, and estimates of the elements that are not valid.

    Attributes:
        cycle: `Sample.cycle` of its sample; -1 without a fresh sample.
        values: Signal -> measured values, with estimates in place of the elements that are not valid [unit];
            NaN where neither is possible.
        estimated: Signal -> whether each element was estimated, shape (n,).
        std: Signal -> expected error of an estimate (1 sigma) [unit], shape (n,): 1.645 of them contain the truth in 90
            of 100 samples that are like the learned ones; 0 where measured, NaN where unknown.
        method: Signal -> `measured`, `fused` (a measurement combined with its estimate), `mask`, `latent`, `input`,
            `regression` or `none`.
        mask: Signal -> the signals it was estimated from, joined by `+`.
        residual: Signal -> error of the model on its own input (root mean square), in standard deviations of the
            training data; 0 where measured.
        state: Signal -> `known`, `doubtful` or `unknown`: whether the sample and p are like those that were learned.
            Older services do not publish it.
        reason: Signal -> one sentence on the state; only of signals that are not `known`.
        distrusted: `signal.element` -> reason, such as `distrusted: frozen since 12:03:11`, of elements that are
            estimated although they are measured, because the others contradict them or an operator said so.
    """

    TYPE: ClassVar[str] = "estimates"
    BY_ELEMENT: ClassVar[tuple[tuple[str, type[BySignal]], ...]] = (
        ("values", Numbers), ("estimated", Truths), ("std", Numbers),
    )  # fmt: skip
    BY_SIGNAL: ClassVar[tuple[str, ...]] = ("method", "mask", "residual")
    cycle: int
    values: WireNumbers
    estimated: WireTruths
    std: WireNumbers
    method: dict[str, str]
    mask: dict[str, str]
    residual: dict[str, float]
    state: dict[str, str] = msgspec.field(default_factory=dict)
    reason: dict[str, str] = msgspec.field(default_factory=dict)
    distrusted: dict[str, str] = msgspec.field(default_factory=dict)


class Anomaly(OfSignals, frozen=True, kw_only=True):
    """The deviation of the body from normal.

    Attributes:
        cycle: `Sample.cycle` of the newest sample; beside a camera the judged values are as old as its frame.
        score: Mahalanobis distance (paper, II-K) of the prediction error; NaN without normal data.
        threshold: Score above which it counts as an anomaly.
        is_anomaly: Whether the score was above the threshold for as long as the robot file requires, and the cause is
            neither a change of environment nor a place outside of what was learned.
        blamed: `signal.element` that is most likely wrong in the samples above the threshold; below the threshold, the
            one that contributes most; with the verdict `outside` the one that is furthest outside of its learned range;
            empty while the verdict is `unknown`.
        verdict: `normal`, `environment` (another condition of the body explains the samples above the threshold),
            `anomaly` (no condition does), `unknown` (what is normal was not learned on this body yet, or p is beyond
            the trained conditions), `outside` (the samples are outside of what was learned, and their errors as large
            as is to be expected there), or empty before a verdict.
        contribution: Signal -> each element's part of score^2, shape (n,).
    """

    TYPE: ClassVar[str] = "anomaly"
    BY_ELEMENT: ClassVar[tuple[tuple[str, type[BySignal]], ...]] = (("contribution", Numbers),)
    cycle: int
    score: float
    threshold: float
    is_anomaly: bool
    blamed: str
    contribution: WireNumbers
    verdict: str = ""


class Update(Message, frozen=True, kw_only=True):
    """The state of the online update.

    Attributes:
        active: Whether it is learning.
        model_version: Number of the model in use; it grows with every swap.
        window: Number of samples in the bounded window.
        dropped: Number of samples dropped from it so far, oldest first.
        loss: Mean squared error over the window, in standard deviations of the training data.
        bias: The parametric bias p in use, shape (n,); empty without.
        settled: Whether p is well known and explains what is seen.
        rolled_back: Number of times W was restored because its error on held-out samples grew.
    """

    TYPE: ClassVar[str] = "update"
    active: bool
    model_version: int
    window: int
    dropped: int
    loss: float
    bias: Array = msgspec.field(default_factory=lambda: np.zeros(0))
    settled: bool = True
    rolled_back: int = 0


class Target(Message, frozen=True, kw_only=True):
    """The target of the controller.

    Attributes:
        signal: Signal to reach, such as `joint_position`.
        values: Reference [its unit], shape (n,).
        cycle: `Sample.cycle` of the newest sample that the sender had seen; a target older than 1 s is refused.
        hal_boot: `Sample.boot` of that sample.
    """

    TYPE: ClassVar[str] = "target"
    signal: str
    values: Array
    cycle: int = 0
    hal_boot: int = 0


class Status(Message, frozen=True, kw_only=True):
    """Health of one service, once a second.

    Attributes:
        service: Name of the service.
        state: `starting`, `ready`, `running`, `degraded`, `fault`, `stopping`.
        text: One sentence for the operator; empty when all is well.
        loops: Loop name -> rate_wanted, rate [Hz], late_p50, late_p99, late_max [s], ticks, skipped.
        facts: Other values of the service: devices, buses, controller, rejected messages.
    """

    TYPE: ClassVar[str] = "status"
    service: str
    state: str
    text: str = ""
    loops: dict[str, dict[str, float]] = msgspec.field(default_factory=dict)
    facts: dict[str, Any] = msgspec.field(default_factory=dict)
