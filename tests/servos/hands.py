"""Masters of other authors, one per word on the command line. Runs in their environment, not in ours.

python hands.py scservo|dynamixel|rustypot_sts|rustypot_xl330|lerobot_feetech|lerobot_dynamixel PORT   three servos
python hands.py damiao CHANNEL INTERFACE | motorbridge CHANNEL                                         one MIT drive

Each reads where servos 1, 2 and 5 are, enables them, moves them to 2300, 1900 and 2100 counts, and prints what it saw.
"""

import json
import sys
import time

NODES = (1, 2, 5)
GOALS = (2300, 1900, 2100)
SETTLE = 1.5


def scservo(port):
    """Feetech's own SDK."""
    from scservo_sdk import GroupSyncRead, GroupSyncWrite, PacketHandler, PortHandler

    line, packets = PortHandler(port), PacketHandler(0)
    assert line.openPort() and line.setBaudRate(1_000_000)
    pings = {node: packets.ping(line, node) for node in (*NODES, 9)}
    before = {node: packets.read2ByteTxRx(line, node, 56) for node in NODES}
    for node in NODES:
        assert packets.write2ByteTxRx(line, node, 42, before[node][0]) == (0, 0)
        assert packets.write1ByteTxRx(line, node, 40, 1) == (0, 0)
    group = GroupSyncWrite(line, packets, 42, 2)
    for node, goal in zip(NODES, GOALS, strict=True):
        assert group.addParam(node, [goal & 0xFF, goal >> 8])
    assert group.txPacket() == 0
    time.sleep(SETTLE)
    reader = GroupSyncRead(line, packets, 56, 8)
    for node in NODES:
        reader.addParam(node)
    result = reader.txRxPacket()
    after = {
        node: [reader.getData(node, 56, 2), reader.getData(node, 62, 1), reader.getData(node, 63, 1)] for node in NODES
    }
    for node in NODES:
        packets.write1ByteTxRx(line, node, 40, 0)
    line.closePort()
    return {"pings": pings, "before": [before[node][0] for node in NODES], "result": result, "after": after}


def dynamixel(port):
    """Robotis' own SDK."""
    from dynamixel_sdk import GroupSyncRead, GroupSyncWrite, PacketHandler, PortHandler

    line, packets = PortHandler(port), PacketHandler(2.0)
    assert line.openPort() and line.setBaudRate(1_000_000)
    everybody, result = packets.broadcastPing(line)
    pings = {node: packets.ping(line, node) for node in (*NODES, 9)}
    before = [packets.read4ByteTxRx(line, node, 132)[0] for node in NODES]
    on = [packets.write1ByteTxRx(line, node, 64, 1) for node in NODES]
    locked = packets.write1ByteTxRx(line, 1, 11, 1)  # with torque on this is an access error
    beyond = packets.write4ByteTxRx(line, 1, 116, 5000)
    group = GroupSyncWrite(line, packets, 116, 4)
    for node, goal in zip(NODES, GOALS, strict=True):
        assert group.addParam(node, list(goal.to_bytes(4, "little")))
    assert group.txPacket() == 0
    time.sleep(SETTLE)
    reader = GroupSyncRead(line, packets, 126, 21)
    for node in NODES:
        reader.addParam(node)
    sync = reader.txRxPacket()
    after = {
        node: [reader.getData(node, 132, 4), reader.getData(node, 144, 2), reader.getData(node, 146, 1)]
        for node in NODES
    }
    watch = packets.write1ByteTxRx(line, 1, 98, 5)
    time.sleep(0.3)
    expired = packets.read1ByteTxRx(line, 1, 98)
    refused = packets.write4ByteTxRx(line, 1, 116, 2048)
    packets.write1ByteTxRx(line, 1, 98, 0)
    for node in NODES:
        packets.write1ByteTxRx(line, node, 64, 0)
    reboot = packets.reboot(line, 1)
    time.sleep(0.5)
    alive = packets.ping(line, 1)
    line.closePort()
    return {
        "everybody": {int(node): model[0] for node, model in everybody.items()}, "result": result, "pings": pings,
        "before": before, "on": on, "locked": locked, "beyond": beyond, "sync": sync, "after": after, "watch": watch,
        "expired": expired, "refused": refused, "reboot": reboot, "alive": alive,
    }  # fmt: skip


