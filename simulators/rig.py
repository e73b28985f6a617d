"""A simulated robot on its buses: a world, the nodes that measure and move it, and their common time."""

import logging
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence

import can
import numpy as np

from hal.config import BusConfig, RobotConfig
from hal.errors import BusGone, ConfigError
from hal.line.port import SERIAL
from hal.wire.interface import open_interface
from simulators.faults import TOOL_CHANGED
from simulators.hub import HubServer
from simulators.lies import LIES, SWAPPED, TRUE, known_lies, lie_of
from simulators.nodes.canopen.segment import Segment
from simulators.nodes.canopen.spec import NodeSpec
from simulators.nodes.dbc.sensor import DbcNode
from simulators.nodes.node import SimulatedDrive, SimulatedNode
from simulators.nodes.plant import Plant, Snapshot
from simulators.nodes.serial.segment import LineSegment
from simulators.world import World

_log = logging.getLogger(__name__)

PERIOD = 0.005
"""The physics thread has this step [s]. Half of this step needs a few percent of a core more."""
_SWITCH_INTERVAL = 5e-4
"""The interpreter switches between threads after this time [s]; the default delays answers to SYNC by 5 ms."""


class BusNotOpened(BusGone, can.CanInitializationError):
    """A bus that the simulated nodes cannot join."""


class UnknownFault(ValueError):
    """The fault or the node does not exist; the message lists the known ones."""


