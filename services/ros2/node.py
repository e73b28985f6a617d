"""A node of ROS 2 on a zenoh session of its own: publishers, subscriptions, services, and what else is there."""

import json
import logging
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Self

import zenoh
import zenoh.ext

from services.errors import ServiceError, ServiceUnavailable
from services.ros2 import cdr, names
from services.ros2.names import Entity, Kind
from services.wire.connect import checked_endpoint
from services.wire.session import close_session, common_settings

log = logging.getLogger(__name__)

ROUTER = "tcp/127.0.0.1:7447"
"""The router of rmw_zenoh (`ros2 run rmw_zenoh_cpp rmw_zenohd`) listens here."""
OPEN_WITHIN = 3.0
"""The router has this time [s] to answer."""
SEEN_WITHIN = 0.5
"""Nodes that are there are known after this time [s]."""
GONE_WITHIN = 1.5
"""A node that was killed is gone from the graph after this time [s]."""
AT_ONCE = 8
"""At most this many requests of services are answered at once."""
HEARTBEAT = 0.5
"""A latched publisher says this often [s] which message was its last."""

Message = Mapping[str, Any]


class NameTaken(ServiceError):
    """A node or topic name that another node has."""


@dataclass(frozen=True, slots=True)
class Network:
    """Part of ROS 2 that a node joins.

    Attributes:
        router: Endpoint of its router.
        domain: Number of the domain (`ROS_DOMAIN_ID`).
        distribution: Name of the ROS distribution of the other nodes: in `humble` types have no hashes.
    """

    router: str = ROUTER
    domain: int = 0
    distribution: str = "jazzy"


class Publisher:
    """A publisher of one type of message on one topic; it never waits for a slow subscriber."""

    def __init__(self, session: zenoh.Session, key: str, kind: str, token: str, is_latched: bool) -> None:
        self.published = 0
        """This is the number of messages so far."""
        self._kind, self._gid = kind, names.gid_of(token)
        if is_latched:
            self._publisher: Any = zenoh.ext.declare_advanced_publisher(
                session,
                key,
                congestion_control=zenoh.CongestionControl.DROP,
                cache=zenoh.ext.CacheConfig(1),
                sample_miss_detection=zenoh.ext.MissDetectionConfig(heartbeat=HEARTBEAT, sporadic_heartbeat=None),
                publisher_detection=True,
            )
        else:
            self._publisher = session.declare_publisher(key, congestion_control=zenoh.CongestionControl.DROP)
        self._token = session.liveliness().declare_token(token)

    def put(self, message: Message) -> None:
        """Publish a message."""
        self.published += 1
        attachment = names.attachment(self.published, time.time_ns(), self._gid)
        self._publisher.put(cdr.encode(self._kind, message), attachment=attachment)

    def close(self) -> None:
        """End the publisher; the node stays."""
        self._token.undeclare()
        self._publisher.undeclare()


