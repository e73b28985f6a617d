"""The definitions of ROS 2 messages and services that the bridge speaks, and their type hashes.

The hash of a type (RIHS01) is computed from the definitions of the type and of all types in it, as in the ROS package
rosidl_runtime_c (`type_hash.c`): two nodes understand each other only if they computed the same.
"""

import hashlib
import json
import re
from dataclasses import dataclass
from functools import cache

from services.errors import ServiceError

_TEXT = """
builtin_interfaces/msg/Time: int32 sec, uint32 nanosec
builtin_interfaces/msg/Duration: int32 sec, uint32 nanosec
std_msgs/msg/Header: builtin_interfaces/msg/Time stamp, string frame_id
std_msgs/msg/String: string data
std_msgs/msg/MultiArrayDimension: string label, uint32 size, uint32 stride
std_msgs/msg/MultiArrayLayout: std_msgs/msg/MultiArrayDimension[] dim, uint32 data_offset
std_msgs/msg/Float64MultiArray: std_msgs/msg/MultiArrayLayout layout, float64[] data
sensor_msgs/msg/JointState: std_msgs/msg/Header header, string[] name, float64[] position, float64[] velocity, float64[] effort
geometry_msgs/msg/Point: float64 x, float64 y, float64 z
geometry_msgs/msg/PointStamped: std_msgs/msg/Header header, geometry_msgs/msg/Point point
geometry_msgs/msg/Vector3: float64 x, float64 y, float64 z
geometry_msgs/msg/Quaternion: float64 x, float64 y, float64 z, float64 w
geometry_msgs/msg/Wrench: geometry_msgs/msg/Vector3 force, geometry_msgs/msg/Vector3 torque
geometry_msgs/msg/WrenchStamped: std_msgs/msg/Header header, geometry_msgs/msg/Wrench wrench
geometry_msgs/msg/Transform: geometry_msgs/msg/Vector3 translation, geometry_msgs/msg/Quaternion rotation
geometry_msgs/msg/TransformStamped: std_msgs/msg/Header header, string child_frame_id, geometry_msgs/msg/Transform transform
tf2_msgs/msg/TFMessage: geometry_msgs/msg/TransformStamped[] transforms
diagnostic_msgs/msg/KeyValue: string key, string value
diagnostic_msgs/msg/DiagnosticStatus: byte level, string name, string message, string hardware_id, diagnostic_msgs/msg/KeyValue[] values
diagnostic_msgs/msg/DiagnosticArray: std_msgs/msg/Header header, diagnostic_msgs/msg/DiagnosticStatus[] status
trajectory_msgs/msg/JointTrajectoryPoint: float64[] positions, float64[] velocities, float64[] accelerations, float64[] effort, builtin_interfaces/msg/Duration time_from_start
trajectory_msgs/msg/JointTrajectory: std_msgs/msg/Header header, string[] joint_names, trajectory_msgs/msg/JointTrajectoryPoint[] points
service_msgs/msg/ServiceEventInfo: uint8 event_type, builtin_interfaces/msg/Time stamp, uint8[16] client_gid, int64 sequence_number
std_srvs/srv/Trigger_Request: uint8 structure_needs_at_least_one_member
std_srvs/srv/Trigger_Response: bool success, string message
diagnostic_msgs/srv/SelfTest_Request: uint8 structure_needs_at_least_one_member
diagnostic_msgs/srv/SelfTest_Response: string id, byte passed, diagnostic_msgs/msg/DiagnosticStatus[] status
"""  # noqa: E501  (one type a line, as its .msg file)
_TYPE_IDS = {
    "int8": 2, "uint8": 3, "int16": 4, "uint16": 5, "int32": 6, "uint32": 7, "int64": 8, "uint64": 9, "float32": 10,
    "float64": 11, "bool": 15, "byte": 16, "string": 17,
}  # fmt: skip
"""The numbers of types in `type_description_interfaces/msg/FieldType`."""
_NESTED, _ARRAY, _BOUNDED, _SEQUENCE = 1, 48, 96, 144
_FIELD = re.compile(r"([\w/]+?)(\[(?:<=)?(\d*)\])? (\w+)")


