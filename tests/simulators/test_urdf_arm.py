"""Any URDF: which arm is in it, what cannot be used, and how the arm moves, weighs and touches."""

from itertools import islice, pairwise
from pathlib import Path

import numpy as np
import pytest
import yaml

from hal.config import load_robot
from hal.errors import ConfigError
from hal.finding.doctor import Severity, check_file
from simulators.bullet import pybullet
from simulators.physics.bullet_arm import BulletArm
from simulators.robots.urdf_arm import describe, random_motion, simulator
from simulators.robots.urdf_arm.body_file import find_mesh, physics_urdf, possible
from simulators.robots.urdf_arm.choice import arm_of, choose_arm
from simulators.robots.urdf_arm.kinematics import TipKinematics
from simulators.robots.urdf_arm.motion import free_postures
from simulators.robots.urdf_arm.survey import neutral, survey
from simulators.robots.urdf_arm.tree import read_tree

XACRO = "xmlns:xacro='http://www.ros.org/wiki/xacro'"


def link(name, mass=0.0, shape="", extra=""):
    inertia = "".join(f'{key}="0.01" ' for key in ("ixx", "iyy", "izz"))
    weight = f'<inertial><origin xyz="0.2 0 0"/><mass value="{mass}"/><inertia {inertia}/></inertial>' if mass else ""
    return f'<link name="{name}">{weight}{shape}{extra}</link>'


def joint(name, kind, parent, child, origin='xyz="0 0 0"', limit='lower="-2" upper="2"', extra="", axis="0 1 0"):
    return (
        f'<joint name="{name}" type="{kind}"><origin {origin}/><parent link="{parent}"/><child link="{child}"/>'
        f'<axis xyz="{axis}"/><limit {limit} effort="60" velocity="3"/>{extra}</joint>'
    )


BOX = '<collision><origin xyz="0.2 0 0"/><geometry><box size="0.3 0.05 0.05"/></geometry></collision>'
FOOT = '<collision><geometry><box size="0.1 0.1 0.1"/></geometry></collision>'
LINKS = [link("world"), link("base", 5.0, FOOT), link("upper", 2.0, BOX), link("fore", 1.0, BOX), link("wrist", 0.2)]
LINKS += [link("left_finger", 0.05), link("right_finger", 0.05), link("tool0")]
JOINTS = [
    joint("fixing", "fixed", "world", "base", 'xyz="0 0 0.05" rpy="0 0 0.3"'),
    joint("shoulder pan", "continuous", "base", "upper", 'xyz="0 0 0.5"', axis="0 0 1"),
    joint("elbow", "revolute", "upper", "fore", 'xyz="0.4 0 0" rpy="0.2 0 0"'),
    joint("wrist", "revolute", "fore", "wrist", 'xyz="0.4 0 0"', 'lower="0" upper="1"'),
    joint("slide", "prismatic", "wrist", "left_finger", limit='lower="0" upper="0.04"'),
    joint("mimics", "prismatic", "wrist", "right_finger", extra='<mimic joint="slide"/>'),
    joint("flange", "fixed", "wrist", "tool0", 'xyz="0.1 0 0.02" rpy="0 1 0"'),
]
ARM = "<robot name='My Arm'>" + "".join(LINKS + JOINTS) + "</robot>"


def written(folder: Path, text: str = ARM, name: str = "arm.urdf") -> Path:
    path = folder / name
    path.write_text(text)
    return path


@pytest.fixture
def arm(tmp_path):
    return choose_arm(read_tree(written(tmp_path)))


def drafted(folder, text=ARM):
    draft = describe(written(folder, text), None, None, folder)
    (folder / "eds").mkdir()
    for sheet in draft.sheets:
        (folder / "eds" / sheet.name).write_text(sheet.read_text())
    (folder / "arm.yaml").write_text(draft.text)
    return load_robot(folder / "arm.yaml")


@pytest.fixture
def robot(tmp_path):
    return drafted(tmp_path)


