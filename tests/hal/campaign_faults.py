"""The faults of the campaign: how each begins, how it is noticed, what the robot is to do, and how it ends."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from wire_bench import PERIOD

from simulators.nodes.cia402.states import State
from simulators.wire_faults import BUS_OFF, CONTROLLER, PASSIVE, RESTARTED, WARNING, Chances

BAR = 2 * PERIOD + 0.010
"""A silent node is to be noticed within two cycles and 10 ms [s]."""
GOES_ON, STOPS, MAY_STOP = "goes on", "stops", "may stop"
DRIVES = {"biceps_drive": ("muscle_length", 0, 1), "triceps_drive": ("muscle_length", 1, 2)}
SENSORS = {
    "biceps_cell": ("muscle_tension", 0, 11),
    "triceps_cell": ("muscle_tension", 1, 12),
    "elbow_encoder": ("joint_position", 0, 21),
}
OURS = [0x081, 0x181, 0x18B, 0x581, 0x701]
"""Emergency, process data, SDO answer and heartbeat of nodes that are there."""

Step = Callable[[Any], None]


def _nothing(run):
    """Nothing ends by itself."""


@dataclass(frozen=True)
class Fault:
    """One way to break the robot.

    Attributes:
        name: As the table has it.
        begin: Breaks it.
        is_noticed: Whether the HAL knows, asked after each cycle; None if there is nothing to be known.
        reaction: What the robot must do: go on, stop, or either.
        end: Ends the fault.
        bar: Longest time [s] until it is noticed; None where chance decides.
    """

    name: str
    begin: Step
    is_noticed: Callable[[Any], bool] | None
    reaction: str
    end: Step = _nothing
    bar: float | None = None


def _is_invalid(run):
    signal, index, _ = run.victim
    return not run.bench.sample.valid[signal][index]


def _has_stopped(run):
    return run.bench.robot.mode not in ("hold", "follow")


def _breaks(fault, names):
    def begin(run):
        run.name = run.chance.choice(sorted(names))
        run.victim = names[run.name]
        run.bench.rig.fault(f"{fault} {run.name}")

    return begin


def _comes_back(run):
    run.bench.rig.fault(f"node_back {run.name}")


def _drive_fault(run):
    """A fault whose emergency is lost: only the status word tells."""
    run.name = run.chance.choice(sorted(DRIVES))
    run.victim = DRIVES[run.name]
    for wire in run.bench.faulty.values():
        wire.lost = frozenset({0x080 + run.victim[2]})
    run.bench.rig.fault(f"emcy {run.name}")


def _drops_out(run):
    """Its supply is cut: the drive is switched off, without a word."""
    run.name = run.chance.choice(sorted(DRIVES))
    run.bench.rig.node(run.name).state = State.SWITCH_ON_DISABLED


def _clears(run):
    for wire in run.bench.faulty.values():
        wire.chances, wire.lost, wire.readdressed, wire.babble = Chances(), frozenset(), {}, None
        wire.is_cut = False
    referee = run.bench.referee
    if referee.lies:  # the last wrong frame is still the newest one
        referee.forgive_all(0.05)
    referee.extra_age, referee.lies = 0.0, False


def _chances(**chances):
    def begin(run):
        run.before = run.counts()
        for wire in run.bench.faulty.values():
            wire.chances = Chances(**chances)
        run.bench.referee.extra_age = chances.get("delayed_by", 0.0)
        run.bench.referee.lies = "corrupt" in chances

    return begin


def _counted(*names):
    return lambda run: any(run.counts()[name] > run.before[name] for name in names)


def _readdress(shown):
    """A drive comes back from a reboot with another node id, as after somebody turned its switch."""

    def begin(run):
        run.victim = DRIVES["triceps_drive"]
        run.bench.referee.lies = shown == 1
        run.bench.faulty["can0"].readdressed = {2: shown}
        run.bench.rig.fault("node_reboot triceps_drive")

    return begin


def _readdressed_back(run):
    _clears(run)
    run.bench.rig.fault("node_reboot triceps_drive")


def _stray(run):
    """A second drive with the node id of the first is switched on."""
    run.name = "stray_drive"
    run.bench.referee.lies = True
    run.bench.rig.fault("node_back stray_drive")


def _stray_gone(run):
    run.bench.referee.lies = False
    run.bench.rig.fault("node_silent stray_drive")


def _babble(identifiers, count, lies=False):
    def begin(run):
        run.before = run.counts()
        run.bench.referee.lies = lies

        def say(draw):
            return [(draw.choice(identifiers), draw.randbytes(draw.randrange(9))) for _ in range(count)]

        run.bench.faulty["can0"].babble = say

    return begin


def _bus_off(run):
    """A controller that is bus-off neither sends nor receives."""
    wire = run.bench.faulty["can0"]
    wire.error(BUS_OFF)
    run.bench.flush_errors("can0")
    wire.is_cut = True


def _restarted(run):
    run.bench.faulty["can0"].is_cut = False
    run.bench.faulty["can0"].error(RESTARTED)


def _controller(detail):
    def begin(run):
        run.before = run.counts()
        run.bench.faulty["can0"].error(CONTROLLER, detail)

    return begin


def _vanishes(run):
    run.victim = DRIVES["biceps_drive"]
    run.bench.faulty["can0"].is_cut = True
    run.bench.unplug("can0")


def _cut(run):
    run.victim = DRIVES["biceps_drive"]
    run.bench.faulty["can0"].is_cut = True


def _wall_step(run):
    run.bench.clock.wall_step += run.chance.choice((-1, 1)) * run.chance.uniform(1.0, 1e5)


def _monotonic_step(run):
    """As after the machine was suspended: the nodes have gone on, the HAL has not."""
    run.bench.clock.advance(run.chance.uniform(0.5, 10.0))


def _frozen(duration):
    def begin(run):
        for _ in range(round(duration / PERIOD)):
            run.bench.pass_time()

    return begin


def _is_malformed(run):
    return run.counts()["malformed"] > run.before["malformed"]


def _lies(names, forge, bus, patience, moves=True):
    """Let a device lie, in frames that are in time and well-formed, with its heartbeat; `forge(run)` makes the liar."""

    def begin(run):
        run.name = run.chance.choice(sorted(names))
        run.victim = signal, index, node = names[run.name]
        run.bench.faulty[bus(run.name)].forged[0x180 + node] = forge(run)
        run.bench.referee.forgiven[signal, index] = run.bench.world.time + patience
        if moves:
            run.moves_far()

    return begin


def _bus_of(name):
    return "can0" if name in ("biceps_drive", "triceps_drive", "biceps_cell") else "can1"


def _honest(run):
    for wire in run.bench.faulty.values():
        wire.forged.clear()
    run.bench.world.stuck.clear()
    run.bench.referee.is_hindered = False


def _same_bytes(run):
    first = []

    def lie(data, now):
        first.append(data) if not first else None
        return first[0]

    return lie


def _counts(place, size, change):
    """A liar who changes one number of each frame: (bytes `place` on, `size` of them) -> change(number, run)."""

    def forge(run):
        state = {}

        def lie(data, now):
            number = int.from_bytes(data[place : place + size], "little", signed=True)
            report = change(number, run, state)
            return data[:place] + report.to_bytes(size, "little", signed=True) + data[place + size :]

        return lie

    return forge


def _shift(low, high):
    """A jump by a constant of either sign, `low` to `high` counts, drawn once."""

    def change(number, run, state):
        by = state.setdefault("by", run.chance.choice((-1, 1)) * run.chance.randint(low, high))
        return number + by

    return change


def _anywhere(number, run, state):
    return run.chance.randint(90_000, 160_000)


def _clipped(number, run, state):
    return min(number, state.setdefault("end", number))


def _says_enabled(run):
    """Its power stage is off; its statusword stays at `operation enabled`, and its position is as measured."""
    run.bench.rig.node(run.name).state = State.SWITCH_ON_DISABLED
    run.bench.referee.is_hindered = True
    return lambda data, now: b"\x27\x06" + data[2:]


def _blocked(run):
    run.name = run.chance.choice(sorted(DRIVES))
    run.victim = DRIVES[run.name]
    world = run.bench.world
    world.stuck[f"{run.victim[0]}.{run.name.removesuffix('_drive')}"] = float(world.length[run.victim[1]])
    run.bench.referee.is_hindered = True
    run.moves_far()


CELLS = {name: place for name, place in SENSORS.items() if name.endswith("_cell")}
ENCODER = {"elbow_encoder": SENSORS["elbow_encoder"]}
MOVING = 1.5
"""A lie that only motion shows is to be noticed within this time [s] of a motion that begins slowly."""
LIES = (
    Fault("drive says enabled and is off", _lies(DRIVES, _says_enabled, _bus_of, 0.0), _has_stopped, STOPS, _honest,
          MOVING),
    Fault("motor blocked", _blocked, _has_stopped, STOPS, _honest, MOVING),
    Fault("drive's answer frozen", _lies(DRIVES, _same_bytes, _bus_of, MOVING), _has_stopped, STOPS, _honest, MOVING),
    Fault("drive's encoder jumps 30 mm or more", _lies(DRIVES, _counts(2, 4, _shift(71_000, 120_000)), _bus_of, 0.03),
          _is_invalid, STOPS, _honest, BAR),
    Fault("encoder jumps 0.5 rad or more", _lies(ENCODER, _counts(0, 4, _shift(21_000, 30_000)), _bus_of, 0.03),
          _is_invalid, GOES_ON, _honest, BAR),
    Fault("encoder at random places", _lies(ENCODER, _counts(0, 4, _anywhere), _bus_of, 0.5), _is_invalid, GOES_ON,
          _honest),
    Fault("sensor's answer frozen", _lies(SENSORS, _same_bytes, _bus_of, MOVING), _is_invalid, GOES_ON, _honest,
          MOVING),
    Fault("cell clips", _lies(CELLS, _counts(0, 4, _clipped), _bus_of, MOVING), _is_invalid, GOES_ON, _honest, MOVING),
    Fault("cell with the other sign", _lies(CELLS, _counts(0, 4, lambda n, run, state: -n), _bus_of, 0.03),
          _is_invalid, GOES_ON, _honest, BAR),
    Fault("cell reads a thousandth", _lies(CELLS, _counts(0, 4, lambda n, run, state: n // 1000), _bus_of, 0.03),
          _is_invalid, GOES_ON, _honest, BAR),
)  # fmt: skip
SILENT = (
    Fault("drive without power", _breaks("node_silent", DRIVES), _is_invalid, STOPS, _comes_back, BAR),
    Fault("sensor without power", _breaks("node_silent", SENSORS), _is_invalid, GOES_ON, _comes_back, BAR),
    Fault("drive measures no more", _breaks("sensor_silent", DRIVES), _is_invalid, STOPS, _comes_back, BAR),
    Fault("sensor measures no more", _breaks("sensor_silent", SENSORS), _is_invalid, GOES_ON, _comes_back, BAR),
    Fault("wire cut", _cut, _is_invalid, STOPS, _clears, BAR),
    Fault("interface vanishes and returns", _vanishes, _is_invalid, STOPS, _clears, BAR),
)
SELF_TOLD = (
    Fault("drive reboots", _breaks("node_reboot", DRIVES), _has_stopped, STOPS, bar=BAR),
    Fault("sensor reboots", _breaks("node_reboot", SENSORS), _is_invalid, GOES_ON, bar=BAR),
    Fault("emergency of a drive", _breaks("emcy", DRIVES), _has_stopped, STOPS, bar=BAR),
    Fault("emergency of a sensor", _breaks("emcy", SENSORS), _is_invalid, GOES_ON, _comes_back, BAR),
    Fault("drive in fault, emergency lost", _drive_fault, _has_stopped, STOPS, _clears, BAR),
    Fault("drive switched off by itself", _drops_out, _has_stopped, STOPS, bar=BAR),
)
LOSSY = (
    *(
        Fault(f"{share:g} % of frames lost", _chances(loss=share / 100), _counted("incomplete"), reaction, _clears)
        for share, reaction in ((0.1, GOES_ON), (1, GOES_ON), (5, MAY_STOP), (10, MAY_STOP), (20, MAY_STOP))
    ),
    Fault("10 % of frames twice", _chances(duplicate=0.1), None, GOES_ON, _clears),
    Fault("every frame twice", _chances(duplicate=1.0), None, MAY_STOP, _clears),
    Fault("10 % of frames too short", _chances(short=0.1), _is_malformed, MAY_STOP, _clears),
    Fault("10 % of frames too long", _chances(long=0.1), _is_malformed, MAY_STOP, _clears),
    Fault("2 % of frames with a wrong byte", _chances(corrupt=0.02), None, MAY_STOP, _clears),
    Fault("10 % of frames 15 ms late", _chances(delay=0.1, delayed_by=0.015), None, MAY_STOP, _clears),
)
ADDRESSED = (
    Fault("node id changed to a free one", _readdress(99), _is_invalid, STOPS, _readdressed_back, BAR),
    Fault("node id changed to another drive's", _readdress(1), _has_stopped, STOPS, _readdressed_back, BAR),
    Fault("second drive with the same node id", _stray, _has_stopped, STOPS, _stray_gone, BAR),
    Fault("babbling node, free identifiers", _babble([0x001, 0x123, 0x7E5], 50), _counted("unknown"), GOES_ON, _clears),
    Fault("babbling node, identifiers of ours", _babble(OURS, 20, True), _is_malformed, MAY_STOP, _clears),
)
BUS = (
    Fault("bus-off, then restarted", _bus_off, _has_stopped, STOPS, _restarted, BAR),
    Fault("controller warns", _controller(WARNING), _counted("error_frames"), GOES_ON, bar=BAR),
    Fault("controller error passive", _controller(PASSIVE), _counted("error_frames"), MAY_STOP, bar=BAR),
)
TIME = (
    Fault("wall clock steps", _wall_step, None, GOES_ON),
    Fault("monotonic clock steps", _monotonic_step, None, MAY_STOP),
    Fault("cycle frozen for 0.3 s", _frozen(0.3), _has_stopped, STOPS, bar=BAR),
    Fault("cycle frozen for 3 s", _frozen(3.0), _has_stopped, STOPS, bar=BAR),
)
FAULTS = SILENT + LIES + SELF_TOLD + LOSSY + ADDRESSED + BUS + TIME
