"""Access control of zenoh, made from the table of roles: the messages that a node accepts on a link.

Every exchange needs both directions: a subscriber's declaration comes in, and the samples go out. A rule matches only
keys that the rule includes, so a subscription or a put on more keys than allowed is refused.
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from services.wire import keys
from services.wire.roles import ASKED, COMPUTING, RATES, ROLES, SIZES, Role

Rule = tuple[str, tuple[str, ...], tuple[str, ...]]
"""A rule is a flow, the allowed messages in this flow, and the allowed keys."""
Subject = tuple[Mapping[str, Sequence[str]], Iterable[Rule]]
"""A subject is a certificate and a user that identify it, and its rules."""
_OPPOSITE = {"ingress": "egress", "egress": "ingress"}
_ALL = (f"{keys.ROOT}/**",)
_EVERY_MESSAGE = (
    "put", "declare_subscriber", "query", "declare_queryable", "reply", "liveliness_token",
    "declare_liveliness_subscriber", "liveliness_query",
)  # fmt: skip
THROUGH: tuple[Rule, ...] = (("ingress", _EVERY_MESSAGE, _ALL), ("egress", _EVERY_MESSAGE, _ALL))
"""These rules hold between the routers of a fleet, since each router has checked its own members already."""


def rules_of(role: Role, robots: Iterable[str]) -> list[Rule]:
    """Return the rules of a role for these robots (`*`: all), for the node at the other end of its link."""
    names = tuple(robots)

    def of(nouns: Iterable[str]) -> tuple[str, ...]:
        return tuple(keys.robot_key(robot, noun) for robot in names for noun in nouns)

    tokens = of(["*/alive"])
    rules: list[Rule] = [
        ("ingress", ("declare_liveliness_subscriber", "liveliness_query"), tokens),
        ("egress", ("liveliness_token",), tokens),
        ("ingress", ("put",), of(role.publishes)),
        ("egress", ("declare_subscriber",), _ALL if role.publishes else ()),
        ("ingress", ("declare_subscriber",), of(role.subscribes)),
        ("egress", ("put",), of(role.subscribes)),
        ("ingress", ("query",), of(role.asks)),
        ("egress", ("reply", "declare_queryable"), of(role.asks)),
        ("ingress", ("reply", "declare_queryable"), of(role.answers)),
        ("egress", ("query",), of(role.answers)),
        ("ingress", ("liveliness_token",), of(role.alive)),
    ]
    return [rule for rule in rules if rule[2]]


def mirrored(rules: Iterable[Rule]) -> list[Rule]:
    """Return the same rules for the other end of the link."""
    return [(_OPPOSITE[flow], messages, names) for flow, messages, names in rules]


def access_control(subjects: Mapping[str, Subject]) -> dict[str, Any]:
    """Return zenoh's section `access_control`.

    Args:
        subjects: Name -> certificate and user that identify the subject, and its rules.
    """
    rules, policies = [], []
    for name, (_, allowed) in subjects.items():
        numbered = {f"{name} {number}": rule for number, rule in enumerate(allowed)}
        rules += [
            {
                "id": rule_id,
                "permission": "allow",
                "flows": [flow],
                "messages": list(messages),
                "key_exprs": list(names),
            }
            for rule_id, (flow, messages, names) in numbered.items()
        ]
        policies.append({"subjects": [name], "rules": list(numbered)})
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": [{"id": name, **identity} for name, (identity, _) in subjects.items()],
        "policies": policies,
    }


def identity_of(name: str, dials: bool) -> dict[str, list[str]]:
    """Return the identity of the other end of a link: its certificate, and also its user if it opened the link."""
    return {"cert_common_names": [name]} | ({"usernames": [name]} if dials else {})


def limits(robots: Iterable[str]) -> dict[str, Any]:
    """Return rate and size limits of a router; all keys of a rate rule share its rate, so each key has its own rule."""
    names = list(robots)
    published = [(keys.robot_key(robot, noun), rate) for robot in names for noun, rate in RATES.items()]
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
                "rules": [{"key_expr": key, "freq": rate} for key, rate in rates],
            }
            for message, rates in (("put", published), ("query", asked))
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
