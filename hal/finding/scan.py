"""Who is on a bus: first by listening, then by asking every CANopen node id who it is.

Listening disturbs nobody. Asking means SDO reads of identification objects, which change nothing in a node; but an SDO
server has one client, so nobody is asked while a master is heard (its SYNC, its heartbeat or its own SDO requests).
"""

import time
from dataclasses import dataclass

from hal.config import RobotConfig
from hal.finding.ask import ask_all, look_for_mit
from hal.finding.heard import Found, Heard
from hal.finding.tap import Tap

__all__ = ["Found", "Scan", "compare", "scan"]

LISTEN = 1.5
"""How long to listen first [s]; most nodes send a heartbeat each second or more often."""
ANSWER_TIME = 0.15
"""How long a node may take to answer [s]."""


@dataclass(slots=True)
class Scan:
    """What was found on one bus.

    Attributes:
        bus: Its name.
        nodes: In the order of their ids.
        unknown: Identifier -> frames per second [Hz], of all that no known node explains.
        load: Share of the bit rate while listening, 0 to 1.
        silence: Why nobody was asked; empty if everybody was.
    """

    bus: str
    nodes: list[Found]
    unknown: dict[int, float]
    load: float
    silence: str


def scan(tap: Tap, listen: float = LISTEN, ask: bool = True, mit: bool = False, patience: float = ANSWER_TIME) -> Scan:
    """Find out who is on a bus; takes `listen` and about two seconds.

    Args:
        tap: An open bus.
        listen: How long to listen first [s].
        ask: Whether to ask nodes who they are, unless a master is heard.
        mit: Whether to look for MIT drives by ending their motor mode, which lets go of the joint.
        patience: How long a node may take to answer [s].

    Raises:
        BusGone: The interface failed, or takes no frames.
    """
    heard = Heard()
    deadline = time.monotonic() + listen
    while (remaining := deadline - time.monotonic()) > 0:
        heard.note(tap.receive(min(remaining, 0.1)))
    load = heard.bits / (listen * tap.config.bitrate) if listen else 0.0
    rates = {identifier: count / listen for identifier, count in heard.counts.items()} if listen else {}
    silence = heard.master()
    if not ask:
        silence = silence or "Only listened, as asked."
    if not silence:
        ask_all(tap, heard, patience)
    if mit and not heard.master():
        look_for_mit(tap, heard, patience)
    heard.attribute()
    nodes = sorted(heard.nodes.values(), key=lambda found: (found.protocol, found.node))
    return Scan(tap.name, nodes, {key: rates.get(key, 0.0) for key in heard.unexplained()}, load, silence)


def compare(found: Scan, config: RobotConfig) -> list[str]:
    """What of a bus is not as the robot file says, a sentence each."""
    wanted = {device.node: name for name, device in config.devices.items() if device.bus == found.bus}
    drivers = {node: config.kinds[config.devices[name].kind].driver for node, name in wanted.items()}
    told = []
    there = {one.node: one for one in found.nodes}
    for node, name in wanted.items():
        if node not in there:
            told.append(f"{found.bus}: node {node} ('{name}') was not found. Is it powered, is its node id right?")
            continue
        profile = drivers[node].removeprefix("cia")
        one = there[node]
        if drivers[node].startswith("cia") and one.profile is not None and str(one.profile) != profile:
            told.append(f"{found.bus}: node {node} ('{name}') is a {one.kind}, the robot file says {drivers[node]}.")
    for one in found.nodes:
        if one.node not in wanted:
            told.append(f"{found.bus}: node {one.node} is not in the robot file: {one.kind or 'a CANopen node'}.")
        if one.is_doubled:
            told.append(f"{found.bus}: more than one node answers as node {one.node}. Give each an id of its own.")
    return told
