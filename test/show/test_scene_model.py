"""The robot model of the URDF."""

import numpy as np

from beetle_omni_ros.model import rotations
from beetle_omni_ros.model.parameters import JOINT_NAMES, RobotParameters, ROTOR_NAMES
from beetle_omni_ros.model.urdf import links


def placed(angles):
    """Link -> position and quaternion in the root's frame, with joints at ``angles``."""
    found = {}
    for link in links():
        position, quaternion = found.get(link.parent, (np.zeros(3), [0.0, 0.0, 0.0, 1.0]))
        found[link.name] = (position + rotations.matrix(quaternion) @ link.position,
                            rotations.multiply(quaternion, link.turned(angles.get(link.joint, 0))))
    return found


def test_the_rotors_of_the_description_are_those_of_the_robot_file():
    robot, tilt = RobotParameters.load(), np.array([0.3, -1.2, 2.5, 0.0])
    poses = placed(dict(zip(JOINT_NAMES, tilt, strict=True)))
    for k, name in enumerate(ROTOR_NAMES):
        position, quaternion = poses[name]
        np.testing.assert_allclose(position, robot.rotors.positions[k], atol=2e-3)
        turned = rotations.matrix(rotations.exp(robot.tilt_axes[k] * tilt[k]))
        np.testing.assert_allclose(rotations.matrix(quaternion)[:, 2], turned[:, 2], atol=1e-6)
