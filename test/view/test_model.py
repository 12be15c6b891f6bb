"""The robot model of the URDF."""

import numpy as np
import pytest
import trimesh

from beetle_omni_ros.robot import rotations
from beetle_omni_ros.robot.parameters import JOINT_NAMES, RobotParameters, ROTOR_NAMES
from beetle_omni_ros.robot.resources import share_path
from beetle_omni_ros.robot.schema import ParameterError
from beetle_omni_ros.robot.urdf import Model
from beetle_omni_ros.view.drawing import (
    _mesh,
    NEWTON_PER_METRE,
    rotor_frames,
    SEGMENTS,
    thrust_arrows,
    torque_arcs,
)

SMALL = """<robot name="r">
<material name="red"><color rgba="1 0 0 0.5"/></material>
<link name="a"><visual><origin xyz="1 2 3"/><geometry><box size="1 2 3"/></geometry>
  <material name="red"/></visual></link>
<link name="b"><visual><geometry><mesh filename="b.stl" scale="2 2 2"/></geometry></visual></link>
<joint name="turn" type="continuous"><parent link="a"/><child link="b"/>
  <origin xyz="0 0 1" rpy="0 0 1.5707963267948966"/><axis xyz="0 1 0"/></joint>
</robot>"""


def loaded(tmp_path, text):
    file = tmp_path / 'robot.urdf'
    file.write_text(text)
    return Model.load(file)


def placed(model, angles):
    """Link -> position and quaternion in the root's frame, with joints at ``angles``."""
    found = {}
    for link in model.links.values():
        if link.joint is None:
            found[link.name] = np.zeros(3), link.turned()
            continue
        position, quaternion = found[link.joint.parent]
        found[link.name] = (position + rotations.matrix(quaternion) @ link.joint.position,
                            rotations.multiply(quaternion, link.turned(angles.get(link.moves, 0))))
    return found


def test_the_rotors_of_the_description_are_those_of_the_robot_file():
    robot, tilt = RobotParameters.load(), np.array([0.3, -1.2, 2.5, 0.0])
    poses = placed(Model.load(), dict(zip(JOINT_NAMES, tilt, strict=True)))
    centres, axes = rotor_frames(robot, tilt)
    for k, name in enumerate(ROTOR_NAMES):
        position, quaternion = poses[name]
        np.testing.assert_allclose(position, centres[k], atol=2e-3)
        np.testing.assert_allclose(rotations.matrix(quaternion)[:, 2], axes[k, :, 2], atol=1e-6)


def test_shapes_colours_and_joints_are_read(tmp_path):
    model = loaded(tmp_path, SMALL)
    box, = model.links['a'].visuals
    mesh, = model.links['b'].visuals
    assert (box.shape, box.size, box.colour) == ('box', (1, 2, 3), (1, 0, 0, 0.5))
    assert (mesh.shape, mesh.size, mesh.file) == ('mesh', (2, 2, 2), tmp_path / 'b.stl')
    position, quaternion = placed(model, {'turn': np.pi / 2})['b']
    np.testing.assert_allclose(position, [0, 0, 1])
    # About the joint's own y, which its origin has turned to world -x.
    np.testing.assert_allclose(rotations.matrix(quaternion) @ [0, 0, 1], [0, 1, 0], atol=1e-12)


@pytest.mark.parametrize('text, message', [
    ('<robot', 'not a usable URDF'), ('<world/>', 'expected <robot>'),
    ('<robot><link name="a"/><link name="b"/></robot>', 'one root link'),
    (SMALL.replace('0 0 1"', '0 0"'), 'expected 3'),
    (SMALL.replace('1 2 3"/>', '1 2"/>', 1), 'expected 3 numbers')])
def test_an_unusable_description_is_refused_in_one_line(tmp_path, text, message):
    with pytest.raises(ParameterError, match=message) as error:
        loaded(tmp_path, text)
    assert 'robot.urdf' in str(error.value) and '\n' not in str(error.value)


def test_thrust_arrows_stand_on_the_rotors_and_are_as_long_as_the_thrust():
    robot, thrust = RobotParameters.load(), np.array([8.0, 4.0, 0.0, np.nan])
    arrows = thrust_arrows(robot, np.array([0.0, np.pi / 2, 0.0, 0.0]), thrust)
    np.testing.assert_allclose(arrows[:, 0], robot.rotors.positions)
    drawn = NEWTON_PER_METRE * (arrows[:, 1] - arrows[:, 0])
    np.testing.assert_allclose(drawn[0], [0, 0, 8])
    np.testing.assert_allclose(drawn[1], 4 * np.cross(robot.tilt_axes[1], [0, 0, 1]), atol=1e-12)
    np.testing.assert_allclose(drawn[2:], 0)


def test_torque_arcs_turn_as_the_reaction_torque_on_the_body():
    robot = RobotParameters.load()
    arcs = torque_arcs(robot, np.zeros(4), np.full(4, 10.0)).reshape(4, SEGMENTS + 2, 2, 3)
    for k in range(4):
        arms = arcs[k, :SEGMENTS] - robot.rotors.positions[k]
        sense = np.cross(arms[:, 0], arms[:, 1])[:, 2]
        assert np.all(np.sign(sense) == -robot.rotors.spin[k])
    swept = [np.linalg.norm(np.diff(torque_arcs(robot, np.zeros(4), np.full(4, f))[:SEGMENTS],
                                    axis=1), axis=2).sum() for f in (5.0, 10.0)]
    assert swept[1] == pytest.approx(2 * swept[0], rel=1e-2)


def test_a_mesh_agrees_with_an_independent_reader_and_a_broken_one_is_refused(tmp_path):
    file = next(share_path('description/meshes').glob('*.stl'))
    vertices, faces = _mesh(file)
    np.testing.assert_array_equal(vertices[faces], trimesh.load_mesh(file).triangles)
    (tmp_path / 'b.stl').write_bytes(b'no mesh at all')
    with pytest.raises(ParameterError, match=r'b\.stl: not a usable mesh'):
        _mesh(tmp_path / 'b.stl')
