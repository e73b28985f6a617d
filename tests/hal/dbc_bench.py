"""A joint with an ODrive and a load cell, both by their DBC files, in the lockstep of `hal_bench`."""

import itertools
import math

import numpy as np
from hal_bench import ROBOTS, Bench

from hal.config import RobotConfig
from simulators.nodes.canopen.spec import NodeSpec
from simulators.nodes.dbc_cell import DbcCellConstants
from simulators.nodes.odrive import OdriveConstants
from simulators.robots.bench.world import BenchWorld

_numbers = itertools.count()
QUANTITIES = {"position": "joint_position", "velocity": "joint_velocity", "effort": "joint_effort"}

CELL = {
    "dbc": "dbc/load_cell.dbc",
    "node_offset": 1,
    "periods": {"Force": 0.005},
    "quantities": {
        "force": {"signal": "Force.Force"},
        "temperature": {"signal": "Force.Temperature"},
    },
    "error": {"signal": "Force.Status", "good": "GOOD"},
    "tare": [{"send": "Request", "values": {"Action": "TARE"}}],
}


def description(mode="position", odrive=None, cell=None, driver="odrive", **changes):
    """A robot file as a mapping: one axis (node 3) that is commanded in `mode`, one cell (node 7)."""
    number = next(_numbers)
    signals = {
        "joint_position": {"unit": "rad", "elements": ["elbow"], "stale_after": 0.05},
        "joint_velocity": {"unit": "rad/s", "elements": ["elbow"], "stale_after": 0.05},
        "wire_force": {"unit": "N", "elements": ["elbow"], "stale_after": 0.05},
    }
    elements = {"position": "joint_position.elbow", "velocity": "joint_velocity.elbow"}
    periods = {}
    if mode == "effort":
        signals["joint_effort"] = {"unit": "N m", "elements": ["elbow"], "stale_after": 0.05}
        elements["effort"] = "joint_effort.elbow"
        periods = {"Get_Torques": 0.01}
    settings = {"dbc": "dbc/odrive_cansimple.dbc", "mode": mode, "gear": 8.0, "zero": 0.25, "periods": periods}
    body = {
        "robot": "dbc_bench",
        "signals": signals,
        "command": {"signal": QUANTITIES[mode], "time_to_live": 0.1, "hold": 0.5},
        "limits": {
            "joint_position": {"low": -2.0, "high": 2.0, **({"rate": 2.0} if mode == "position" else {})},
            **({"joint_velocity": {"low": -3.0, "high": 3.0}} if mode == "velocity" else {}),
            **({"joint_effort": {"low": -8.0, "high": 8.0}} if mode == "effort" else {}),
        },
        **({"stop": {"behaviour": "off"}} if mode == "effort" else {}),
        "rates": {"hal": 200},
        "buses": {"can0": {"interface": "virtual", "channel": f"dbc_bench_{number}"}},
        "kinds": {
            "axis": {"driver": driver, "settings": {**settings, **(odrive or {})}},
            "cell": {"driver": "dbc", "settings": {**CELL, **(cell or {})}},
        },
        "devices": {
            "elbow_axis": {"kind": "axis", "bus": "can0", "node": 3, "elements": elements},
            "elbow_cell": {"kind": "cell", "bus": "can0", "node": 7, "element": "wire_force.elbow"},
        },
        "folder": ROBOTS,
    }
    return {**body, **changes}


def dbc_bench(mode="position", constants=None, cell=None, cell_settings=None, **changes):
    """The bench of such a robot; `constants` are those of the axis, `cell` those of the cell."""
    config = RobotConfig.model_validate(description(mode, cell=cell_settings, **changes))
    axis = {"zero": 0.25, "torques": 0.01 if mode == "effort" else 0.0, **(constants or {})}
    nodes = [
        NodeSpec("elbow_axis", "can0", 3, "joint_position.elbow", OdriveConstants(**axis)),
        NodeSpec("elbow_cell", "can0", 7, "wire_force.elbow", DbcCellConstants(**(cell or {}))),
    ]
    world = BenchWorld(config)
    world.break_part("set:joint_position.elbow:0.6")
    return Bench(config, nodes=nodes, world=world)


def opened(bench):
    """The bench, open and with both devices ready; a machine under load may need more than one try.

    A watchdog that ran out meanwhile is reset in the first cycles, and the heartbeat says so 20 cycles later.
    """
    bench.open()
    bench.until(lambda: bench.states() == {"ready"}, "ready")
    bench.cycle(45)
    return bench


def axis(bench):
    """The simulated axis."""
    return bench.rig.node("elbow_axis")


def position(bench):
    """Where the joint is [rad]."""
    return float(bench.world.truth()["joint_position"][0])


def turns(angle):
    """Motor turns at an angle [rad] of the joint."""
    return (angle - 0.25) * 8.0 / (2.0 * math.pi)


def follow(bench, desired, cycles):
    bench.follow(np.array([desired]), cycles)
