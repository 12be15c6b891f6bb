"""Markers and frames of the viewer agree with the topics."""


import numpy as np
import pytest

from beetle_omni_ros.control.base import Command, PoseTarget
from beetle_omni_ros.messages import conversions
from beetle_omni_ros.messages.values import Odom
from beetle_omni_ros.nodes import wire
from beetle_omni_ros.nodes.transform_message import transform_message
from beetle_omni_ros.nodes.viewer_node import ViewerNode
from beetle_omni_ros.robot import rotations
from beetle_omni_ros.robot.readings import JointReading


class Sent(list):
    """A publisher that stores its messages."""

    publish = list.append
    subscribed = 1

    def get_subscription_count(self):
        return self.subscribed


@pytest.fixture
def viewer(make, monkeypatch):
    sent = {}
    monkeypatch.setattr(ViewerNode, 'create_publisher',
                        lambda node, kind, topic, profile: sent.setdefault(topic, Sent()))
    monkeypatch.setattr(wire, 'Publisher', lambda node, topic, *_: Sent())
    node = make(ViewerNode)
    node.sent = sent
    return node


def test_thrust_arrows_point_along_the_tilted_rotors(viewer):
    rotation = rotations.from_rpy(0.4, -0.2, 1.0)
    position, tilt = np.array([1.0, 2.0, 3.0]), np.array([0.0, np.pi / 2, 0.0, -0.3])
    viewer._draw()
    assert not viewer._markers              # without any message
    viewer._odom = Odom(5.0, position, np.zeros(3), rotation, np.zeros(3))
    viewer._joints = JointReading(5.0, tilt, np.zeros(4))
    viewer._command = Command(5.0, tilt, np.array([8.0, 4.0, 0.0, 20.0]))
    viewer._target = PoseTarget(position, rotation)
    viewer._markers.subscribed = viewer._transforms.subscribed = 0
    viewer._draw()
    viewer._move()
    assert not viewer._markers and not viewer._transforms
    viewer._markers.subscribed = 1
    viewer._draw()
    markers = {marker.ns: marker for marker in viewer._markers[-1].markers}
    assert set(markers) == {'body', 'rotor1', 'rotor2', 'rotor3', 'rotor4', 'target'}
    arrows = np.array([[[p.x, p.y, p.z] for p in markers[f'rotor{k}'].points]
                       for k in (1, 2, 3, 4)])
    thrust = (arrows[:, 1] - arrows[:, 0]) @ rotations.matrix(rotation) \
        * viewer.parameters.newton_per_metre
    assert np.linalg.norm(thrust, axis=1) == pytest.approx([8, 4, 0, 20])
    assert thrust[0] == pytest.approx([0, 0, 8])                        # q = 0: up
    axis = viewer._robot.tilt_axes[1]
    assert thrust[1] == pytest.approx(4 * np.cross(axis, [0, 0, 1]))    # a quarter turn about it
    assert markers['rotor1'].header.frame_id == 'world'


def test_the_frames_of_all_links_form_one_tree_and_stand_where_the_rotors_are(viewer):
    if transform_message() is None:
        pytest.skip('no tf2_msgs here, and none can be made')
    rotation = rotations.from_rpy(0.4, -0.2, 1.0)
    position, tilt = np.array([1.0, 2.0, 3.0]), np.array([0.0, np.pi / 2, 0.0, -0.3])
    viewer._odom = Odom(5.0, position, np.zeros(3), rotation, np.zeros(3))
    viewer._joints = JointReading(4.9, tilt, np.zeros(4))
    viewer._move()
    frames = {frame.child_frame_id: frame for topic in ('/tf', '/tf_static')
              for frame in viewer.sent[topic][-1].transforms}
    assert set(frames) == {'base_link', 'main_body', 'end_effector', 'imu', *(
        f'{kind}{k}' for kind in ('module', 'rotor') for k in (1, 2, 3, 4))}
    assert frames['base_link'].header.stamp.sec == 5
    for k in range(4):
        at, turn, name = np.zeros(3), np.array([0, 0, 0, 1.0]), f'rotor{k + 1}'
        while name != 'world':
            frame = frames[name]
            here = conversions.xyzw(frame.transform.rotation)
            at = rotations.matrix(here) @ at + conversions.xyz(frame.transform.translation)
            turn, name = rotations.multiply(here, turn), frame.header.frame_id
        axes = rotations.matrix(rotation)
        assert at == pytest.approx(position + axes @ viewer._robot.rotors.positions[k])
        tilted = rotations.matrix(rotations.exp(viewer._robot.tilt_axes[k] * tilt[k]))
        assert rotations.matrix(turn)[:, 2] == pytest.approx(axes @ tilted[:, 2])
    assert '<robot' in viewer.sent['robot_description'][0].data
