"""Frames of an ODrive axis written out by hand from the documented CANSimple protocol: they pin driver and simulator.

Source: docs.odriverobotics.com, CAN Protocol. Identifier = node id * 32 + command; all values little endian.
"""

import struct

import pytest
from dbc_bench import description
from hal_bench import ROBOTS

from hal.clock import SystemClock
from hal.config import RobotConfig
from hal.device import DeviceState
from hal.fleet import build
from hal.protocols import dbc
from simulators.nodes.canopen.spec import NodeSpec
from simulators.nodes.odrive import OdriveAxis, OdriveConstants
from simulators.nodes.plant import Plant, Snapshot

FILE = dbc.load(ROBOTS / "dbc" / "odrive_cansimple.dbc")
COMMANDS = {
    "Get_Version": 0x00,
    "Heartbeat": 0x01,
    "Estop": 0x02,
    "Get_Error": 0x03,
    "Address": 0x06,
    "Set_Axis_State": 0x07,
    "Get_Encoder_Estimates": 0x09,
    "Set_Controller_Mode": 0x0B,
    "Set_Input_Pos": 0x0C,
    "Set_Input_Vel": 0x0D,
    "Set_Input_Torque": 0x0E,
    "Set_Limits": 0x0F,
    "Set_Traj_Vel_Limit": 0x11,
    "Set_Traj_Accel_Limits": 0x12,
    "Set_Traj_Inertia": 0x13,
    "Get_Iq": 0x14,
    "Get_Temperature": 0x15,
    "Reboot": 0x16,
    "Get_Bus_Voltage_Current": 0x17,
    "Clear_Errors": 0x18,
    "Set_Absolute_Position": 0x19,
    "Set_Pos_Gain": 0x1A,
    "Set_Vel_Gains": 0x1B,
    "Get_Torques": 0x1C,
    "Get_Powers": 0x1D,
}


def axis(mode="position", **settings):
    """The driver of node 3, behind a bus that is never opened."""
    _, devices = build(RobotConfig.model_validate(description(mode, odrive=settings)), SystemClock())
    return devices[0]


def frame(step):
    return f"{step.frame.arbitration_id:03X} {step.frame.data.hex(' ')}".upper().strip()


def test_command_numbers():
    assert {message.name: message.frame_id for message in FILE.messages} == COMMANDS


@pytest.mark.parametrize(
    ("signal", "data", "value"),
    [
        ("Heartbeat.Axis_Error", "00 02 00 00 01 03 00 00", 0x200),
        ("Heartbeat.Axis_State", "00 02 00 00 08 03 01 00", 8),
        ("Heartbeat.Procedure_Result", "00 02 00 00 01 03 00 00", 3),
        ("Heartbeat.Trajectory_Done_Flag", "00 00 00 00 08 00 01 00", 1),
        ("Get_Error.Disarm_Reason", "00 00 00 00 00 00 00 01", 0x1000000),
        ("Get_Encoder_Estimates.Pos_Estimate", "00 00 C0 3F 00 00 20 C1", 1.5),
        ("Get_Encoder_Estimates.Vel_Estimate", "00 00 C0 3F 00 00 20 C1", -10.0),
        ("Get_Iq.Iq_Measured", "00 00 00 00 00 00 80 3F", 1.0),
        ("Get_Temperature.FET_Temperature", "00 00 0C 42 00 00 F0 41", 35.0),
        ("Get_Bus_Voltage_Current.Bus_Voltage", "00 00 C0 41 00 00 00 00", 24.0),
        ("Get_Torques.Torque_Estimate", "00 00 00 00 00 00 00 BF", -0.5),
        ("Address.Serial_Number", "03 94 43 66 34 32 35 00", 0x353234664394),
    ],
)
def test_what_an_axis_says(signal, data, value):
    message, found = FILE.signal(signal)
    assert dbc.SignalReader(message, [found.name]).read(bytes.fromhex(data)) == (value,)


def test_errors_and_states_by_number():
    errors, states = FILE.signal("Heartbeat.Axis_Error")[1], FILE.signal("Heartbeat.Axis_State")[1]
    for number, words in (
        (0x0000_0100, "dc bus over voltage"),
        (0x0000_0200, "dc bus under voltage"),
        (0x0000_1000, "current limit violation"),
        (0x0100_0000, "watchdog timer expired"),
        (0x0200_0000, "estop requested"),
        (0x0400_0000, "spinout detected"),
    ):
        assert dbc.describe(errors, number, is_bits=True) == words
    assert [dbc.describe(states, number) for number in (1, 8, 11)] == ["idle", "closed loop control", "homing"]


