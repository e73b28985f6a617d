"""The table of roles as zenoh's access control: what the node at one end of a link lets the other end do.

Every exchange needs both directions: a subscriber's declaration in, and the samples out. A rule lets through only keys
that it includes, so that neither a subscription nor a put may be wider than what is allowed.
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from services.wire import keys
from services.wire.roles import ASKED, COMPUTING, RATES, ROLES, SIZES, Role

Rule = tuple[str, tuple[str, ...], tuple[str, ...]]
"""Flow, messages, keys."""
_OPPOSITE = {"ingress": "egress", "egress": "ingress"}
_ALL = (f"{keys.ROOT}/**",)
_EVERY_MESSAGE = (
    "put", "declare_subscriber", "query", "declare_queryable", "reply", "liveliness_token",
    "declare_liveliness_subscriber", "liveliness_query",
)  # fmt: skip
THROUGH: tuple[Rule, ...] = (("ingress", _EVERY_MESSAGE, _ALL), ("egress", _EVERY_MESSAGE, _ALL))
"""Between the routers of a fleet: each has judged its own already."""


def rules_of(role: Role, robots: Iterable[str]) -> list[Rule]:
    """What a role may do with these robots (`*`: all), as seen by the node that it is linked to."""
    names = tuple(robots)

    def of(nouns: Iterable[str]) -> tuple[str, ...]:
        return tuple(keys.robot_key(robot, noun) for robot in names for noun in nouns)

    sees = of(["*/alive"])
    found: list[Rule] = [
        ("ingress", ("declare_liveliness_subscriber", "liveliness_query"), sees),
        ("egress", ("liveliness_token",), sees),
        ("ingress", ("put",), of(role.says)),
        ("egress", ("declare_subscriber",), _ALL if role.says else ()),
        ("ingress", ("declare_subscriber",), of(role.hears)),
        ("egress", ("put",), of(role.hears)),
        ("ingress", ("query",), of(role.asks)),
        ("egress", ("reply", "declare_queryable"), of(role.asks)),
        ("ingress", ("reply", "declare_queryable"), of(role.answers)),
        ("egress", ("query",), of(role.answers)),
        ("ingress", ("liveliness_token",), of(role.alive)),
    ]
    return [rule for rule in found if rule[2]]


def mirrored(rules: Iterable[Rule]) -> list[Rule]:
    """The same as seen from the other end of the link."""
    return [(_OPPOSITE[flow], messages, names) for flow, messages, names in rules]


def access_control(subjects: Mapping[str, tuple[Mapping[str, Sequence[str]], Iterable[Rule]]]) -> dict[str, Any]:
    """Zenoh's `access_control`.

    Args:
        subjects: Name -> how zenoh knows it (certificate, user), and what it may do.
    """
    rules, policies = [], []
    for name, (_, allowed) in subjects.items():
        numbered = {f"{name} {number}": rule for number, rule in enumerate(allowed)}
        rules += [
            {"id": one, "permission": "allow", "flows": [flow], "messages": list(messages), "key_exprs": list(names)}
            for one, (flow, messages, names) in numbered.items()
        ]
        policies.append({"subjects": [name], "rules": list(numbered)})
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": [{"id": name, **how} for name, (how, _) in subjects.items()],
        "policies": policies,
    }


def known_by(name: str, dials: bool) -> dict[str, list[str]]:
    """How a node knows who is at the other end: by certificate, and by user if the other one dialled."""
    return {"cert_common_names": [name]} | ({"usernames": [name]} if dials else {})


def limits(robots: Iterable[str]) -> dict[str, Any]:
    """Rate and size limits of a router; a rule about rates is one budget, so each key has its own."""
    names = list(robots)
    told = [(keys.robot_key(robot, noun), rate) for robot in names for noun, rate in RATES.items()]
    asked = [
        (keys.verb(robot, service, verb), ASKED)
        for robot in names
        for service, role in ROLES.items()
        if role.is_service
        for verb in (COMPUTING if service == "model" else ("describe",))
    ]
    return {
        "downsampling": [
            {
                "flows": ["ingress"],
                "messages": [message],
                "rules": [{"key_expr": key, "freq": rate} for key, rate in of],
            }
            for message, of in (("put", told), ("query", asked))
        ],
        "low_pass_filter": [
            {
                "flows": ["ingress"],
                "messages": ["query" if "/do/" in noun else "put"],
                "key_exprs": [keys.robot_key("*", noun)],
                "size_limit": size,
            }
            for noun, size in SIZES.items()
        ],
    }
