"""Messages of the nodes: number types, frames, names, and refusals with a reason."""

import numpy as np
import pytest

from beetle_omni_ros.control.base import Command, PoseTarget
from beetle_omni_ros.messages.topics import ALL
from beetle_omni_ros.messages.values import MessageError, Odom
from beetle_omni_ros.nodes import wire
from beetle_omni_ros.robot import rotations
from beetle_omni_ros.robot.readings import JointReading


def over_the_wire(topic, value):
    return wire.message(ALL[topic], wire.serialized(topic, value))


def test_odometry_carries_the_twist_in_base_link():
    rng = np.random.default_rng(3)
    rotation, velocity = rotations.normalized(rng.normal(size=4)), rng.normal(size=3)
    message = over_the_wire('odom', Odom(3.0, rng.normal(size=3), velocity, rotation,
                                         rng.normal(size=3), np.eye(6), 2 * np.eye(6)))
    twist = message.twist.twist.linear
    assert np.allclose(rotations.matrix(rotation) @ [twist.x, twist.y, twist.z], velocity)
    assert message.twist.covariance[7] == 2


@pytest.mark.parametrize(('topic', 'value', 'reason'), [
    ('command', Command(1.0, np.zeros(4), [7, np.nan, 7, 7]), 'thrust is not finite'),
    ('rotor_states', JointReading(1.0, np.zeros(1), None, names=['gimbal1']), 'names are not'),
    ('joint_states', JointReading(1.0, np.zeros(1), None), 'too few'),
    ('target_pose', PoseTarget(np.zeros(3), [0, 0, 0, 0.9], 0.0), 'unit quaternion')])
def test_a_bad_message_is_refused_with_a_reason(topic, value, reason):
    write = ALL['joint_states' if isinstance(value, JointReading) else topic].write
    with pytest.raises(MessageError, match=reason):
        ALL[topic].take(write(value))