@pytest.mark.parametrize(
    ("mode", "control", "identifier", "zero", "moved"),
    [
        # 0.25 rad is 0 turns (the bench's zero); pi/4 further behind a gear of 8 is one turn
        ("position", "03", 0x06C, "00 00 00 00 00 00 00 00", "00 00 80 3F 00 00 00 00"),
        # pi/4 rad/s is one turn/s
        ("velocity", "02", 0x06D, "00 00 00 00 00 00 00 00", "00 00 80 3F 00 00 00 00"),
        # 8 N m at the joint is 1 N m at the motor
        ("effort", "01", 0x06E, "00 00 00 00 00 00 00 00", "00 00 80 3F 00 00 00 00"),
    ],
)
def test_set_points(mode, control, identifier, zero, moved):
    device = axis(mode)
    unit = {"position": 0.7853981633974483, "velocity": 0.7853981633974483, "effort": 8.0}[mode]
    offset = 0.25 if mode == "position" else 0.0
    for value, data in ((offset, zero), (offset + unit, moved)):
        device._writer.write((value - device._offset) / device._scale)
        assert device._frame.data == bytes.fromhex(data)
    assert device._frame.arbitration_id == identifier
    enable = [frame(step) for step in device._sequences["enabling"]]
    assert enable == [f"06B {control} 00 00 00 01 00 00 00", "067 08 00 00 00 00 00 00 00"]


def test_the_way_out_of_motion_and_of_faults():
    device = axis()
    assert [frame(step) for step in device._sequences["disabling"]] == ["067 01 00 00 00 00 00 00 00"]
    assert [frame(step) for step in device._sequences["quick stop"]] == [
        "06B 02 00 00 00 01 00 00 00",
        "06D 00 00 00 00 00 00 00 00",
        "067 01 00 00 00 00 00 00 00",
        "062",
    ]
    assert [frame(step) for step in device._sequences["reset"]] == ["078 00"]


def test_who_is_asked_for():
    asked = axis()._identity_request[0].frame
    assert (asked.arbitration_id, asked.is_remote_frame, asked.is_extended_id) == (0x7E6, True, False)


@pytest.mark.parametrize(
    ("data", "state"),
    [
        ("00 00 00 00 01 00 00 00", DeviceState.READY),
        ("00 00 00 00 08 00 00 00", DeviceState.ENABLED),
        ("00 00 00 00 0B 00 00 00", DeviceState.HOMING),
        ("00 00 00 00 05 00 00 00", DeviceState.FAULT),
        ("00 20 00 00 01 03 00 00", DeviceState.FAULT),
        ("00 00 00 01 01 03 00 00", DeviceState.READY),  # the watchdog at rest
    ],
)
def test_states(data, state):
    device = axis()
    device.is_commissioned = True
    device.missed = 0
    device._bus.subscriber(0x061)(bytearray.fromhex(data), 1.0)
    assert device.health().state is state


def simulated(**constants):
    outbox = []
    plant = Plant({"joint_position.elbow": ("joint_position", 0)}, Snapshot(0.0, {"joint_position": [0.0]}))
    node = OdriveAxis(NodeSpec("a", "can0", 3, "joint_position.elbow", OdriveConstants(**constants)), plant, outbox)
    node.power_up(0.0)
    for number in range(1, 61):
        node.tick(number * 0.005)
    return node, outbox


def test_the_simulated_axis_hears_the_same_frames():
    node, outbox = simulated(watchdog=None)
    routes = node.routes()
    assert (0x061, bytes.fromhex("01 00 00 00 00 00 00 00")) in outbox  # starting up
    assert outbox[-1][0] in (0x061, 0x069)
    routes[0x06B](bytes.fromhex("03 00 00 00 01 00 00 00"), 0.3)
    routes[0x06C](bytes.fromhex("00 00 80 3F E8 03 0C FE"), 0.3)
    assert (node.control_mode, node.input) == (3, {3: 1.0, 2: 1.0, 1: -0.5})
    routes[0x067](bytes.fromhex("08 00 00 00"), 0.3)
    assert node.condition == "closed loop control"
    outbox.clear()
    routes[0x062](b"", 0.3)
    node.tick(0.4)
    assert (0x061, bytes.fromhex("00 00 00 02 01 03 00 00")) in outbox
    assert struct.pack("<ff", 0.0, 0.0) in [data for identifier, data in outbox if identifier == 0x069]
