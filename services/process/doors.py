"""The doors of a secured router: an own session, at an own port, for each person and for emergency stops.

zenoh limits the sessions of a router, not of a user. With a session for each person, a person who opens all of its
sessions excludes no other person and no service. A door is linked with the router like a router of a fleet.
"""

import copy
from collections.abc import Mapping
from typing import Any

from services.wire.connect import host_and_port
from services.wire.member import doors_in


def door_settings(configuration: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Return name -> zenoh configuration of the doors in the router's role file; empty without a role file.

    Args:
        configuration: The router's own configuration, which the doors share but for the listed sections.
    """
    return {name: _door(configuration, door) for name, door in doors_in(configuration).items()}


def _door(router: Mapping[str, Any], described: Mapping[str, Any]) -> dict[str, Any]:
    door: dict[str, Any] = copy.deepcopy(dict(router))
    door["listen"] |= {"endpoints": [described["listen"]]}
    door["connect"] |= {"endpoints": [_inside(router["listen"]["endpoints"][0])]}
    door["access_control"] = described["access_control"]
    transport = door["transport"]
    transport["unicast"] |= {"max_sessions": described["sessions"] + 1}  # and the link to the router
    transport["auth"]["usrpwd"]["dictionary"] = dict(described["dictionary"])
    # The certificate must be the router's, which access control checks; it need not name this address.
    transport["link"]["tls"] |= {"verify_name_on_connect": False}
    return door


def _inside(endpoint: str) -> str:
    """Return the endpoint on this machine of a listening endpoint."""
    protocol, _, place = endpoint.partition("/")
    host, port = host_and_port(place)
    return f"{protocol}/{'127.0.0.1' if host in ('0.0.0.0', '[::]') else host}:{port}"