class UnknownType(ServiceError):
    """A ROS 2 type whose definition is not known here."""


@dataclass(frozen=True, slots=True)
class Field:
    """One field of a type.

    Attributes:
        kind: Primitive type (`float64`) or full name of a nested one (`std_msgs/msg/Header`).
        repeated: `no`; `fixed` for an array; `bounded` or `free` for a sequence.
        capacity: Size of an array, or the bound of a sequence; 0 otherwise.
    """

    name: str
    kind: str
    repeated: str = "no"
    capacity: int = 0

    @property
    def is_nested(self) -> bool:
        """Whether it is a message itself."""
        return "/" in self.kind


def _parse(text: str) -> Field:
    match = _FIELD.fullmatch(text)
    if match is None:
        raise ValueError(f"'{text}' is not a field")
    kind, brackets, number, name = match.groups()
    repeated = "no" if not brackets else "free" if not number else "bounded" if "<=" in brackets else "fixed"
    return Field(name, kind, repeated, int(number or 0))


DEFINITIONS: dict[str, tuple[Field, ...]] = {
    name: tuple(_parse(field) for field in fields.split(", "))
    for name, fields in (line.split(": ", 1) for line in _TEXT.strip().splitlines())
}
"""Full name of a message -> its fields."""


def fields_of(name: str) -> tuple[Field, ...]:
    """Return the fields of a message type.

    Raises:
        UnknownType: It is not one of `DEFINITIONS`.
    """
    if name not in DEFINITIONS:
        known = ", ".join(kind for kind in DEFINITIONS if "_Re" not in kind)
        raise UnknownType(f"The ROS 2 type '{name}' is not known here. Known types: {known}.")
    return DEFINITIONS[name]


@cache
def type_hash(name: str) -> str:
    """Return the hash (`RIHS01_...`) of a message type (`sensor_msgs/msg/JointState`) or service type.

    Raises:
        UnknownType: A type in it is not one of `DEFINITIONS`.
    """
    fields = _service_fields(name) if "/srv/" in name and name not in DEFINITIONS else {name: fields_of(name)}
    descriptions: dict[str, tuple[Field, ...]] = {}
    waiting = dict(fields)
    while waiting:
        kind, members = waiting.popitem()
        descriptions[kind] = members
        nested = (field.kind for field in members if field.is_nested and field.kind not in descriptions)
        waiting |= {one: fields[one] if one in fields else fields_of(one) for one in nested}
    body = {
        "type_description": _described(name, descriptions[name]),
        "referenced_type_descriptions": [_described(n, descriptions[n]) for n in sorted(descriptions) if n != name],
    }
    return "RIHS01_" + hashlib.sha256(json.dumps(body).encode()).hexdigest()


def _service_fields(name: str) -> dict[str, tuple[Field, ...]]:
    """Return the fields of a service type, which has three messages, and of its event message."""
    fields_of(f"{name}_Request"), fields_of(f"{name}_Response")
    event = f"{name}_Event"
    return {
        name: (
            Field("request_message", f"{name}_Request"),
            Field("response_message", f"{name}_Response"),
            Field("event_message", event),
        ),
        event: (
            Field("info", "service_msgs/msg/ServiceEventInfo"),
            Field("request", f"{name}_Request", "bounded", 1),
            Field("response", f"{name}_Response", "bounded", 1),
        ),
    }


def _described(name: str, fields: tuple[Field, ...]) -> dict[str, object]:
    """Return the description of one type, with the keys in the order that is hashed."""
    offsets = {"no": 0, "fixed": _ARRAY, "bounded": _BOUNDED, "free": _SEQUENCE}
    return {
        "type_name": name,
        "fields": [
            {
                "name": field.name,
                "type": {
                    "type_id": (_NESTED if field.is_nested else _TYPE_IDS[field.kind]) + offsets[field.repeated],
                    "capacity": field.capacity,
                    "string_capacity": 0,
                    "nested_type_name": field.kind if field.is_nested else "",
                },
            }
            for field in fields
        ],
    }
