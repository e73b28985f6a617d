"""Choice of the arm in a URDF: one chain of joints with motors, and the link whose place a camera measures."""

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hal.errors import ConfigError
from hal.finding.draft.parts import is_text
from simulators.robots.urdf_arm.tree import Joint, Tree, numbers

MOST_JOINTS = 16
"""An arm has at most this many joints: two buses carry the drives and encoders of these."""
SHORTEST = 0.01
"""The tip is at least this far from the first joint [m]."""
FINGERS = 2
"""Chains behind a link that have at most this many joints each are fingers: the arm ends at the link before them."""
HAND = re.compile(r"finger|gripper|jaw|thumb|index|knuckle|hand")
"""Joints at the end of a chain with one of these words open a hand and do not move an arm."""
TOOLS = ("tool", "tcp", "tip", "ee", "eef", "end_effector", "grasp", "attachment", "pinch", "gripperframe")
HANDS = ("hand", "gripper", "flange")
"""Among the links that are fixed to the last one, the tip is the last one with one of the words of tools, or else the
first one with one of the words of hands, the first word first."""
NO_TIP = re.compile(r"camera|sensor|optical|finger|imu|inertia|_[xyz]$")
"""A link with one of these words is no tip unless there is no other."""


@dataclass(frozen=True, slots=True)
class Arm:
    """A chain of a URDF, whose first link stands still.

    Attributes:
        tree: The whole URDF; joints that are not in the arm are held.
        joints: Joints of the arm, base first.
        tip: Link whose origin is the tool tip.
        notes: Sentences on what was chosen and left out.
    """

    tree: Tree
    joints: tuple[Joint, ...]
    tip: str
    notes: tuple[str, ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the joints as elements of a signal: letters, digits and underscores."""
        names: list[str] = []
        for joint in self.joints:
            name = element_name(joint.name)
            names.append(name if name not in names else f"{name}_{len(names)}")
        return tuple(names)

    @property
    def offset(self) -> np.ndarray:
        """Place of the tip in its link's frame [m], shape (3,): 0, or the centre of mass if only that moves."""
        way = self.tree.way(self.tip)
        if any(np.any(joint.shift) for joint in way[way.index(self.joints[0]) + 1 :]):
            return np.zeros(3)
        origin = self.tree.links[self.tip].find("inertial/origin")
        return numbers(None if origin is None else origin.get("xyz"), (0.0, 0.0, 0.0), f"link '{self.tip}'")

    @property
    def reach(self) -> float:
        """Longest distance from the first joint to the tip [m]: the sum of the distances between joints."""
        way = self.tree.way(self.tip)
        first = way.index(self.joints[0])
        rest = sum(float(np.linalg.norm(joint.shift)) + _slide(joint) for joint in way[first + 1 :])
        return rest + float(np.linalg.norm(self.offset))


def _slide(joint: Joint) -> float:
    return abs(joint.rest) if joint.kind == "prismatic" else 0.0


def element_name(text: str) -> str:
    """Return a name of letters, digits and underscores, which YAML takes for no number and no truth value."""
    name = plain_name(text) or "joint"
    return name if is_text(name) else f"joint_{name}"


def plain_name(text: str) -> str:
    """Return a text with an underscore in place of each run of other characters than letters and digits."""
    return re.sub(r"\W+", "_", text, flags=re.ASCII).strip("_")


def arm_of(tree: Tree, joints: Sequence[str], tip: str) -> Arm:
    """Return the arm of a robot file, given its joints as elements and its tip.

    Raises:
        ConfigError: The URDF has no such tip, or other joints before it.
    """
    if tip not in tree.links:
        raise ConfigError(f"'{tree.path}' has no link '{tip}'. Known links: {', '.join(tree.links)}.")
    arm = Arm(tree, _driven(tree, tip), tip)
    if arm.names != tuple(joints):
        raise ConfigError(
            f"The joints of the robot file, {', '.join(joints)}, are not those of '{tree.path}' before '{tip}': "
            f"{', '.join(arm.names)}."
        )
    return arm


def choose_arm(tree: Tree, tip: str | None = None) -> Arm:
    """Choose the chain with the most joints, or the chain to a link.

    Raises:
        ConfigError: The URDF has no joint that a motor turns, the link is unknown, or its chain is too long.
    """
    chains = _chains(tree)
    if not chains:
        kinds = sorted({joint.kind for joint in tree.before.values()} - {"fixed"}) or ["fixed"]
        raise ConfigError(
            f"'{tree.path}' has no joint that a motor turns, so there is no arm in it. Its joints: {', '.join(kinds)}."
        )
    if tip is not None and tip not in tree.links:
        known = ", ".join(dict.fromkeys([*chains, *tree.links]))
        raise ConfigError(f"'{tree.path}' has no link '{tip}'. Known links, ends of chains first: {known}.")
    chosen = tip or next(iter(chains))
    joints = _driven(tree, chosen)
    if not joints:
        raise ConfigError(f"No motor moves '{chosen}'. Links that one moves: {', '.join(chains)}.")
    if len(joints) > MOST_JOINTS:
        raise ConfigError(
            f"'{tree.path}' has {len(joints)} joints before '{chosen}', but an arm has at most {MOST_JOINTS}. "
            "Name a link nearer to the base by --tip."
        )
    arm = Arm(tree, joints, chosen, tuple(_notes(tree, joints, chosen, [] if tip else list(chains)[1:])))
    if arm.reach < SHORTEST:
        others = [end for end in chains if end != chosen and Arm(tree, _driven(tree, end), end).reach >= SHORTEST]
        hint = f"Name another end by --tip: {', '.join(others)}." if others else "No other end has an arm before it."
        raise ConfigError(
            f"'{chosen}' of '{tree.path}' turns in place, as wheels do, so no camera can see how its joints move it. "
            f"{hint}"
        )
    return arm


def _chains(tree: Tree) -> dict[str, int]:
    """Return the ends of all chains with their number of joints, the preferred one first."""
    ends: dict[str, int] = {}
    for leaf in tree.leaves():
        end = _palm(tree, leaf)
        if count := len(_driven(tree, end)):
            ends[_tool(tree, end)] = count
    ends = {end: count for end, count in ends.items() if not _is_part(tree, end, [one for one in ends if one != end])}
    order = list(ends)
    return dict(sorted(ends.items(), key=lambda item: (_rank(tree, *item), -order.index(item[0])), reverse=True))


def _is_part(tree: Tree, end: str, others: Sequence[str]) -> bool:
    """Whether another chain has all joints of this one and more."""
    own = {joint.name for joint in _driven(tree, end)}
    return any(own < {joint.name for joint in _driven(tree, other)} for other in others)


def _rank(tree: Tree, end: str, count: int) -> tuple[bool, int, bool]:
    """Return the rank of a chain: an arm before a leg, then by its joints, then the right one."""
    words = " ".join(joint.name.lower() for joint in tree.way(end))
    is_leg = bool(re.search(r"leg|foot|ankle|knee|hip|thigh|calf|wheel|head|neck", words))
    return not is_leg, min(count, MOST_JOINTS), "right" in words or bool(re.search(r"\br_|_r\b", words))


def _palm(tree: Tree, link: str) -> str:
    """Return the link before the fingers; the link itself if it is no part of a finger."""
    way = tree.way(link)
    for joint in way:
        branches = [j for j in tree.behind[joint.parent] if _moving_behind(tree, j)]
        behind = max(_moving_behind(tree, j) for j in branches) if branches else 0
        if len(branches) > 1 and behind <= FINGERS and _driven(tree, joint.parent):
            return joint.parent
    arm = _driven(tree, link)
    hand = {joint.name for joint in arm if HAND.search(joint.name.lower())}
    while way and len(hand) < len(arm) and (way[-1].name in hand or not (way[-1].is_driven or way[-1].kind == "fixed")):
        link, way = way[-1].parent, way[:-1]
    return link


def _moving_behind(tree: Tree, joint: Joint) -> int:
    """Return the largest number of joints that are not fixed, from a joint on towards any leaf."""
    own = int(joint.kind != "fixed")
    return own + max((_moving_behind(tree, behind) for behind in tree.behind[joint.child]), default=0)


def _tool(tree: Tree, link: str) -> str:
    """Return the link that is most likely the tool, among a link and all that are fixed to it."""
    while link in tree.before and tree.before[link].kind == "fixed":
        link = tree.before[link].parent
    fixed = [link]
    for one in fixed:
        fixed += [joint.child for joint in tree.behind[one] if joint.kind == "fixed"]
    usual = [one for one in fixed if not NO_TIP.search(one.lower())] or fixed
    for word in (*TOOLS, *HANDS):
        named = [one for one in usual if re.search(rf"(^|_){word}", one.lower())]
        if named:
            return named[0 if word in HANDS else -1]
    ends = [one for one in usual if not any(joint.kind == "fixed" for joint in tree.behind[one])]
    return ends[0] if ends else link


def _driven(tree: Tree, link: str) -> tuple[Joint, ...]:
    return tuple(joint for joint in tree.way(link) if joint.is_driven)


def _notes(tree: Tree, joints: Sequence[Joint], tip: str, others: Sequence[str]) -> list[str]:
    notes = []
    if others:
        more = f" and {len(others) - 6} more" if len(others) > 6 else ""
        notes.append(f"Other chains, for --tip: {', '.join(others[:6])}{more}.")
    way = tree.way(tip)
    held = [joint.name for joint in way if joint.kind != "fixed" and not joint.is_driven]
    rest = sum(joint.is_driven or joint.kind == "prismatic" for joint in tree.before.values())
    rest -= len(joints) + len(held)
    if held:
        notes.append(f"Held still, because one signal has one unit, or because they mimic another: {', '.join(held)}.")
    if rest > 0:
        notes.append(f"{rest} joints that are not part of this chain are held still.")
    return notes
