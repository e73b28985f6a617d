"""Each limit alone: whatever is commanded, what it answers for stays inside."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hal.safety.ends import EndsOfEffort, EndsOfVelocity
from hal.safety.feedback import Load, MeasuredRange
from hal.safety.limit import Acceleration, CycleState, Range, Rate, fastest
from hal.safety.soft_effort import SoftEffort, SoftEffortOfEffort, SoftEffortOfVelocity

PERIOD = 0.005
LOW, HIGH = -1.0, 2.0
ONE = np.zeros(1, int)
wishes = st.lists(st.floats(-1e6, 1e6), min_size=1, max_size=30)
periods = st.sampled_from([0.001, 0.005, 0.02])


def along(limits, wanted, before, measured=None, period=PERIOD, commanded=True):
    """Set-points of one element that is asked for one wish after the other, each for 5 cycles."""
    before, speed, found = np.array([before]), np.zeros(1), []
    for wish in np.repeat(wanted, 5):
        value = np.array([wish])
        turn = CycleState(before, speed, measured or {}, commanded)
        for limit in limits:
            value = limit.limit(value, turn)
        speed, before = (value - before) / period, value
        found.append(float(value[0]))
    return np.array(found)


def way(signal="p", low=LOW, high=HIGH):
    return MeasuredRange(signal, ("elbow",), ONE, ONE, np.array([low]), np.array([high]))


def load(soft=100.0, hard=200.0, is_signed=False):
    return Load("f", ("elbow",), ONE, ONE, np.array([soft]), np.array([hard]), is_signed)


def one(limit, wanted, before=0.5, **measured):
    """What a limit makes of one wish."""
    turn = CycleState(np.array([before]), np.zeros(1), {name: np.array([value]) for name, value in measured.items()})
    return float(limit.limit(np.array([wanted]), turn)[0])


@settings(deadline=None)
@given(wishes)
def test_a_range_is_never_left(wanted):
    found = along([Range(np.array([LOW]), np.array([HIGH]))], wanted, 0.0)
    assert ((found >= LOW) & (found <= HIGH)).all()


@settings(deadline=None)
@given(wishes, st.floats(-1, 2), st.floats(0.01, 100.0), periods)
def test_no_step_is_larger_than_the_rate_allows(wanted, start, rate, period):
    found = along([Rate(rate, period)], wanted, start)
    steps = np.abs(np.diff(found, prepend=start))
    assert (steps <= rate * period * (1 + 1e-9) + 1e-9 * np.abs(found).max()).all()


@settings(deadline=None)
@given(st.floats(1e-6, 10.0), st.floats(0.1, 100.0), periods)
def test_the_fastest_speed_is_braked_within_the_distance_and_no_slower_than_need_be(distance, deceleration, period):
    speed = float(fastest(np.array([distance]), deceleration, period)[0])
    covered, left = 0.0, speed
    while left > 0:
        covered += left * period
        left -= deceleration * period
    assert covered <= distance * (1 + 1e-6)
    ideal = np.sqrt(2 * deceleration * distance)
    assert speed >= min(ideal - deceleration * period, distance / period) * (1 - 1e-9)


@settings(max_examples=60, deadline=None)
@given(wishes, st.floats(LOW, HIGH), st.floats(0.5, 50.0), st.floats(0.1, 10.0), periods)
def test_a_ramp_keeps_acceleration_rate_and_range_whatever_is_commanded(wanted, start, acceleration, rate, period):
    limits = [Range(np.array([LOW]), np.array([HIGH])), Acceleration(acceleration, period), Rate(rate, period)]
    found = along(limits, wanted, start, period=period)
    speed = np.diff(found, prepend=start) / period
    change = np.diff(speed, prepend=0.0) / period
    assert ((found >= LOW - 1e-9) & (found <= HIGH + 1e-9)).all()
    assert np.abs(speed).max() <= rate + 1e-6
    assert np.abs(change).max() <= acceleration * (1 + 1e-6) + 1e-5


@settings(max_examples=25, deadline=None)
@given(st.floats(LOW, HIGH), st.floats(LOW, HIGH), st.floats(2.0, 50.0))
def test_a_ramp_arrives_without_overshoot_and_stays(start, goal, acceleration):
    limits = [Acceleration(acceleration, PERIOD), Rate(3.0, PERIOD)]
    found = along(limits, [goal] * 300, start)
    assert found[-1] == goal
    assert found.min() >= min(start, goal) - 1e-9
    assert found.max() <= max(start, goal) + 1e-9


def test_what_is_held_while_it_moves_comes_to_rest_on_the_ramp():
    ramp = Acceleration(1.0, PERIOD)
    before, speed, found = np.zeros(1), np.array([0.5]), []
    for _ in range(200):
        value = ramp.limit(before, CycleState(before, speed, {}, is_commanded=False))
        speed, before = (value - before) / PERIOD, value
        found.append(float(speed[0]))
    np.testing.assert_allclose(found[:3], [0.495, 0.49, 0.485])
    assert found[-1] == 0.0
    assert before[0] == pytest.approx(0.125, rel=0.05)


@settings(max_examples=100, deadline=None)
@given(wishes, st.floats(-0.9, 1.9), st.floats(0.5, 20.0), st.integers(0, 3), st.booleans())
def test_a_velocity_command_is_braked_before_the_end_also_with_a_slow_drive(wanted, start, braking, late, is_slow):
    """The drive hears of a command `late` cycles later, and follows at once or with a time constant of 15 ms."""
    ahead = 0.02 + 2 * PERIOD + 0.02
    limits = [
        Range(np.array([-3.0]), np.array([3.0])),
        Rate(braking, PERIOD),
        EndsOfVelocity(way(), np.array([braking]), ahead),
    ]
    position, velocity, sent, before = start, 0.0, [0.0] * (late + 1), np.zeros(1)
    for wish in np.repeat(wanted, 25):
        value = np.array([wish])
        for limit in limits:
            value = limit.limit(value, CycleState(before, np.zeros(1), {"p": np.array([position])}))
        before = value
        sent.append(float(value[0]))
        velocity += (sent[-1 - late] - velocity) * (1 - np.exp(-PERIOD / 0.015) if is_slow else 1.0)
        position += velocity * PERIOD
        assert LOW - 1e-9 <= position <= HIGH + 1e-9
    assert abs(before[0]) <= 3.0


def test_beyond_an_end_only_the_way_back_is_open():
    ends = EndsOfVelocity(way(), np.array([5.0]), 0.05)
    assert one(ends, 1.0, 0.0, p=2.1) == 0.0
    assert one(ends, -1.0, 0.0, p=2.1) == -1.0
    assert one(ends, -1.0, 0.0, p=-1.1) == 0.0
    assert one(ends, 1.0, 0.0, p=-1.1) == 1.0


def test_without_a_position_there_is_no_velocity_and_no_effort_and_it_is_told():
    for ends in (EndsOfVelocity(way(), None, 0.05), EndsOfEffort("range", way())):
        assert one(ends, 1.0, 0.0, p=np.nan) == 0.0
        assert ends.blind({"p": np.array([np.nan])}) == ["elbow"]
        assert ends.blind({"p": np.zeros(1)}) == []


@settings(deadline=None)
@given(st.floats(-50, 50), st.floats(-3, 4))
def test_an_effort_towards_an_end_fades_out_and_back_it_acts_in_full(wanted, position):
    found = one(EndsOfEffort("range", way()), wanted, 0.0, p=position)
    assert abs(found) <= abs(wanted)
    assert found * wanted >= 0
    if position >= HIGH:
        assert found == min(wanted, 0.0)
    elif position <= LOW:
        assert found == max(wanted, 0.0)
    elif LOW + 0.3 < position < HIGH - 0.3:
        assert found == wanted


def test_an_effort_fades_out_towards_the_highest_velocity():
    fade = EndsOfEffort("velocity", way("v", -2.0, 2.0))
    assert one(fade, 5.0, 0.0, v=1.0) == 5.0
    assert one(fade, 5.0, 0.0, v=1.8) == pytest.approx(2.5)
    assert one(fade, 5.0, 0.0, v=2.5) == 0.0
    assert one(fade, -5.0, 0.0, v=2.5) == -5.0


@settings(deadline=None)
@given(st.floats(-2, 3), st.floats(0, 500))
def test_a_tense_wire_only_moves_towards_relief(wanted, tension):
    limit = SoftEffort(load(), np.array([0.2]), np.array([LOW]), np.array([HIGH]), PERIOD)
    found = one(limit, wanted, 0.5, f=tension)
    if tension >= 100:
        assert found >= 0.5
    if tension <= 90:
        assert found == wanted
    assert found >= min(wanted, 0.5)


@settings(deadline=None)
@given(st.floats(-2, 3), st.floats(-500, 500))
def test_a_loaded_joint_only_moves_against_its_effort(wanted, effort):
    limit = SoftEffort(load(is_signed=True), np.array([0.2]), np.array([LOW]), np.array([HIGH]), PERIOD)
    found = one(limit, wanted, 0.5, f=effort)
    assert limit.name == "effort"
    if effort >= 100:
        assert found <= 0.5
    if effort <= -100:
        assert found >= 0.5
    if abs(effort) <= 90:
        assert found == wanted


@settings(deadline=None)
@given(st.floats(-5, 5), st.floats(-500, 500), st.booleans())
def test_a_loaded_velocity_only_relieves(wanted, effort, is_signed):
    found = one(SoftEffortOfVelocity(load(is_signed=is_signed), np.array([1.0])), wanted, 0.0, f=effort)
    if effort >= 100:
        assert found * (-1 if is_signed else 1) >= 0
    if is_signed and effort <= -100:
        assert found >= 0


@pytest.mark.parametrize("stiffness", [0.2, 1.0, 5.0])
def test_an_effort_command_settles_at_the_soft_limit(stiffness):
    """The load follows the command one cycle later: [N per N m]."""
    limit, before, loads = SoftEffortOfEffort(load()), np.array([60.0 / stiffness]), []
    force = 60.0
    for _ in range(2000):
        value = limit.limit(np.array([1000.0]), CycleState(before, np.zeros(1), {"f": np.array([force])}))
        value = Rate(20.0 / stiffness, PERIOD).limit(value, CycleState(before, np.zeros(1), {}))
        force, before = stiffness * float(value[0]), value
        loads.append(force)
    assert max(loads) < 105.0
    assert np.ptp(loads[-100:]) < 0.5
    assert loads[-1] == pytest.approx(100.0, rel=0.02)


def test_a_load_that_is_not_known_limits_nothing_and_is_told():
    arguments = (np.array([0.2]), np.array([LOW]), np.array([HIGH]), PERIOD)
    for limit in (SoftEffort(load(), *arguments), SoftEffortOfVelocity(load(), np.ones(1)), SoftEffortOfEffort(load())):
        assert one(limit, -0.3, 0.5, f=np.nan) == -0.3
        assert limit.blind({"f": np.array([np.nan])}) == ["elbow"]


@pytest.mark.parametrize(
    ("force", "most"),
    [
        (89.9, 1000.0),  # below the band, which is a tenth of 100 N, nothing is limited
        (90.1, 10.198),  # at its lower end an effort may grow by 2 % per cycle
        (95.0, 10.1),
        (100.0, 10.0),
        (105.0, 9.9),
        (110.0, 9.8),
        (150.0, 9.8),
        (-105.0, 9.9),
    ],
)
def test_how_much_an_effort_may_grow_per_cycle(force, most):
    limit = SoftEffortOfEffort(load())
    assert one(limit, 1000.0, 10.0, f=force) == pytest.approx(most)
    assert one(limit, -1000.0, -10.0, f=force) == pytest.approx(-most)
    assert one(limit, 0.5, 10.0, f=force) == 0.5


@pytest.mark.parametrize(
    ("tension", "speed"),
    [(89.0, -100.0), (95.0, -0.1), (100.0, 0.0), (125.0, 0.05), (150.0, 0.1), (200.0, 0.2), (300.0, 0.2)],
)
def test_how_fast_a_tense_wire_is_paid_out(tension, speed):
    """At most 0.2 m/s at 200 N, none at 100 N; in the band below the wire may be wound, slower and slower."""
    limit = SoftEffort(load(), np.array([0.2]), np.array([LOW]), np.array([HIGH]), PERIOD)
    assert one(limit, 0.0, 0.5, f=tension) == pytest.approx(max(0.5 + speed * PERIOD, 0.0))
    velocity = SoftEffortOfVelocity(load(), np.array([0.2]))
    assert one(velocity, -100.0, f=tension) == pytest.approx(speed)
    assert one(velocity, 1.0, f=tension) == 1.0


@pytest.mark.parametrize(("before", "step"), [(1.9995, 0.0005), (2.0, 0.0), (2.5, 0.0), (1.9, 0.001)])
def test_paying_out_ends_at_the_end_of_the_range(before, step):
    limit = SoftEffort(load(), np.array([0.2]), np.array([LOW]), np.array([HIGH]), PERIOD)
    assert one(limit, 0.0, before, f=200.0) == pytest.approx(before + step)


@pytest.mark.parametrize(("effort", "sign"), [(0.75, -1.0), (-0.75, 1.0)])
def test_a_small_load_gives_way_in_its_own_direction(effort, sign):
    small = load(soft=0.5, hard=1.0, is_signed=True)
    assert one(SoftEffortOfVelocity(small, np.array([0.2])), 0.0, f=effort) == pytest.approx(sign * 0.1)


@pytest.mark.parametrize(("effort", "sign"), [(150.0, -1.0), (-150.0, 1.0)])
def test_a_loaded_joint_gives_way_against_its_effort(effort, sign):
    limit = SoftEffort(load(is_signed=True), np.array([0.2]), np.array([LOW]), np.array([HIGH]), PERIOD)
    assert one(limit, 0.5, 0.5, f=effort) == pytest.approx(0.5 + sign * 0.1 * PERIOD)
    assert one(SoftEffortOfVelocity(load(is_signed=True), np.array([0.2])), 0.0, f=effort) == pytest.approx(sign * 0.1)


@pytest.mark.parametrize(
    ("position", "up", "down"),
    [(0.5, 15.0, -15.0), (1.9, 1.0, -29.0), (2.0, 0.0, -30.0), (2.1, 0.0, -31.0), (-1.0, 30.0, 0.0)],
)
def test_a_velocity_without_deceleration_closes_the_way_in_twice_the_age(position, up, down):
    """The age is 0.05 s, so that the way that is left may be gone in 0.1 s."""
    limit = EndsOfVelocity(way(), None, 0.05)
    assert one(limit, 100.0, p=position) == pytest.approx(up)
    assert one(limit, -100.0, p=position) == pytest.approx(down)


@pytest.mark.parametrize("left", [0.01, 0.1, 1.0])
def test_a_velocity_with_a_deceleration_stops_at_the_end(left):
    """v * 0.1 s + v^2 / (2 * 4 / s^2) is the way that is left."""
    speed = one(EndsOfVelocity(way(), np.array([4.0]), 0.05), 100.0, p=HIGH - left)
    assert speed * 0.1 + speed**2 / 8.0 == pytest.approx(left)


@pytest.mark.parametrize(
    ("position", "wanted", "share"),
    [(2.0, 5.0, 0.0), (1.85, 5.0, 0.5), (1.7, 5.0, 1.0), (1.85, -5.0, 1.0), (-0.85, -5.0, 0.5), (-0.85, 5.0, 1.0)],
)
def test_an_effort_fades_out_in_a_tenth_of_the_range(position, wanted, share):
    """The range is 3 long."""
    assert one(EndsOfEffort("range", way()), wanted, p=position) == pytest.approx(share * wanted)


def test_an_effort_at_an_end_without_another_end():
    """Without a range, it fades out in 0.1 of the unit."""
    one_end = EndsOfEffort("range", way(low=-np.inf))
    assert one(one_end, 5.0, p=1.95) == pytest.approx(2.5)
    assert one(one_end, -5.0, p=-1e6) == -5.0
    assert one(EndsOfEffort("velocity", way(low=-np.inf, high=np.inf)), 5.0, p=1e6) == 5.0