@pytest.mark.parametrize(
    ("text", "report"),
    [
        (f"<robot {XACRO}><xacro:macro name='a'/><link name='a'/></robot>", "is a xacro file. Convert it first"),
        ("<robot><xacro:macro name='a'/><link name='a'/></robot>", "is a xacro file"),
        ("<robot><link name='${prefix}a'/></robot>", "is a xacro file"),
        ("<robot><link name='a'", "is not XML"),
        ("<robot><drake:a/><link name='a'", "is not XML"),
        ("<mujoco/>", "is an MJCF file of MuJoCo. `gemuco init` makes a URDF of it."),
        ("<sdf/>", "is an SDF file of Gazebo"),
        ("<mujocoinclude/>", "is a part that another MJCF file includes, but"),
        ("<html/>", "is XML of <html>"),
        ("<robot/>", "has no link"),
        ("<robot><link name='a'/><link name='b'/></robot>", "has the links a, b without a joint to them"),
        ("<robot><link name='a'/>" + joint("j", "revolute", "a", "b") + "</robot>", "names the link 'b', which"),
        (f"<robot>{link('a')}{link('b')}{joint('j', 'fixed', 'a', 'b')}</robot>", "has no joint that a motor turns"),
        (f"<robot>{link('a')}{link('b')}{joint('j', 'prismatic', 'a', 'b')}</robot>", "Its joints: prismatic."),
        (f"<robot>{link('a')}{link('b')}{joint('j', 'revolute', 'a', 'b', axis='0 0 0')}</robot>", "axis of length 0"),
        (f"<robot>{link('a')}{link('b')}{joint('j', 'revolute', 'a', 'b', 'xyz=`0 0`'.replace('`', chr(34)))}</robot>",
         "where 3 numbers belong"),
        (f"<robot>{link('a')}{link('b')}{joint('j', 'continuous', 'a', 'b')}</robot>", "turns in place"),
        ("<robot>" + link("a") + link("b") + joint("j", "fixed", "a", "b") + joint("k", "fixed", "b", "a") + "</robot>",
         "a ring of joints"),
        ("<robot>" + link("a") + link("b") + joint("j", "fixed", "a", "b") + joint("k", "fixed", "a", "b") + "</robot>",
         "both lead to the link 'b'"),
    ],
)  # fmt: skip
def test_what_is_no_arm_is_refused_in_a_sentence(tmp_path, text, report):
    with pytest.raises(ConfigError) as caught:
        choose_arm(read_tree(written(tmp_path, text)))
    assert report in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("arm", "hint"),
    [("", "No other end has an arm before it."), (joint("lift", "revolute", "a", "hand"), "by --tip: hand.")],
)
def test_a_wheel_is_not_named_in_place_of_another_wheel(tmp_path, arm, hint):
    wheels = "".join(link(name) + joint(name, "continuous", "a", name) for name in ("left", "right"))
    text = f"<robot>{link('a')}{wheels}{link('hand', mass=1.0) + arm if arm else ''}</robot>"
    with pytest.raises(ConfigError) as caught:
        choose_arm(read_tree(written(tmp_path, text)), "left")
    assert str(caught.value).endswith(hint)


@pytest.mark.parametrize("declared", ["", "xmlns:drake='http://drake.mit.edu'"])
def test_extensions_of_other_programs_are_left_out(tmp_path, declared):
    """Files do not declare their prefix; an empty line before the XML declaration is usual too. ROS reads both."""
    text = ARM.replace("<limit lower", "<limit drake:acceleration='9' lower").replace("<robot", f"<robot {declared}", 1)
    text = text.replace("</robot>", "<drake:joint name='a'><link name='b'/></drake:joint></robot>")
    draft = describe(written(tmp_path, f'\n<?xml version="1.0"?>\n{text}'), None, None, tmp_path)
    assert draft.text == describe(written(tmp_path), None, None, tmp_path).text


def test_joints_named_by_numbers_or_truth_values_make_a_robot_file(tmp_path):
    text = ARM.replace('"shoulder pan"', '"8"').replace('"elbow"', '"on"').replace("tool0", "no").replace("My Arm", "7")
    draft = describe(written(tmp_path, text), None, None, tmp_path)
    content = yaml.safe_load(draft.text)
    assert content["signals"]["joint_position"]["elements"] == ["joint_8", "joint_on", "wrist"]
    assert (content["robot"], content["tip"]) == ("robot_7", "no")
    assert set(content["devices"]) >= {"joint_8_drive", "joint_on_encoder"}


def test_a_file_that_is_not_there_or_a_folder(tmp_path):
    for path, report in ((tmp_path / "none.urdf", "There is no file"), (tmp_path, "is a folder")):
        with pytest.raises(ConfigError, match=report):
            read_tree(path)


