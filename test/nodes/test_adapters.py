"""Behaviour of the nodes themselves: triggering, holding, selecting, refusing."""

from types import SimpleNamespace

import numpy as np
import pytest
import rclpy
from rclpy.parameter import Parameter

from beetle_omni_ros.control.base import Command, PoseTarget
from beetle_omni_ros.control.registry import ControllerEntry
from beetle_omni_ros.messages import conversions
from beetle_omni_ros.messages.values import Odom
from beetle_omni_ros.nodes import wire
from beetle_omni_ros.nodes.controller_node import ControllerNode
from beetle_omni_ros.nodes.ekf_node import EkfNode
from beetle_omni_ros.nodes.reference_node import ReferenceNode
from beetle_omni_ros.nodes.sim_node import SimNode
from beetle_omni_ros.nodes.supervisor_node import SupervisorNode
from beetle_omni_ros.robot.readings import ImuReading, JointReading, PoseReading

LEVEL = np.array([0.0, 0.0, 0.0, 1.0])


@pytest.fixture
def make(ros_domain):
    """Make one node in this process, with parameters."""
    nodes = []

    def build(node_class, *overrides):
        arguments = [a for override in overrides for a in ('-p', override)]
        rclpy.init(args=['--ros-args', *arguments], domain_id=ros_domain)
        nodes.append(node_class())
        return nodes[0]

    yield build
    for node in nodes:
        node.destroy_node()
    rclpy.try_shutdown()


class Sent(list):
    """A publisher of a topic that keeps its messages."""

    def __init__(self, topic):
        super().__init__()
        self._topic = topic

    def publish(self, value):
        """Store a value."""
        self.append(wire.message(self._topic, value))


class Follower:
    """A controller that records its targets."""

    name, period = 'follower', 0.01

    def __init__(self):
        self.received, self.resets = [], 0

    def reset(self):
        self.resets += 1

    def step(self, state, target):
        self.received.append((state, target))
        return Command(state.stamp, np.zeros(4), np.full(4, 7.5))

    def diagnostics(self):
        return {'steps': len(self.received)}


class FollowerNode(ControllerNode):
    """The controller node with a controller without solver."""

    def __init__(self):
        super().__init__(ControllerEntry(name='nmpc', controller=Follower))
        self._publisher = Sent('nmpc/command')
        self.follower = self._host.controller


def odom_at(stamp, height=1.0):
    return Odom(stamp, np.array([0, 0, height]), np.zeros(3), LEVEL, np.zeros(3))


def fly(node, stamps, height=1.0):
    for stamp in stamps:
        node._on_odom(odom_at(stamp, height))


def test_the_controller_steps_once_a_period_and_stamps_with_the_state(make):
    node = make(FollowerNode)
    fly(node, 100 + 0.005 * np.arange(20))
    assert not node._publisher          # no joint angles yet
    node._on_joints(JointReading(100.0, np.zeros(4), np.zeros(4)))
    stamps = 101 + 0.005 * np.arange(200)
    fly(node, stamps)
    sent = [conversions.seconds(m.header.stamp) for m in node._publisher]
    assert len(sent) == 100
    assert np.allclose(sent, stamps[::2])
    fly(node, [95.0, 95.005, 95.01])    # the clock was set back, and the new time is used
    assert len(node._publisher) == 102