class Rig:
    """Simulated hardware of one robot.

    `start` runs it in real time: a hub server for every bus of interface `hub`, one thread per bus that answers, and
    one thread that moves the world. `step` moves it in simulated time instead, for tests on interface `virtual`.
    """

    def __init__(self, config: RobotConfig, world: World, hardware: Sequence[NodeSpec]) -> None:
        """Connect the parts of a robot, without opening a bus or starting a thread.

        Args:
            config: Robot file; only buses, signals and their elements are used.
            world: The physics.
            hardware: Nodes on the buses.

        Raises:
            ValueError: A node is on a bus, or measures an element, that the robot file does not have.
            ConfigError: A bus is a serial line of hardware, or carries no frames of CAN FD, which a node sends.
        """
        _check(config, hardware)
        self._world = world
        self._world_lock = threading.Lock()
        places = {
            f"{signal}.{element}": (signal, index)
            for signal, section in config.signals.items()
            for index, element in enumerate(section.elements)
        }
        self._plant = Plant(places, Snapshot(world.time, world.measure()))
        self._servers: dict[str, HubServer] = {}
        self._segments: dict[str, Segment | LineSegment] = {}
        for name, bus in config.buses.items():
            if bus.interface == "hub":
                timed = bus.bitrate if bus.options.get("bit_timing") else None
                self._servers[name] = HubServer(bus.channel, timed, bus.data_bitrate)
            specs = [spec for spec in hardware if spec.bus == name]
            if bus.interface == "serial":
                raise ConfigError(
                    f"Bus '{name}' is a real serial line. For simulated servos set `interface: pty` and a name as "
                    f"`channel`, such as {config.robot}_{name}."
                )
            if bus.interface in SERIAL:
                self._segments[name] = LineSegment(name, specs, self._plant, bus)
                continue
            self._segments[name] = Segment(name, specs, self._plant, _opener(bus))
        for name, node in self._nodes().items():
            if isinstance(node, DbcNode) and node.is_fd and not config.buses[node.spec.bus].is_fd:
                raise ConfigError(
                    f"Node '{name}' sends frames of CAN FD, and bus '{node.spec.bus}' carries classic frames only. Set "
                    f"buses.{node.spec.bus}.data_bitrate."
                )
        self._drives = [node for node in self._nodes().values() if isinstance(node, SimulatedDrive)]
        self._threads: list[threading.Thread] = []
        self._running = threading.Event()
        self._is_open = False
        self._now = 0.0
        self._ticks = {"steps": 0, "skipped": 0}
        self.failure = ""
        """Reason why the rig stopped by itself; empty without a failure."""

    def start(self) -> None:
        """Run in real time until `stop`.

        Raises:
            BusNotOpened: A bus cannot be opened.
        """
        try:
            self._open(time.monotonic())
        except BusNotOpened:
            self.stop()
            raise
        self._interval = sys.getswitchinterval()
        sys.setswitchinterval(_SWITCH_INTERVAL)
        self._running.set()
        jobs: dict[str, Callable[[], None]] = {"physics": self._run_physics}
        for name, segment in self._segments.items():
            jobs[f"nodes {name}"] = lambda segment=segment: segment.serve(time.monotonic, self._running.is_set)  # type: ignore[misc]
        for name, job in jobs.items():
            thread = threading.Thread(target=self._guard, args=(name, job), name=name, daemon=True)
            self._threads.append(thread)
            thread.start()

    def stop(self) -> None:
        """Stop, leave the buses and close the world. Safe to call twice."""
        if self._running.is_set() or self._threads:
            self._running.clear()
            for thread in self._threads:
                thread.join()
            self._threads.clear()
            sys.setswitchinterval(self._interval)
        for segment in self._segments.values():
            segment.close()
        for server in self._servers.values():
            server.close()
        self._is_open = False
        self._world.close()

    def step(self, duration: float) -> None:
        """Answer the waiting frames, then move world and nodes by `duration` [s]; 0 only answers.

        The buses are opened, and the nodes boot, at the first call.
        """
        self._open(self._now)
        for segment in self._segments.values():
            segment.answer(self._now)
        if duration > 0:
            self._move(duration)
            self._now += duration
            for segment in self._segments.values():
                segment.tick(self._now)

    def fault(self, text: str) -> str:
        """Break a part, or restore a node; return a sentence on what was done.

        `sensor_silent NODE`, `node_silent NODE`, `node_back NODE`, `node_reboot NODE`, `emcy NODE`; a lie of
        `simulators.lies`, such as `sensor_frozen NODE` or `sensor_offset NODE 1.0`, which `sensor_true NODE` ends;
        anything else is a part of the world, as in `muscle_cut biceps` or `tool_changed CONDITION`.

        Raises:
            UnknownFault: The fault or the node does not exist.
        """
        words = text.split()
        if words and words[0] in _NODE_FAULTS:
            return self._fault_node(words)
        if words and words[0] in (*LIES, SWAPPED, TRUE):
            return self._lie(words)
        try:
            with self._world_lock:
                self._world.break_part(":".join(words))
        except ValueError as error:
            known = ", ".join([*(f"{fault} NODE" for fault in _NODE_FAULTS), *known_lies()])
            raise UnknownFault(f"{error} Faults of nodes: {known}.") from None
        return f"The tool is now {words[1]}." if words[0] == TOOL_CHANGED else f"Broke {' '.join(words)}."

    def truth(self) -> Mapping[str, np.ndarray]:
        """Return every signal without noise, shapes (n,)."""
        with self._world_lock:
            return self._world.truth()

    def stats(self) -> dict[str, object]:
        """Return counters of the physics, the buses and the hub, and the state of every node."""
        buses = {
            name: {**segment.counters, **({"hub": self._servers[name].stats()} if name in self._servers else {})}
            for name, segment in self._segments.items()
        }
        nodes = {name: node.condition for name, node in self._nodes().items()}
        return {"physics": dict(self._ticks), "buses": buses, "nodes": nodes, "failure": self.failure}

    def node(self, name: str) -> SimulatedNode:
        """Return a node by its name.

        Raises:
            UnknownFault: The node does not exist.
        """
        nodes = self._nodes()
        if name not in nodes:
            raise UnknownFault(f"There is no node '{name}'. Known nodes: {', '.join(nodes)}.")
        return nodes[name]

    def _nodes(self) -> dict[str, SimulatedNode]:
        return {name: node for segment in self._segments.values() for name, node in segment.nodes.items()}

    def _open(self, now: float) -> None:
        if self._is_open:
            return
        for name, segment in self._segments.items():
            try:
                if name in self._servers:
                    self._servers[name].start()
                segment.open(now)
            except (can.CanError, OSError) as error:
                why = str(error).rstrip(".")
                advice = "" if why.endswith("?") else ". Is it there, is it up?"
                raise BusNotOpened(f"Bus '{name}' does not open: {why}{advice}") from error
        self._is_open = True

    def _fault_node(self, words: list[str]) -> str:
        if len(words) != 2:
            raise UnknownFault(f"'{words[0]}' takes the name of one node. Known nodes: {', '.join(self._nodes())}.")
        node = self.node(words[1])
        act, sentence = _NODE_FAULTS[words[0]]
        with self._segments[node.spec.bus].lock:
            act(node, time.monotonic() if self._running.is_set() else self._now)
        return f"{node.spec.name} (node {node.spec.node} on {node.spec.bus}) {sentence}."

    def _lie(self, words: list[str]) -> str:
        """Let the sensor of a node lie about its element, or end that."""
        if len(words) < 2:
            raise UnknownFault(f"'{words[0]}' takes the name of a node. Known nodes: {', '.join(self._nodes())}.")
        element, plant = self.node(words[1]).spec.element, self._plant
        if words[0] == TRUE:
            plant.lies.pop(element, None)
            for one in (element, plant.swapped.pop(element, element)):
                plant.swapped.pop(one, None)
            return f"{words[1]} measures {element} as it is."
        if words[0] == SWAPPED:
            if len(words) != 3:
                raise UnknownFault(f"'{SWAPPED}' takes the names of two nodes.")
            other = self.node(words[2]).spec.element
            plant.swapped.update({element: other, other: element})
            return f"{words[1]} measures {other}, and {words[2]} measures {element}."
        try:
            plant.lies[element], sentence = lie_of(words[0], words[2:], plant.read(element), plant.time)
        except ValueError as error:
            raise UnknownFault(str(error)) from None
        return f"{words[1]} {sentence} of {element}."

    def _move(self, duration: float) -> None:
        with self._world_lock:
            for drive in self._drives:
                target, enabled = drive.servo
                self._world.drive(drive.spec.element, target, enabled)
            self._world.step(duration)
            self._plant.snapshot = Snapshot(self._world.time, self._world.measure())
        self._ticks["steps"] += 1

    def _run_physics(self) -> None:
        due = time.monotonic()
        while self._running.is_set():
            self._move(PERIOD)
            due += PERIOD
            late = time.monotonic() - due
            if late > 0:
                missed = int(late / PERIOD)
                self._ticks["skipped"] += missed
                due += missed * PERIOD
            else:
                time.sleep(-late)

    def _guard(self, name: str, job: Callable[[], None]) -> None:
        """Run a thread's job; if it fails, stop the rig, so that nodes do not run without the world."""
        try:
            job()
        except Exception as error:
            _log.exception("the rig's thread '%s' failed", name)
            self.failure = f"{name}: {error}"
            self._running.clear()