def test_the_chain_ends_at_the_tool_and_fingers_are_held(arm):
    assert arm.names == ("shoulder_pan", "elbow", "wrist")
    assert arm.tip == "tool0"
    assert arm.reach == pytest.approx(0.4 + 0.4 + np.hypot(0.1, 0.02))
    assert any("2 joints that are not part" in note or "1 joints that are not part" in note for note in arm.notes)


@pytest.mark.parametrize(
    ("names", "tip"),
    [
        (("palm",), "palm"),
        (("right_hand", "right_hand_camera_link"), "right_hand"),
        (("gripper_base", "gripper_fingertip_3_link"), "gripper_base"),
        (("flange", "tool0", "camera_tool"), "tool0"),
        (("hand", "hand_tcp"), "hand_tcp"),
        (("wrist_camera",), "wrist"),
    ],
)
def test_the_tip_is_what_is_named_like_a_tool_or_a_hand(tmp_path, names, tip):
    more = [link(name) for name in names]
    chain = [joint(f"to {name}", "fixed", before, name) for before, name in zip(("wrist", *names), names, strict=False)]
    text = "<robot name='a'>" + "".join([*LINKS[:5], *more, *JOINTS[:4], *chain]) + "</robot>"
    assert choose_arm(read_tree(written(tmp_path, text))).tip == tip


def humanoid() -> str:
    links, joints = [link("pelvis", 5.0)], []
    for side in ("left", "right"):
        for limb, count in (("leg", 6), ("arm", 4)):
            before = "pelvis"
            for number in range(count):
                name = f"{side}_{limb}_{number}"
                links.append(link(name, 1.0))
                joints.append(joint(f"{name}_joint", "revolute", before, name, 'xyz="0.1 0 0"'))
                before = name
    return "<robot name='h'>" + "".join(links + joints) + "</robot>"


def test_an_arm_is_chosen_before_a_leg_and_the_others_are_named(tmp_path):
    tree = read_tree(written(tmp_path, humanoid()))
    chosen = choose_arm(tree)
    assert chosen.tip == "right_arm_3"
    assert "Other chains, for --tip: left_arm_3, right_leg_5, left_leg_5." in chosen.notes
    assert len(choose_arm(tree, "left_leg_5").joints) == 6
    with pytest.raises(ConfigError, match=r"has no link 'nose'\. Known links, ends of chains first: right_arm_3, left"):
        choose_arm(tree, "nose")
    with pytest.raises(ConfigError, match="No motor moves 'pelvis'"):
        choose_arm(tree, "pelvis")


def test_the_places_of_the_tip_are_those_of_bullet(arm, tmp_path):
    client = pybullet.connect(pybullet.DIRECT)
    body = pybullet.loadURDF(str(arm.tree.path), useFixedBase=True, physicsClientId=client)
    index = {}
    for number in range(pybullet.getNumJoints(body, physicsClientId=client)):
        info = pybullet.getJointInfo(body, number, physicsClientId=client)
        index |= {info[1].decode(): number, f"to {info[12].decode()}": number}
    random = np.random.default_rng(0)
    for posture in random.uniform(-1.0, 1.0, (5, 3)):
        for one, angle in zip(arm.joints, posture, strict=True):
            pybullet.resetJointState(body, index[one.name], angle, physicsClientId=client)
        seen = pybullet.getLinkState(body, index["to tool0"], computeForwardKinematics=1, physicsClientId=client)[4]
        np.testing.assert_allclose(TipKinematics(arm).tips(posture[None])[0], seen, atol=1e-6)
    pybullet.disconnect(physicsClientId=client)


def test_a_motor_carries_what_hangs_on_it(arm):
    """The elbow turns around a tilted y: m g times the lever of what is behind it, by hand."""
    text, _ = physics_urdf(arm)
    body = BulletArm(text, arm.names, neutral(arm), np.full(3, 1e3))
    torque, inertia = body.torques(np.zeros(3))
    moment = (
        1.0 * 0.2 + 0.2 * (0.4 + 0.2) + 2 * 0.05 * (0.4 + 0.2) + 1e-3 * 0.5
    )  # fore, wrist, two fingers, tool0 [kg m]
    assert abs(torque[1]) == pytest.approx(9.81 * moment * np.cos(0.2), rel=0.01)
    assert torque[0] == pytest.approx(0.0, abs=1e-9)
    assert (inertia > 0.0).all()
    for _ in range(400):
        body.step(np.zeros(3))
    np.testing.assert_allclose(body.effort, torque, atol=0.02)
    np.testing.assert_allclose(body.position, 0.0, atol=1e-3)
    body.close()


