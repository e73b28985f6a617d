"""Any MJCF file: the URDF that is made of it moves and weighs as the file does in MuJoCo, and says what it lacks."""

import sys
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from hal.config import load_robot
from hal.errors import ConfigError
from simulators.physics.choice import MODULES, make_arm, using
from simulators.robots.urdf_arm import describe
from simulators.robots.urdf_arm.body import arm_in
from simulators.robots.urdf_arm.body_file import physics_urdf
from simulators.robots.urdf_arm.choice import choose_arm
from simulators.robots.urdf_arm.kinematics import TipKinematics
from simulators.robots.urdf_arm.mjcf import convert, is_mjcf
from simulators.robots.urdf_arm.robot_file import draft
from simulators.robots.urdf_arm.tree import read_tree, tree_of

sys.path.append(str(Path(__file__).parent))
from test_urdf_arm import ARM

SCENE = """
<mujoco model="Test Arm">
  <compiler angle="radian"/>
  <option gravity="0 0 -5"/>
  <asset>
    <mesh name="fore arm" vertex="0 -.03 -.03  0 .03 -.03  0 0 .04  .3 0 0  .1 0 0"/>
  </asset>
  <default>
    <default class="light"><joint armature="0.1" range="-2 2"/></default>
  </default>
  <worldbody>
    <geom type="plane" size="3 3 1"/>
    <body name="table" pos="0 0 0.2"><geom type="box" size=".1 .1 .05"/></body>
    <body name="cube" pos="1 0 0.5"><freejoint/><geom type="box" size=".02 .02 .02"/></body>
    <body name="base" pos="0 0 0.3" quat="0.9239 0 0 0.3827">
      <geom type="cylinder" size=".05 .04"/>
      <body name="upper" pos="0 0 0.1" childclass="light">
        <joint name="pan" axis="0 0 1" pos="0.01 0 0"/>
        <joint name="lift" axis="0 1 0" pos="0 0 0.05" range="-1.5 1.2"/>
        <geom type="capsule" fromto="0 0 0 0.35 0 0" size=".03" mass="1.5"/>
        <body name="fore" pos="0.4 0 0" euler="0.3 0 0.2" childclass="light">
          <joint name="elbow" axis="0 1 0" ref="0.5" actuatorfrcrange="-20 20"/>
          <geom type="mesh" mesh="fore arm" mass="0.8"/>
          <geom type="ellipsoid" size=".02 .02 .04" pos="0 0 .05" mass="0.1"/>
          <body name="hand" pos="0.3 0 0.02">
            <inertial pos="0.02 0 0" mass="0.3" fullinertia="3e-4 2e-4 4e-4 5e-5 0 0"/>
            <joint name="roll" axis="1 0 0" range="-1 1"/>
            <geom type="sphere" size=".03" contype="0" conaffinity="0"/>
            <site name="tool_center" pos="0.1 0 0" euler="0 1 0"/>
            <site name="tool_axis_x" pos="0.2 0 0"/>
            <camera name="eye" pos="0 0 0.05"/>
            <body><joint name="left_finger" type="slide" axis="0 1 0" range="0 .03"/><geom size=".01"/></body>
            <body><joint name="right_finger" type="slide" axis="0 1 0" range="0 .03"/><geom size=".01"/></body>
            <body name="flap"><joint name="flap"/><geom size=".01"/></body>
          </body>
        </body>
      </body>
    </body>
  </worldbody>
  <equality><joint joint1="right_finger" joint2="left_finger" polycoef="0 -1 0 0 0"/></equality>
  <actuator>
    <motor joint="pan" gear="50" ctrlrange="-1.5 1.5"/>
    <position joint="lift" kp="100" forcerange="-80 80"/>
    <motor joint="elbow" gear="10"/>
    <position joint="roll" kp="10"/>
    <position joint="left_finger" kp="10"/>
  </actuator>
</mujoco>
"""


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    pytest.importorskip("mujoco")
    path = tmp_path / "arm.xml"
    path.write_text(SCENE)
    return path


@pytest.fixture
def tree(scene: Path):
    converted = convert(scene)
    for name, content in converted.meshes.items():
        (scene.parent / name).write_bytes(content)
    return tree_of(converted.root, scene)


def test_joints_limits_torques_and_the_tip(tree) -> None:
    arm = choose_arm(tree)
    assert (tree.name, arm.names, arm.tip) == ("Test Arm", ("pan", "lift", "elbow", "roll"), "tool_center")
    assert [joint.effort for joint in arm.joints] == pytest.approx([75.0, 80.0, 20.0, 0.0])
    limits = [(joint.low, joint.high) for joint in arm.joints]
    np.testing.assert_allclose(limits, [(-2.0, 2.0), (-1.5, 1.2), (-2.5, 1.5), (-1.0, 1.0)])
    followers = {joint.name: joint.follows for joint in tree.before.values() if joint.follows}
    assert followers == {"right_finger": "left_finger"}
    assert "cube" not in tree.links


