"""Names of rmw_zenoh: keys of topics and services, liveliness tokens, QoS, attachments."""

import hashlib
import re
import struct
from dataclasses import dataclass
from enum import StrEnum

from services.ros2.definitions import type_hash
from services.wire.plain_text import plain

LIVELINESS = "@ros2_lv"
NO_HASH = "TypeHashNotSupported"
"""Humble has no type hashes and writes this word in their place."""
HASHLESS = ("humble",)
"""These distributions write `NO_HASH`."""
VOLATILE, LATCHED = "1:2:1,10:,:,:,,", "1:1:1,1:,:,:,,"
"""QoS of an endpoint, with the fields written out whose defaults differ between implementations: reliable, then
volatile with a depth of 10, or transient local with a depth of 1."""
_ATTACHMENT = struct.Struct("<qqB")
GID_SIZE = 16


class Kind(StrEnum):
    """Kind of an entity in a liveliness token."""

    NODE = "NN"
    PUBLISHER = "MP"
    SUBSCRIPTION = "MS"
    SERVICE = "SS"
    CLIENT = "SC"


@dataclass(frozen=True, slots=True)
class Entity:
    """A node of ROS 2, or one of its endpoints, as its liveliness token describes it.

    Attributes:
        node: Full name of its node, such as `/arm/gemuco`.
        topic: Full name of the topic or service; empty for a node.
        type: ROS type, such as `sensor_msgs/msg/JointState`; empty for a node, or if it is not known.
        hash: Hash of the type, or `NO_HASH`.
        session: Id of its zenoh session.
    """

    kind: Kind
    node: str
    topic: str = ""
    type: str = ""
    hash: str = ""
    qos: str = ""
    session: str = ""

    @property
    def is_latched(self) -> bool:
        """Whether its QoS is transient local: a late subscriber gets the last message."""
        return self.qos.split(":")[1:2] == ["1"]


def dds_type(name: str) -> str:
    """Return `sensor_msgs::msg::dds_::JointState_` of `sensor_msgs/msg/JointState`."""
    package, kind, last = name.split("/")
    return f"{package}::{kind}::dds_::{last}_"


def ros_type(dds: str) -> str:
    """Return `sensor_msgs/msg/JointState` of `sensor_msgs::msg::dds_::JointState_`; empty if it is not of this form."""
    match = re.fullmatch(r"(\w+)::(msg|srv)::dds_::(\w+)_", dds)
    return "/".join(match.groups()) if match else ""


def hash_of(name: str, distribution: str) -> str:
    """Return the hash of a type as nodes of this distribution (`humble`, `jazzy`) write it."""
    return NO_HASH if distribution in HASHLESS else type_hash(name)


def data_key(domain: int, topic: str, name: str, hash_: str) -> str:
    """Return the key of a topic or service of the ROS type `name`."""
    return f"{domain}/{topic.strip('/')}/{dds_type(name)}/{hash_}"


def node_token(domain: int, session: str, node_id: int, node: str) -> str:
    """Return the token of a node with a full name such as `/arm/gemuco`."""
    return f"{LIVELINESS}/{domain}/{session}/{node_id}/{node_id}/{Kind.NODE}/%/{_place(node)}"


def endpoint_token(domain: int, node_id: int, endpoint_id: int, entity: Entity) -> str:
    """Return the token of an endpoint."""
    return (
        f"{LIVELINESS}/{domain}/{entity.session}/{node_id}/{endpoint_id}/{entity.kind}/%/{_place(entity.node)}/"
        f"{_mangled(entity.topic)}/{dds_type(entity.type)}/{entity.hash}/{entity.qos}"
    )


def read_token(key: str) -> Entity | None:
    """Return the entity of a token; None for a key that is not a token, as of a later version."""
    parts = [plain(part) for part in key.split("/")]  # they appear in messages and logs
    if len(parts) not in (9, 13) or parts[0] != LIVELINESS or parts[5] not in set(Kind):
        return None
    session, kind, namespace, name = parts[2], Kind(parts[5]), parts[7].replace("%", "/"), parts[8]
    node = f"{namespace.rstrip('/')}/{name}"
    if (kind is Kind.NODE) != (len(parts) == 9):
        return None
    if kind is Kind.NODE:
        return Entity(kind, node, session=session)
    return Entity(kind, node, parts[9].replace("%", "/"), ros_type(parts[10]), parts[11], parts[12], session)


def gid_of(token: str) -> bytes:
    """Return the id of an endpoint, which is fixed as long as it lives."""
    return hashlib.blake2b(token.encode(), digest_size=GID_SIZE).digest()


def attachment(sequence: int, time_ns: int, gid: bytes) -> bytes:
    """Return the attachment of a message: its number, the time of the source [ns since 1970], and the source."""
    return _ATTACHMENT.pack(sequence, time_ns, len(gid)) + gid


def read_attachment(data: bytes) -> tuple[int, int, bytes]:
    """Return number, time of the source [ns since 1970] and source of a message.

    Raises:
        ValueError: It is not an attachment of rmw_zenoh since April 2025.
    """
    if len(data) != _ATTACHMENT.size + GID_SIZE:
        raise ValueError(f"an attachment of {len(data)} bytes, not {_ATTACHMENT.size + GID_SIZE}")
    sequence, time_ns, _ = _ATTACHMENT.unpack_from(data)
    return sequence, time_ns, data[_ATTACHMENT.size :]


def ros_name(text: str) -> str:
    """Return a text as one part of a ROS name, which has letters, digits and underscores, and no digit first."""
    name = re.sub(r"_{2,}", "_", re.sub(r"\W", "_", text, flags=re.ASCII))
    return f"_{name}" if name[:1].isdigit() else name


def _place(node: str) -> str:
    namespace, _, name = node.rpartition("/")
    return f"{_mangled(namespace) or '%'}/{name}"


def _mangled(name: str) -> str:
    return name.replace("/", "%")