def test_an_arm_stops_at_the_floor(arm):
    """An elbow 0.55 m high cannot touch a floor 0.07 m below zero with what is behind it; one 0.25 m high can."""
    text, _ = physics_urdf(arm)
    down, low = np.array([0.0, 0.6, 0.0]), np.array([0.0, 2.0, 0.0])
    tall = text.replace('xyz="0.0 0.0 0.55"', 'xyz="0.0 0.0 0.25"')
    assert tall != text
    for drawn, is_free in ((text, True), (tall, False)):
        body = BulletArm(drawn, arm.names, neutral(arm), np.full(3, 20.0))
        assert not body.touches(np.zeros(3))
        assert body.touches(down) is False
        assert body.touches(low) is not is_free
        body.place(np.zeros(3))
        for _ in range(800):
            body.step(low)
        stopped_short = abs(body.position[1] - low[1]) > 0.05
        assert stopped_short is not is_free
        body.close()


def test_an_arm_that_hangs_from_its_base_is_free(tmp_path):
    """The floor would be 0.07 m below its foot, where its links already are."""
    hanging = ARM.replace('xyz="0 0 0.5"', 'xyz="0 0 -0.5"').replace('rpy="0.2 0 0"', 'rpy="0 1.5 0"')
    arm = choose_arm(read_tree(written(tmp_path, hanging)))
    assert (survey(arm).high > survey(arm).low).all()


def test_a_heavy_arm_has_torques(tmp_path):
    """The second link of a KUKA KR 210: Bullet's inverse dynamics refuses its inertia, which is not round in bits."""
    heavy = "<inertial><origin xyz='-0.38 -0.03 0.28'/><mass value='958.62'/>"
    heavy += "<inertia ixx='180.42' iyy='177.68' izz='20.495' ixy='-0.83462' ixz='0.32549' iyz='-20.82'/></inertial>"
    text = ARM.replace(link("upper", 2.0, BOX), f"<link name='upper'>{heavy}</link>")
    text, _ = physics_urdf(
        choose_arm(read_tree(written(tmp_path, text.replace('axis xyz="0 0 1"', 'axis xyz="0 1 0"'))))
    )
    body = BulletArm(text, ("shoulder_pan", "elbow", "wrist"), np.zeros(3), np.full(3, 1e5))
    torque, inertia = body.torques(np.zeros(3))
    behind = 3.3 * 0.4 + 1.3 * 0.2  # kg m: what the elbow carries, and its centre
    assert torque[0] == pytest.approx(9.81 * (958.62 * 0.38 - behind), rel=0.01)
    assert inertia[0] == pytest.approx(177.68 + 958.62 * (0.38**2 + 0.28**2), rel=0.02)
    body.close()


def test_a_mass_that_no_body_has_is_made_possible():
    for wrong in (np.diag([1.0, 0.1, 0.1]), np.diag([0.0, 0.0, 1.0]), np.diag([1e-12, 1e-12, 1e-12])):
        moments = np.linalg.eigvalsh(possible(wrong))
        assert moments[0] > 0.0
        assert moments[2] < moments[0] + moments[1]
    right = np.diag([0.2, 0.25, 0.3])
    np.testing.assert_allclose(possible(right), right)


def test_servos_that_meet_in_a_point_hold_the_head_behind_them(tmp_path):
    """The ball joints of a Stewart platform are drawn as three joints each, with frames of a nanogram between them."""
    weights = dict.fromkeys(("roll", "pitch", "roll2", "pitch2"), (1e-9, 1e-9)) | {"rod": (5e-3, 2e-6)}
    names = ["base", "roll", "pitch", "rod", "roll2", "pitch2", "head"]
    links = [link("base", 1.0), link("head", 0.3), link("tip")]
    for name, (mass, moment) in weights.items():
        inertia = "".join(f"{key}='{moment}' " for key in ("ixx", "iyy", "izz"))
        links.append(f"<link name='{name}'><inertial><mass value='{mass}'/><inertia {inertia}/></inertial></link>")
    axes = ("1 0 0", "0 1 0", "0 0 1") * 2
    joints = [
        joint(name, "revolute", *pair, axis=axis)
        for name, pair, axis in zip(names[1:], pairwise(names), axes, strict=True)
    ]
    joints.append(joint("end", "fixed", "head", "tip", 'xyz="0.1 0 0"'))
    arm = choose_arm(read_tree(written(tmp_path, f"<robot>{''.join(links + joints)}</robot>")))
    text, _ = physics_urdf(arm)
    body = BulletArm(text, arm.names, np.array([0.4, -0.6, 0.5, 0.7, -0.3, 0.2]), np.full(6, 1.0))
    middle = body.position.copy()
    for number in range(400):
        goal = middle + 0.1 * np.sin(0.02 * number)
        body.step(goal)
        assert np.abs(body.position - goal).max() < 0.05
    body.close()