def test_what_is_left_out_is_said(scene: Path) -> None:
    notes = "\n".join(convert(scene).notes)
    for words in (
        "Left out, because no motor moves it: cube.",
        "No contact of shapes that a URDF lacks: plane (there is a floor), ellipsoid.",
        "Held still, because they have no motor of their own: flap.",
        "Zero is moved to the posture in which the file draws it: elbow by 0.5.",
        "Cameras of the file are links without a picture: eye_camera.",
        "not 0.0 0.0 -5.0 as in the file.",
        "Not simulated: armature, damping and friction of joints, gains of actuators.",
    ):
        assert words in notes
    assert "tendons" not in notes


def test_it_moves_and_weighs_as_the_file_does_in_mujoco(tree, scene: Path) -> None:
    """MuJoCo computes places, masses and torques from the MJCF file itself; its armature and ellipsoid stay there."""
    import mujoco

    arm = choose_arm(tree)
    model = mujoco.MjModel.from_xml_path(str(scene))
    model.dof_armature[:] = 0.0
    model.opt.gravity[2] = -9.81
    data = mujoco.MjData(model)
    reference = [0.5 if name == "elbow" else 0.0 for name in arm.names]
    places = [int(model.joint(name).qposadr[0]) for name in arm.names]
    speeds = [int(model.joint(name).dofadr[0]) for name in arm.names]
    engines = [engine for engine, module in MODULES.items() if find_spec(module) is not None]
    bodies = {engine: _arm(engine, physics_urdf(arm)[0], arm.names) for engine in engines}
    assert "mujoco" in bodies
    for posture in np.random.default_rng(3).uniform(-1.0, 1.0, (8, 4)):
        data.qpos[places] = posture + reference
        mujoco.mj_forward(model, data)
        place = data.site("tool_center").xpos
        np.testing.assert_allclose(TipKinematics(arm).tips(posture[None])[0], place, atol=1e-9)
        for body in bodies.values():
            torque, _ = body.torques(posture)
            np.testing.assert_allclose(torque, data.qfrc_bias[speeds], rtol=0.01, atol=0.02)
    for body in bodies.values():
        body.close()


def _arm(engine: str, text: str, names: tuple[str, ...]):
    with using(engine):
        return make_arm(text, names, np.zeros(len(names)), np.full(len(names), 200.0))


def test_shapes_touch_where_those_of_the_file_are(tree) -> None:
    shapes = {link: len(element.findall("collision")) for link, element in tree.links.items()}
    assert (shapes["table"], shapes["base"], shapes["upper"], shapes["fore"], shapes["hand"]) == (1, 1, 3, 1, 0)
    mesh = tree.links["fore"].find("collision/geometry/mesh").get("filename")
    corners = np.frombuffer(
        (tree.path.parent / mesh).read_bytes()[84:], [("n", "<f4", 3), ("c", "<f4", (3, 3)), ("m", "<u2")]
    )
    points = np.unique(np.round(corners["c"].reshape(-1, 3), 6), axis=0)
    assert len(points) == 4  # the hull of five points, of which one is inside
    lengths = sorted(np.linalg.norm(points[i] - points[j]) for i in range(4) for j in range(i))
    slanted = float(np.linalg.norm((0.3, 0.03, 0.03)))
    edges = [0.06, np.hypot(0.07, 0.03), np.hypot(0.07, 0.03), slanted, slanted, np.hypot(0.3, 0.04)]
    assert lengths == pytest.approx(sorted(edges), abs=1e-5)


def test_the_robot_file_needs_nothing_but_what_init_writes(scene: Path, tmp_path: Path) -> None:
    made = describe(scene, None, None, tmp_path)
    assert sorted(made.files) == ["arm.urdf", "arm_meshes/fore_arm_0.stl"]
    folder = tmp_path / "elsewhere"
    for name, content in made.files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content)
    (folder / "eds").mkdir()
    for sheet in made.sheets:
        (folder / "eds" / sheet.name).write_bytes(sheet.read_bytes())
    (folder / "arm.yaml").write_text(made.text)
    assert "# Left out, because no motor moves it: cube." in made.text
    arm = arm_in(load_robot(folder / "arm.yaml"))
    assert physics_urdf(arm)[1] == []  # meshes are found


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("<mujoco><worldbody><body><geom type='mesh' mesh='x'/></body></worldbody></mujoco>", "MuJoCo cannot read '"),
        ("<mujoco><worldbody/></mujoco>", "has no joint that a motor turns"),
        ("<mujoco><include file='none.xml'/></mujoco>", "Are its meshes and includes beside it?"),
    ],
)
def test_what_is_no_robot_is_refused_in_a_sentence(tmp_path: Path, text: str, words: str) -> None:
    pytest.importorskip("mujoco")
    path = tmp_path / "arm.xml"
    path.write_text(text)
    with pytest.raises(ConfigError) as caught:
        draft(path, None, None, tmp_path)
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def test_without_mujoco_its_package_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "arm.xml"
    path.write_text(SCENE)
    assert is_mjcf(path)
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(ModuleNotFoundError) as caught:
        draft(path, None, None, tmp_path)
    assert caught.value.name == "mujoco"


def test_a_urdf_in_a_file_of_xml_is_read_as_such(tmp_path: Path) -> None:
    path = tmp_path / "arm.xml"
    path.write_text(ARM)
    assert not is_mjcf(path)
    assert choose_arm(read_tree(path)).tip == "tool0"