def _opener(bus: BusConfig) -> Callable[[], can.BusABC]:
    def open_bus() -> can.BusABC:
        return open_interface(bus)

    return open_bus


def _check(config: RobotConfig, hardware: Sequence[NodeSpec]) -> None:
    elements = config.element_names()
    for spec in hardware:
        if spec.bus not in config.buses:
            raise ValueError(f"Node '{spec.name}' is on bus '{spec.bus}'. Known buses: {', '.join(config.buses)}.")
        for element in (spec.element, getattr(spec.constants, "load", None)):
            if element is not None and element not in elements:
                raise ValueError(f"Node '{spec.name}' measures '{element}'. Known elements: {', '.join(elements)}.")


def _mute(node: SimulatedNode, now: float) -> None:
    node.is_muted = True


_NODE_FAULTS: dict[str, tuple[Callable[[SimulatedNode, float], None], str]] = {
    "sensor_silent": (_mute, "sends no measurements any more; its heartbeat goes on"),
    "node_silent": (lambda node, now: node.power_down(), "has no power any more"),
    "node_back": (lambda node, now: node.power_up(now), "is back, as after power-on"),
    "node_reboot": (lambda node, now: node.power_up(now), "rebooted"),
    "emcy": (lambda node, now: node.break_down(), "reports a hardware fault"),
}