@pytest.mark.parametrize('rate', [100, 200])
def test_a_controller_on_standby_steps_between_the_steps_of_the_one_that_flies(make, rate):
    node = make(FollowerNode)
    node._on_joints(JointReading(100.0, np.zeros(4), np.zeros(4)))

    def steps_from(begin):
        before = len(node._publisher)
        for stamp in begin + np.arange(rate) / rate:
            due = round((stamp - begin) * rate) % (rate // 100) == 0
            if due and node._host.mode == 'flying:rl':
                node._on_command(Command(stamp, np.zeros(4), np.full(4, 7.5)))
            fly(node, [stamp])
        return np.array([conversions.seconds(m.header.stamp) for m in node._publisher[before:]])

    alone = steps_from(100.0)
    assert np.allclose(alone - 100.0, 0.01 * np.arange(100), atol=1e-6)
    node._on_mode('flying:rl')
    standby = steps_from(101.0)[5:]
    if rate > 100:
        assert np.all(np.abs((standby - 101.0) / 0.01 % 1.0 - 0.5) < 0.26)
        assert np.allclose(np.diff(standby), 0.01, atol=1e-6)
    else:       # no estimate in between: half the rate, within the timeout
        assert np.allclose(np.diff(standby), 0.02, atol=1e-6)
    node._on_mode('flying:nmpc')
    assert np.allclose(np.diff(steps_from(102.0)), 0.01, atol=1e-6)


def test_without_a_target_the_pose_of_the_handover_is_held(make):
    node = make(FollowerNode)
    node._on_joints(JointReading(100.0, np.zeros(4), np.zeros(4)))
    node._on_mode('takeoff')
    fly(node, [100.0], height=0.2)
    node._on_mode('flying:nmpc')
    fly(node, [100.01], height=1.3)
    heights = [target.position[2] for _, target in node.follower.received]
    assert heights == [0.2, 0.2]
    node._on_mode('disarmed')
    assert node.follower.resets == 1
    fly(node, [101.0], height=0.4)
    assert node.follower.received[-1][1].position[2] == 0.4


def test_the_newest_target_is_used_and_an_unset_stamp_means_now(make):
    node = make(FollowerNode)
    node._on_joints(JointReading(100.0, np.zeros(4), np.zeros(4)))
    for stamp, x in ((50.0, 1.0), (60.0, 2.0), (50.0, 3.0)):
        node._on_target(PoseTarget(np.array([x, 0, 0]), LEVEL, stamp))
    fly(node, [100.0])
    assert node.follower.received[-1][1].position[0] == 2.0
    node._on_target(PoseTarget(np.array([4.0, 0, 0]), LEVEL, 0.0))
    fly(node, [101.0])
    assert node.follower.received[-1][1].position[0] == 4.0
    assert node.follower.received[-1][1].stamp == pytest.approx(node.now(), abs=5)


def test_the_payload_changes_in_flight_within_its_range(make):
    node = make(SimNode, 'payload:=0.25')
    assert node.set_parameters([Parameter('payload', value=1.0)])[0].successful
    assert not node.set_parameters([Parameter('payload', value=-1.0)])[0].successful
    assert not node.set_parameters([Parameter('seed', value=3)])[0].successful


def test_the_supervisor_accepts_known_controllers_only(make):
    node = make(SupervisorNode)

    def select(name):
        return node.set_parameters([Parameter('controller', value=name)])[0]

    assert select('rl').successful and node._supervisor.active == 'rl'
    refused = select('pid')
    assert not refused.successful and 'nmpc, rl' in refused.reason
    assert node._supervisor.active == 'rl'
    assert not node.set_parameters([Parameter('takeoff.height', value=2.0)])[0].successful


def test_the_supervisor_refuses_to_arm_without_an_estimate_with_the_reason(make):
    node = make(SupervisorNode)
    answer = node._request('arm')(None, SimpleNamespace())
    assert not answer.success and 'ekf_node' in answer.message
    assert node._state == 'disarmed'


def test_the_reference_node_starts_the_task_in_flight(make, monkeypatch):
    node = make(ReferenceNode, 'task:=waypoints')
    clock = SimpleNamespace(now=2000.0)
    monkeypatch.setattr(node, 'now', lambda: clock.now)
    node._poses, node._states = Sent('target_pose'), Sent('reference/state')
    node._on_timer()
    assert not node._poses
    node._on_supervisor('flying:nmpc')
    while clock.now < 2000 + 15 * 8 + 1:
        node._on_timer()
        clock.now += 0.02
    stamps = [conversions.seconds(m.header.stamp) for m in node._poses]
    assert np.allclose(stamps, 2000 + 8 * np.arange(15))
    assert node._states[0].data == 'flying 1/15' and node._states[-1].data == 'done'


def test_a_landing_in_the_middle_aborts_the_task(make):
    node = make(ReferenceNode, 'task:=hover')
    node._on_supervisor('flying:nmpc')
    node._on_timer()
    node._on_supervisor('landing')
    assert node._state == 'aborted'


def test_trajectory_windows_join_without_a_gap_and_keep_to_the_path(make, monkeypatch):
    node = make(ReferenceNode, 'task:=lemniscate')
    clock = SimpleNamespace(now=2000.0)
    monkeypatch.setattr(node, 'now', lambda: clock.now)
    node._trajectories = Sent('target_trajectory')
    node._on_supervisor('flying:nmpc')
    path = node._task.segments[-1].target(2008.0)
    while node._state != 'done':
        node._on_timer()
        clock.now += 0.02
        assert clock.now < 2200
        if node._trajectories and clock.now < path.times[-1] - 0.1:
            window = conversions.take_trajectory(node._trajectories[-1])
            assert window.times[0] <= clock.now and clock.now + 1.0 < max(
                window.times[-1], path.times[-1] - 0.1 + 1.2)
            assert np.linalg.norm(window.at(clock.now).position
                                  - path.at(clock.now).position) < 1e-3
    assert conversions.take_trajectory(node._trajectories[0]).times[0] == pytest.approx(2008.0)


def test_the_estimator_publishes_only_valid_estimates(make):
    node = make(EkfNode)
    node._publisher = Sent('odom')
    at_rest = np.array([0, 0, 9.80665])
    for k in range(400):
        stamp = 100 + 0.005 * k
        if k % 2:
            node._on_pose(PoseReading(stamp - 0.01, np.array([0, 0, 0.3]), LEVEL))
        node._on_imu(ImuReading(stamp, at_rest, np.zeros(3)))
        if k == 3:
            assert not node._publisher      # too few poses for an estimate
    message = node._publisher[-1]
    covariance = np.reshape(message.pose.covariance, (6, 6))
    assert message.pose.pose.position.z == pytest.approx(0.3, abs=0.01)
    assert np.allclose(covariance, covariance.T) and np.all(np.linalg.eigvalsh(covariance) > 0)
    assert np.linalg.eigvalsh(np.reshape(message.twist.covariance, (6, 6))).min() > 0
