"""The robot model of the URDF."""

import numpy as np

from beetle_omni_ros.robot import rotations
from beetle_omni_ros.robot.parameters import JOINT_NAMES, RobotParameters, ROTOR_NAMES
from beetle_omni_ros.robot.urdf import Model

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
    for k, name in enumerate(ROTOR_NAMES):
        position, quaternion = poses[name]
        np.testing.assert_allclose(position, robot.rotors.positions[k], atol=2e-3)
        turned = rotations.matrix(rotations.exp(robot.tilt_axes[k] * tilt[k]))
        np.testing.assert_allclose(rotations.matrix(quaternion)[:, 2], turned[:, 2], atol=1e-6)


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
