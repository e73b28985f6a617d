"""The connection of topics to ROS 2, in a thread of its own that waits for the router and for other nodes."""

import logging
import threading
from collections.abc import Iterable

from services.errors import ServiceError
from services.ros2.incoming import Topic
from services.ros2.messages import Message
from services.ros2.names import Kind
from services.ros2.node import Network, Node, Publisher

log = logging.getLogger(__name__)

LOOK_EVERY = 0.1
"""The endpoints of other nodes are looked up at this interval [s]."""
TRY_EVERY = 1.0
"""The router of ROS 2 is tried again at this interval [s]."""


class RosLink:
    """A node in a thread of its own, which opens it as soon as the router is there.

    Args:
        name: Full name of the node.
        network: Part of ROS 2 to join.
        topics: Topics to read.
        commands: Topic -> type of the set-points.
    """

    def __init__(self, name: str, network: Network, topics: Iterable[Topic], commands: dict[str, str]) -> None:
        self._name, self._network = name, network
        self._topics, self._commands = tuple(topics), commands
        self._publishers: dict[str, Publisher] = {}
        self._silence: dict[str, str] = {}
        self._deafness: dict[str, str] = {}
        self._text = "The connection to ROS 2 is being opened."
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="ros2 link", daemon=True)

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def stop(self) -> None:
        """End the thread and the node."""
        self._stop.set()
        self._thread.join(5.0)

    def silence(self, topic: str) -> str:
        """Return why nothing comes on a topic, in a sentence."""
        return self._text or self._silence.get(topic, "")

    def deafness(self, topic: str) -> str:
        """Return why no node would receive a message of this type, in a sentence; empty if one would."""
        return self._text or self._deafness.get(topic, f"The topic '{topic}' is being looked up.")

    def put(self, topic: str, message: Message) -> None:
        """Publish a message on a topic of set-points; it never waits."""
        publisher = self._publishers.get(topic)
        if publisher is not None:
            publisher.put(message)

    def _run(self) -> None:
        while not self._stop.is_set():
            try:
                with Node(self._name, self._network) as node:
                    self._serve(node)
            except ServiceError as error:
                if str(error) != self._text:
                    log.warning("%s It is tried again.", error)
                self._text = str(error)
            except Exception:
                log.exception("The node '%s' failed", self._name)
            self._stop.wait(TRY_EVERY)

    def _serve(self, node: Node) -> None:
        for topic in self._topics:
            node.subscribe(topic.name, topic.kind, topic.put)
        self._publishers = {topic: node.publisher(topic, kind) for topic, kind in self._commands.items()}
        try:
            while not self._stop.is_set():
                self._look(node)
                self._stop.wait(LOOK_EVERY)
        finally:
            self._publishers = {}

    def _look(self, node: Node) -> None:
        """Look at the endpoints of other nodes."""
        if not node.is_linked:
            self._text = f"The router of ROS 2 at {self._network.router} is gone. Is it running?"
            return
        for topic in self._topics:
            self._silence[topic.name] = node.mismatch(Kind.PUBLISHER, topic.name, topic.kind) or (
                f"Topic '{topic.name}' is silent, although it has a publisher. Does its node work?"
            )
        for name, kind in self._commands.items():
            self._deafness[name] = node.mismatch(Kind.SUBSCRIPTION, name, kind)
        self._text = ""
