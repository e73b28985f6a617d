"""The state machine of a drive (CiA 402-2, figure 7): control word in, status word out."""

from enum import IntEnum


class State(IntEnum):
    """States, each with its bits in the status word."""

    NOT_READY = 0x00
    SWITCH_ON_DISABLED = 0x40
    READY_TO_SWITCH_ON = 0x21
    SWITCHED_ON = 0x23
    OPERATION_ENABLED = 0x27
    QUICK_STOP_ACTIVE = 0x07
    FAULT_REACTION_ACTIVE = 0x0F
    FAULT = 0x08


class Command(IntEnum):
    """Commands in the lower bits of a control word."""

    DISABLE_VOLTAGE = 0
    QUICK_STOP = 1
    SHUTDOWN = 2
    SWITCH_ON = 3
    ENABLE_OPERATION = 4


FAULT_RESET = 1 << 7
"""This is a bit of the control word; its rising edge counts."""

_TABLE = {
    State.SWITCH_ON_DISABLED: {Command.SHUTDOWN: State.READY_TO_SWITCH_ON},
    State.READY_TO_SWITCH_ON: {
        Command.SWITCH_ON: State.SWITCHED_ON,
        Command.ENABLE_OPERATION: State.OPERATION_ENABLED,
        Command.QUICK_STOP: State.SWITCH_ON_DISABLED,
        Command.DISABLE_VOLTAGE: State.SWITCH_ON_DISABLED,
    },
    State.SWITCHED_ON: {
        Command.SHUTDOWN: State.READY_TO_SWITCH_ON,
        Command.ENABLE_OPERATION: State.OPERATION_ENABLED,
        Command.QUICK_STOP: State.SWITCH_ON_DISABLED,
        Command.DISABLE_VOLTAGE: State.SWITCH_ON_DISABLED,
    },
    State.OPERATION_ENABLED: {
        Command.SHUTDOWN: State.READY_TO_SWITCH_ON,
        Command.SWITCH_ON: State.SWITCHED_ON,
        Command.QUICK_STOP: State.QUICK_STOP_ACTIVE,
        Command.DISABLE_VOLTAGE: State.SWITCH_ON_DISABLED,
    },
    State.QUICK_STOP_ACTIVE: {
        Command.ENABLE_OPERATION: State.OPERATION_ENABLED,
        Command.DISABLE_VOLTAGE: State.SWITCH_ON_DISABLED,
    },
}


def command(controlword: int) -> Command:
    """Return the command of a control word (CiA 402-2, table 27)."""
    if not controlword & 0x02:
        return Command.DISABLE_VOLTAGE
    if not controlword & 0x04:
        return Command.QUICK_STOP
    if not controlword & 0x01:
        return Command.SHUTDOWN
    return Command.ENABLE_OPERATION if controlword & 0x08 else Command.SWITCH_ON


def following(state: State, controlword: int, before: int) -> State:
    """Return the state after a control word.

    Args:
        state: The state now.
        controlword: The new control word.
        before: The control word before it; a fault is only reset by an edge.
    """
    if state is State.FAULT:
        has_edge = controlword & FAULT_RESET and not before & FAULT_RESET
        return State.SWITCH_ON_DISABLED if has_edge else state
    return _TABLE.get(state, {}).get(command(controlword), state)
