"""Whether this page has buttons: only for an operator, and only where nobody else can press them."""

from services.wire.member import Member
from services.wire.session import is_loopback


def why_read_only(member: Member, robot: str, host: str) -> str:
    """Why this page has no buttons, in one sentence; empty if it has."""
    if not member.is_for(robot):
        return f"Read only: the role file is for {', '.join(member.robots) or 'no robot'}, not for '{robot}'."
    if not member.may_publish(robot, "hal/command") or not member.may_ask(robot, "hal", "enable"):
        return f"Read only: the role is {member.role}, not operator."
    if not is_loopback(host):
        return f"Read only: the page is served on {host} to anybody; there are buttons on 127.0.0.1 only."
    return ""