class Node:
    """A node, as a context manager; it is known to others before its first endpoint.

    Args:
        name: Full name, such as `/arm/gemuco`.
        network: Router, domain and distribution.

    Attributes:
        session: The open zenoh session.
        graph: All other nodes of the domain and their endpoints.
    """

    session: zenoh.Session
    graph: "Graph"

    def __init__(self, name: str, network: Network) -> None:
        self.name, self.network = name, network
        self._ids = 0
        self._kept: list[Any] = []
        self._answering = threading.BoundedSemaphore(AT_ONCE)

    def __enter__(self) -> Self:
        self.session = open_session(self.network)
        try:
            self.graph = Graph(self.session, self.network.domain, str(self.session.info.zid()))
            self.graph.settle()
            self._check_name()
        except BaseException:
            close_session(self.session)
            raise
        zid = self.graph.own_session
        token = names.node_token(self.network.domain, zid, 0, self.name)
        self._kept.append(self.session.liveliness().declare_token(token))
        return self

    def __exit__(self, *_: object) -> None:
        close_session(self.session)

    def _check_name(self) -> None:
        """Raise `NameTaken` if another node has the name, and still has it after a frozen one would be gone."""
        deadline = time.monotonic() + GONE_WITHIN
        while any(one.kind is Kind.NODE and one.node == self.name for one in self.graph.entities()):
            if time.monotonic() > deadline:
                raise NameTaken(
                    f"The ROS domain {self.network.domain} has a node '{self.name}' already. Does another bridge of "
                    "this robot run? Stop it, or take another --domain."
                )
            time.sleep(SEEN_WITHIN / 5)

    def publisher(self, topic: str, kind: str, *, is_latched: bool = False) -> Publisher:
        """Make a publisher of the ROS type `kind` on a full topic name.

        Args:
            topic: Full name, such as `/arm/joint_states`.
            kind: ROS type.
            is_latched: Whether late subscribers get the last message (transient local).
        """
        qos = names.LATCHED if is_latched else names.VOLATILE
        entity, token = self._declared(Kind.PUBLISHER, topic, kind, qos)
        publisher = Publisher(self.session, self._key(entity), kind, token, is_latched)
        self._kept.append(publisher)
        return publisher

    def subscribe(
        self, topic: str, kind: str, take: Callable[[zenoh.Sample], None], *, is_latched: bool = False
    ) -> None:
        """Call `take` with every message on a topic of this type.

        Args:
            topic: Full name of the topic.
            kind: ROS type.
            take: Function that only stores the message: the session's thread calls it.
            is_latched: Whether to get the last messages of before too (transient local).
        """
        qos = names.LATCHED if is_latched else names.VOLATILE
        entity, token = self._declared(Kind.SUBSCRIPTION, topic, kind, qos)
        handler = zenoh.handlers.Callback(take, indirect=False)
        history = zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=1)
        subscriber: Any = (
            zenoh.ext.declare_advanced_subscriber(self.session, self._key(entity), handler, history=history)
            if is_latched
            else self.session.declare_subscriber(self._key(entity), handler)
        )
        self._kept += [subscriber, self.session.liveliness().declare_token(token)]

    def serve(self, name: str, kind: str, answer: Callable[[dict[str, Any]], Message]) -> None:
        """Answer a service of the ROS type `kind` (`std_srvs/srv/Trigger`), each request in a thread of its own."""
        entity, token = self._declared(Kind.SERVICE, name, kind, names.VOLATILE)

        def reply(query: zenoh.Query) -> None:
            try:
                sequence, _, gid = names.read_attachment(query.attachment.to_bytes() if query.attachment else b"")
                request = cdr.decode(f"{kind}_Request", query.payload.to_bytes() if query.payload else b"")
                response = cdr.encode(f"{kind}_Response", answer(request))
            except (ServiceError, ValueError) as error:
                log.warning("A request of %s was not answered: %s", name, error)
                query.reply_err(str(error))
                return
            finally:
                self._answering.release()
            attachment = names.attachment(sequence, time.time_ns(), gid)
            query.reply(self._key(entity), response, attachment=attachment)

        def take(query: zenoh.Query) -> None:
            if not self._answering.acquire(blocking=False):
                query.reply_err(f"More than {AT_ONCE} requests are being answered.")
                return
            threading.Thread(target=reply, args=(query,), name=f"service {name}", daemon=True).start()

        self._kept += [
            self.session.declare_queryable(self._key(entity), take, complete=True),
            self.session.liveliness().declare_token(token),
        ]

    def mismatch(self, kind: Kind, topic: str, ros_type: str) -> str:
        """Return why no other endpoint of this kind and type is on a topic, in a sentence; empty if one is."""
        what = "publisher" if kind is Kind.PUBLISHER else "subscriber"
        others = [one for one in self.graph.entities() if one.kind is kind and one.topic == topic]
        if not others:
            return f"Topic '{topic}' has no {what} in ROS domain {self.network.domain}. Is its node running?"
        hash_ = names.hash_of(ros_type, self.network.distribution)
        if any(one.type == ros_type and one.hash == hash_ for one in others):
            return ""
        other = others[0]
        if other.type != ros_type:
            return f"Topic '{topic}' of node '{other.node}' is of type {other.type or 'unknown'}, not {ros_type}."
        return (
            f"Topic '{topic}' of node '{other.node}' has the type hash {other.hash[:16]}, not {hash_[:16]}. "
            "Is it of another ROS distribution?"
        )

    @property
    def is_linked(self) -> bool:
        """Whether the router is connected at present."""
        return bool(list(self.session.info.routers_zid()))

    def _declared(self, kind: Kind, topic: str, ros_type: str, qos: str) -> tuple[Entity, str]:
        """Return a new endpoint and its token."""
        self._ids += 1
        hash_ = names.hash_of(ros_type, self.network.distribution)
        entity = Entity(kind, self.name, topic, ros_type, hash_, qos, self.graph.own_session)
        return entity, names.endpoint_token(self.network.domain, 0, self._ids, entity)

    def _key(self, entity: Entity) -> str:
        return names.data_key(self.network.domain, entity.topic, entity.type, entity.hash)