def test_motors_have_the_torque_of_the_file(tmp_path):
    """A joint that needs little torque at rest carries what the others accelerate."""
    for effort in (60.0, 10.0, 0.0):
        folder = tmp_path / f"{effort:g}"
        folder.mkdir()
        world = simulator.world(drafted(folder, ARM.replace('effort="60"', f'effort="{effort}"')), "nominal", 0)
        assert world._physics._efforts == pytest.approx(np.maximum(2.0 * world._needed, effort))
        world.close()


def test_links_without_mass_get_one_and_are_named(tmp_path):
    text = ARM.replace(link("fore", 1.0, BOX), link("fore", 0.0, BOX, "<visual/>"))
    _, notes = physics_urdf(choose_arm(read_tree(written(tmp_path, text))))
    assert notes == ["Mass or inertia of fore is guessed, because the file has none that a body can have."]


def test_meshes_of_packages_are_found_above_the_urdf(tmp_path):
    (tmp_path / "my_arm" / "urdf").mkdir(parents=True)
    (tmp_path / "my_arm" / "meshes").mkdir()
    mesh = tmp_path / "my_arm" / "meshes" / "a.stl"
    mesh.write_text("")
    urdf = tmp_path / "my_arm" / "urdf" / "arm.urdf"
    for name in ("package://my_arm/meshes/a.stl", "../meshes/a.stl", f"file://{mesh}", "model://my_arm/meshes/a.stl"):
        assert find_mesh(name, urdf) == mesh.resolve()
    assert find_mesh("package://another_name/meshes/a.stl", urdf) == mesh.resolve()
    assert find_mesh("package://other/meshes/b.stl", urdf) is None
    missing = BOX.replace("<box size=", "<mesh filename='package://none/x.stl' unused=")
    _, notes = physics_urdf(choose_arm(read_tree(written(tmp_path, ARM.replace(BOX, missing)))))
    assert notes == ["No contact of x.stl: the mesh was not found, or is not STL, OBJ or DAE."]


def test_torques_come_from_the_inertia_where_the_file_states_too_little(tmp_path):
    weak = ARM.replace('effort="60"', 'effort="0"')
    found = survey(choose_arm(read_tree(written(tmp_path, weak))))
    assert any(note.startswith("Torque of shoulder_pan, elbow, wrist is from the inertia") for note in found.notes)
    assert found.effort[1] > 9.81 * 0.3
    assert survey(choose_arm(read_tree(written(tmp_path)))).effort.tolist() == [60.0, 60.0, 60.0]
    assert (found.high - found.low <= 1.2 + 1e-9).all()
    assert found.low[2] >= 0.0  # the wrist's own limits
    strong = survey(choose_arm(read_tree(written(tmp_path, ARM.replace('effort="60"', 'effort="9000"')))))
    assert strong.effort == pytest.approx(50.0 * found.effort), "a drive of 9 kN m would not feel this arm"
    assert any(note.startswith("Torque of shoulder_pan, elbow, wrist is 50 times what") for note in strong.notes)


def test_the_robot_file_is_complete(robot):
    assert robot.robot == "my_arm"
    assert {finding.verdict for finding in check_file(robot)} <= {Severity.OK, Severity.WARNING}
    assert [finding.what for finding in check_file(robot) if finding.verdict is Severity.WARNING] in (
        [],
        ["calibration"],
    )
    assert (
        arm_of(read_tree(robot.folder / robot.urdf), robot.signals["motor_position"].elements, robot.tip).tip == "tool0"
    )
    with pytest.raises(ConfigError, match="are not those of"):
        arm_of(read_tree(robot.folder / robot.urdf), ("a", "b"), robot.tip)


