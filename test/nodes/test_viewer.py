"""Markers and frame of the viewer agree with the topics."""

from types import SimpleNamespace

import numpy as np
import pytest

from beetle_omni_ros.control.base import Command, PoseTarget
from beetle_omni_ros.messages.values import Odom
from beetle_omni_ros.nodes.side_nodes import NEWTON_PER_METRE, ViewerNode
from beetle_omni_ros.robot import rotations
from beetle_omni_ros.robot.readings import JointReading


@pytest.fixture
def viewer(make, monkeypatch):
    node = make(ViewerNode)
    monkeypatch.setattr(node, '_markers', SimpleNamespace(
        sent=[], get_subscription_count=lambda: 1))
    node._markers.publish = node._markers.sent.append
    return node


def test_thrust_arrows_point_along_the_tilted_rotors(viewer):
    rotation = rotations.from_rpy(0.4, -0.2, 1.0)
    position, tilt = np.array([1.0, 2.0, 3.0]), np.array([0.0, np.pi / 2, 0.0, -0.3])
    viewer._odom = Odom(5.0, position, np.zeros(3), rotation, np.zeros(3))
    viewer._joints = JointReading(5.0, tilt, np.zeros(4))
    viewer._command = Command(5.0, tilt, np.array([8.0, 4.0, 0.0, 20.0]))
    viewer._target = PoseTarget(position, rotation)
    viewer._draw()
    markers = {marker.ns: marker for marker in viewer._markers.sent[-1].markers}
    assert set(markers) == {'body', 'rotor1', 'rotor2', 'rotor3', 'rotor4', 'target'}
    arrows = np.array([[[p.x, p.y, p.z] for p in markers[f'rotor{k}'].points]
                       for k in (1, 2, 3, 4)])
    thrust = (arrows[:, 1] - arrows[:, 0]) @ rotations.matrix(rotation) \
        * NEWTON_PER_METRE
    assert np.linalg.norm(thrust, axis=1) == pytest.approx([8, 4, 0, 20])
    assert thrust[0] == pytest.approx([0, 0, 8])                        # q = 0: up
    axis = viewer._robot.tilt_axes[1]
    assert thrust[1] == pytest.approx(4 * np.cross(axis, [0, 0, 1]))    # a quarter turn about it
    assert markers['rotor1'].header.frame_id == 'world'