class Graph:
    """The nodes and endpoints of a domain, kept up to date by zenoh until the session ends."""

    def __init__(self, session: zenoh.Session, domain: int, own_session: str = "") -> None:
        self.own_session = own_session
        """This session's own entities are left out."""
        self._entities: dict[str, Entity] = {}
        self._lock = threading.Lock()
        self._subscriber = session.liveliness().declare_subscriber(
            f"{names.LIVELINESS}/{domain}/**", self._update, history=True
        )

    def settle(self) -> None:
        """Wait until the entities that are there are known."""
        before = -1
        deadline = time.monotonic() + SEEN_WITHIN
        while (count := len(self._entities)) != before or (not count and time.monotonic() < deadline):
            before = count
            time.sleep(SEEN_WITHIN / 5)

    def entities(self) -> list[Entity]:
        """Return all entities of other sessions, sorted."""
        with self._lock:
            return sorted(self._entities.values(), key=lambda one: (one.topic, one.node, one.kind))

    def publishers(self, topic: str) -> list[Entity]:
        """Return the publishers of other sessions on a topic."""
        return [one for one in self.entities() if one.kind is Kind.PUBLISHER and one.topic == topic]

    def _update(self, token: zenoh.Sample) -> None:
        key = str(token.key_expr)
        entity = names.read_token(key)
        if entity is None or entity.session == self.own_session:
            return
        with self._lock:
            if token.kind == zenoh.SampleKind.PUT:
                self._entities[key] = entity
            else:
                self._entities.pop(key, None)


def open_session(network: Network) -> zenoh.Session:
    """Open a client session of a ROS 2 network.

    It is a client, because the router of rmw_zenoh does not forward between peers.

    Raises:
        ServiceUnavailable: The router does not answer.
        ServiceError: Its endpoint is malformed.
    """
    place = checked_endpoint(network.router)
    settings: dict[str, Any] = {
        **common_settings(),
        "mode": "client",
        "connect": {
            "endpoints": [place],
            "timeout_ms": round(1e3 * OPEN_WITHIN),
            "exit_on_failure": True,
            "retry": {"period_init_ms": 50, "period_max_ms": 500, "period_increase_factor": 2},
        },
    }
    try:
        return zenoh.open(zenoh.Config.from_json5(json.dumps(settings)))
    except zenoh.ZError:
        raise ServiceUnavailable(
            f"No router of ROS 2 answers at {place}. Is `ros2 run rmw_zenoh_cpp rmw_zenohd` running, or, without ROS, "
            "`gemuco router`? Name another place by --ros-router, or in the robot file (`ros2: {router: ...}`)."
        ) from None
