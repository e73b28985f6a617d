"""What everybody who drives a World may rely on, asked of both variants of the arm."""

from itertools import islice
from pathlib import Path

import numpy as np
import pytest

from hal.config import load_robot
from simulators.faults import UnknownPart
from simulators.muscle_world import MuscleWorld
from simulators.robots.musashi_arm import random_motion, simulator
from simulators.robots.musashi_arm.body import REST, make_body
from simulators.robots.musashi_arm.model import ROUTES, URDF, chain

CONFIG = load_robot(Path(__file__).parents[2] / "robots" / "musashi_arm.yaml")
SIZES = {"joint_position": 5, "muscle_tension": 10, "muscle_length": 10}


@pytest.fixture(params=simulator.variants)
def world(request):
    world = simulator.world(request.param, 1)
    yield world
    world.close()


def run(world: MuscleWorld, duration: float) -> None:
    for _ in range(round(duration / 0.005)):
        world.step(0.005)


def drive(world: MuscleWorld, lengths: np.ndarray, enabled: bool = True) -> None:
    for muscle, length in zip(ROUTES, lengths, strict=True):
        world.drive(f"muscle_length.{muscle}", length, enabled)


def test_signals_have_the_robots_sizes_and_are_copies(world):
    for values in (world.measure(), world.truth()):
        assert {name: value.shape for name, value in values.items()} == {n: (s,) for n, s in SIZES.items()}
        before = {name: value.copy() for name, value in values.items()}
        run(world, 0.05)
        assert all(np.array_equal(values[name], before[name]) for name in SIZES)


def test_time_goes_by_what_was_asked(world):
    for duration in (0.005, 0.0013, 0.00002, 0.02):
        world.step(duration)
    assert world.time == pytest.approx(0.02632, abs=1e-12)


def test_the_same_seed_is_the_same_arm():
    def history(seed: int) -> np.ndarray:
        world = simulator.world("actual", seed)
        drive(world, world.truth()["muscle_length"] - 0.002)
        run(world, 0.3)
        measured = np.concatenate(list(world.measure().values()))
        world.close()
        return measured

    assert np.array_equal(history(4), history(4))
    assert not np.allclose(history(4), history(5))


def test_it_starts_at_rest_and_stays_there(world):
    run(world, 2.0)
    settled = world.truth()["joint_position"]
    assert settled == pytest.approx(REST, abs=0.1)
    positions = []
    for _ in range(100):
        world.step(0.005)
        positions.append(world.truth()["joint_position"])
    assert np.ptp(positions, axis=0).max() < 1e-4


def test_noise_is_the_actual_arms_alone():
    for variant, noisy in (("geometric", False), ("actual", True)):
        world = simulator.world(variant, 0)
        difference = np.array([world.measure()["muscle_tension"] - world.truth()["muscle_tension"] for _ in range(200)])
        assert difference.std() == pytest.approx(0.5 if noisy else 0.0, rel=0.1)
        world.close()


def test_servos_follow_at_their_speed(world):
    start = world.truth()["muscle_length"]
    drive(world, start + 0.03)
    run(world, 0.1)
    moved = world.truth()["muscle_length"] - start
    assert np.all(moved <= 0.02 + 1e-9)
    run(world, 0.4)
    assert world.truth()["muscle_length"] == pytest.approx(start + 0.03, abs=1e-4)


def test_a_servo_that_is_not_enabled_holds(world):
    start = world.truth()["muscle_length"]
    drive(world, start + 0.03, enabled=False)
    run(world, 0.5)
    assert world.truth()["muscle_length"] == pytest.approx(start, abs=1e-6)


def test_a_spool_gives_way_before_the_wire_breaks(world):
    drive(world, world.truth()["muscle_length"] - 0.2)
    peak = 0.0
    for _ in range(400):
        world.step(0.005)
        state = world.truth()
        peak = max(peak, state["muscle_tension"].max())
        assert np.all(state["joint_position"] > chain().low - 0.05)
        assert np.all(state["joint_position"] < chain().high + 0.05)
    assert 300.0 < peak < 600.0


def test_a_cut_muscle_carries_nothing_any_more(world):
    run(world, 0.5)
    before = world.truth()["joint_position"]
    world.break_part("muscle_cut:triceps")
    run(world, 2.0)
    assert world.truth()["muscle_tension"][list(ROUTES).index("triceps")] == 0.0
    assert abs(world.truth()["joint_position"] - before)[3] > 0.02


def test_the_arm_does_not_drag_the_spool_of_a_cut_muscle(world):
    index = list(ROUTES).index("brachialis")
    world.break_part("muscle_cut:brachialis")
    lengths = world.truth()["muscle_length"]
    lengths[index] -= 0.02
    for bent in (0.03, 0.0, 0.03):
        others = lengths.copy()
        others[6] -= bent
        drive(world, others)
        run(world, 1.5)
        assert world.truth()["muscle_length"][index] == pytest.approx(lengths[index], abs=1e-3)  # m


def test_a_heavy_object_weighs_on_the_arm(world):
    run(world, 1.0)
    before = world.truth()["joint_position"]
    world.break_part("heavy_object")
    run(world, 2.0)
    sag = world.truth()["joint_position"] - before
    assert sag[3] > 0.005
    assert np.abs(sag).max() < 0.6


def test_wrong_names_and_numbers_are_told(world):
    with pytest.raises(UnknownPart, match=r"muscle_cut:biceps.*heavy_object"):
        world.break_part("bone_broken:humerus")
    with pytest.raises(KeyError, match=r"muscle_length\.biceps"):
        world.drive("muscle_length.gluteus", 0.1, True)
    with pytest.raises(ValueError, match=r"muscle_length\.biceps.* nan"):
        world.drive("muscle_length.biceps", float("nan"), True)


def test_the_step_is_fine_enough():
    bodies = [MuscleWorld(make_body("actual", 0), 0, longest_step=step) for step in (0.0025, 0.0005)]
    histories: list[list[np.ndarray]] = [[], []]
    for lengths, duration in islice(random_motion(CONFIG, 1), 150):
        for world, history in zip(bodies, histories, strict=True):
            drive(world, lengths)
            run(world, duration)
            history.append(world.truth()["joint_position"])
    for world in bodies:
        world.close()
    difference = np.array(histories[0]) - np.array(histories[1])
    assert np.sqrt(np.mean(difference**2)) < 0.003


def test_worlds_do_not_see_each_other():
    one, other = simulator.world("geometric", 0), simulator.world("geometric", 0)
    one.break_part("heavy_object")
    run(one, 0.5)
    before = other.truth()["joint_position"]
    assert before == pytest.approx(REST)
    one.close()
    one.close()
    run(other, 0.1)
    other.close()


def test_the_urdf_is_part_of_the_package():
    assert URDF.is_file()
    assert {"README.md", "LICENSE"} <= {path.name for path in URDF.parent.iterdir()}


def test_a_load_cell_remembers_which_way_the_wire_ran():
    """Wound in and paid out again to the same length, the cell at the spool reads less: hysteresis."""
    world = simulator.world("actual", 1)
    held = world.truth()["muscle_length"]
    readings = []
    for offset in (-0.01, 0.0, 0.01, 0.0):
        drive(world, held + offset)
        run(world, 2.0)
        readings.append(world.truth()["muscle_tension"])
    world.close()
    after_winding_in, after_paying_out = readings[3], readings[1]
    assert np.mean(after_winding_in - after_paying_out) > 2.0
    assert np.all(after_winding_in > 0.9 * after_paying_out)