def test_postures_and_moves_touch_nothing(robot):
    postures = free_postures(robot, 3)
    body = simulator.world(robot, "nominal", 0)
    low, high = robot.bounds("motor_position")
    for _ in range(5):
        posture = next(postures)
        assert ((posture >= low) & (posture <= high)).all()
        assert not body._physics.touches(posture)
    postures.close()
    body.close()


def test_moves_keep_a_distance_from_the_floor(tmp_path):
    """The elbow is 0.2 m above a floor that it can reach."""
    robot = drafted(tmp_path, ARM.replace('xyz="0 0 0.5"', 'xyz="0 0 0.2"').replace('rpy="0.2 0 0"', 'rpy="0 0.3 0"'))
    reach, world = simulator.reach(robot), simulator.world(robot, "nominal", 0)
    points = islice(random_motion(robot, 0), 1500)
    apart = [world._physics.distance(point, 0.1) for point, _ in points]
    assert 0.01 * reach <= min(apart) < 0.05 * reach, "it comes near the floor, and not too near"
    world.close()


def test_the_world_follows_its_motors_and_twists_its_gears(robot):
    world = simulator.world(robot, "nominal", 0)
    before = world.truth()
    goal = before["motor_position"] + np.array([0.3, -0.2, 0.1])
    for name, value in zip(("shoulder_pan", "elbow", "wrist"), goal, strict=True):
        world.drive(f"motor_position.{name}", value, True)
    for _ in range(200):
        world.step(0.01)
    after = world.truth()
    np.testing.assert_allclose(after["motor_position"], goal, atol=2e-3)
    twist = after["motor_position"] - after["joint_position"]
    assert abs(twist[1]) > 1e-3
    assert np.sign(twist[1]) == np.sign(after["joint_effort"][1])
    assert np.linalg.norm(after["tool_tip_position"] - before["tool_tip_position"]) > 0.05
    world.drive("motor_position.elbow", 9.0, False)  # the brake holds
    world.step(0.5)
    np.testing.assert_allclose(world.truth()["joint_position"][1], after["joint_position"][1], atol=2e-3)
    world.close()


def test_a_moving_arm_needs_the_torques_of_its_motion_and_no_others(robot):
    """A sine of 0.3 rad at 0.5 Hz: gravity, and the inertia times the acceleration; the sensor lags by 0.1 s."""
    world = simulator.world(robot, "nominal", 0)
    middle, efforts, expected = world.truth()["motor_position"], [], []
    for number in range(400):  # 4 s
        wanted = middle + np.array([0.0, 0.3 * np.sin(np.pi * number * 0.01), 0.0])
        world.drive("motor_position.elbow", wanted[1], True)
        world.step(0.01)
        efforts.append(world.truth()["joint_effort"][1])
        torque, inertia = world._physics.torques(world.truth()["joint_position"])
        expected.append(torque[1] - 0.3 * np.pi**2 * np.sin(np.pi * (number * 0.01 - 0.05)) * inertia[1])
    late = 10  # cycles of the sensor's lag
    difference = np.array(efforts)[100:] - np.array(expected)[100 - late : -late]
    assert np.abs(difference).max() < 0.15 * np.ptp(expected)
    world.close()


def test_an_actual_arm_is_another_one_for_every_seed(robot):
    zeros = [
        simulator._body(robot, variant, seed).zeros for variant, seed in (("nominal", 1), ("actual", 1), ("actual", 2))
    ]
    assert not zeros[0].any()
    assert np.abs(zeros[1] - zeros[2]).max() > 1e-4
    with pytest.raises(ConfigError, match=r"no variant 'golden'\. Known variants: nominal, actual"):
        simulator.world(robot, "golden", 0)


def test_the_camera_can_be_covered(robot):
    camera = simulator.vision(robot, "nominal", 0)
    truth = {"tool_tip_position": np.array([0.5, 0.0, 0.4])}
    np.testing.assert_allclose(camera.see(truth)["tool_tip_position"], truth["tool_tip_position"], atol=0.02)
    assert camera.fault("camera_covered") == "The camera is covered."
    assert np.isnan(camera.see(truth)["tool_tip_position"]).all()
    camera.fault("camera_back")
    assert np.isfinite(camera.see(truth)["tool_tip_position"]).all()
    with pytest.raises(ValueError, match="Known faults: camera_covered, camera_back"):
        camera.fault("coffee")