def _rusty(controller):
    before = [controller.read_raw_data(node, controller.ADDRESS, controller.SIZE) for node in NODES]
    pings = [bool(controller.ping(node)) for node in NODES]
    positions = [float(value) for value in controller.sync_read_present_position(list(NODES))]
    for node in NODES:
        controller.write_torque_enable(node, True)
    turn = 2 * 3.141592653589793 / 4096
    controller.sync_write_goal_position(list(NODES), [(goal - 2048) * turn for goal in GOALS])
    time.sleep(SETTLE)
    after = [float(value) / turn + 2048 for value in controller.sync_read_present_position(list(NODES))]
    for node in NODES:
        controller.write_torque_enable(node, False)
    return {"pings": pings, "positions": positions, "after": after, "before": [list(map(int, raw)) for raw in before]}


class _Named:
    """A controller of rustypot, with the place of its position."""

    def __init__(self, controller, address, size):
        self._controller = controller
        self.ADDRESS, self.SIZE = address, size

    def __getattr__(self, name):
        return getattr(self._controller, name)


def rustypot_sts(port):
    """rustypot, as Reachy Mini and others use it, with Feetech's servos."""
    import rustypot

    return _rusty(_Named(rustypot.Sts3215PyController(port, 1_000_000, 0.1), 56, 2))


def rustypot_xl330(port):
    """rustypot with Dynamixel's servos."""
    import rustypot

    return _rusty(_Named(rustypot.Xl330PyController(port, 1_000_000, 0.1), 132, 4))


def _lerobot(bus, kind, port, model):
    from lerobot.motors import Motor, MotorNormMode

    names = {f"joint_{node}": Motor(node, model, MotorNormMode.RANGE_M100_100) for node in NODES}
    bus = bus(port, names)
    bus.connect()  # finds every motor and compares its model
    before = bus.sync_read("Present_Position", normalize=False)
    with bus.torque_disabled():  # as LeRobot's robots do it
        bus.configure_motors()
    bus.sync_write("Goal_Position", dict(zip(names, GOALS, strict=True)), normalize=False)
    time.sleep(SETTLE)
    after = bus.sync_read("Present_Position", normalize=False)
    seen = bus.broadcast_ping()
    delay = bus.read("Return_Delay_Time", "joint_1", normalize=False)
    bus.disconnect()  # switches the torque off
    return {"before": list(before.values()), "after": list(after.values()), "seen": seen, "delay": delay, "kind": kind}


def lerobot_feetech(port):
    """LeRobot's own bus, as SO-101 has it."""
    from lerobot.motors.feetech import FeetechMotorsBus

    return _lerobot(FeetechMotorsBus, "feetech", port, "sts3215")


def lerobot_dynamixel(port):
    """LeRobot's own bus, as Koch has it."""
    from lerobot.motors.dynamixel import DynamixelMotorsBus

    return _lerobot(DynamixelMotorsBus, "dynamixel", port, "xm430-w350")


def damiao(channel, interface):
    """damiao-motor, on the bus of any python-can interface."""
    from damiao_motor import DaMiaoController

    controller = DaMiaoController(channel=channel, bustype=interface)
    motor = controller.add_motor(motor_id=4, feedback_id=0x14, motor_type="4310")
    ranges = [motor.get_register(rid, timeout=2.0) for rid in (21, 22, 23)]
    motor.write_register(10, 1)  # its ensure_control_mode compares with the value that it read before the write
    time.sleep(0.1)
    motor.registers.clear()
    assert motor.get_register(10) == 1
    controller.enable_all()
    end = time.monotonic() + 1.5
    while time.monotonic() < end:
        motor.send_cmd_mit(
            target_position=0.5, target_velocity=0.0, stiffness=40.0, damping=2.0, feedforward_torque=0.0
        )
        time.sleep(0.01)
    moved = dict(motor.get_states())
    controller.disable_all()
    time.sleep(0.2)
    off = dict(motor.get_states())
    controller.shutdown()
    return {"ranges": ranges, "moved": moved, "off": off}


def motorbridge(channel):
    """motorbridge, which opens SocketCAN by itself."""
    from motorbridge import Controller, Mode

    with Controller(channel) as controller:
        motor = controller.add_damiao_motor(4, 0x14, "4310")
        ranges = [motor.damiao_get_param_f32(rid, 2000) for rid in (21, 22, 23)]
        motor.ensure_mode(Mode.MIT)
        motor.enable()
        end = time.monotonic() + 1.5
        while time.monotonic() < end:
            motor.send_mit(0.5, 0.0, 40.0, 2.0, 0.0)
            controller.poll_feedback_once()
            time.sleep(0.01)
        state = motor.get_state()
        motor.disable()
        return {"ranges": ranges, "position": state.pos, "status": state.status_code}


if __name__ == "__main__":
    what, *rest = sys.argv[1:]
    print("RESULT " + json.dumps(globals()[what](*rest), default=str))
