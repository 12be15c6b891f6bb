"""Behaviour of estimator, supervisor and reference node."""

from types import SimpleNamespace

import numpy as np
import pytest
from witness import Sent

from beetle_omni_ros.messages import conversions
from beetle_omni_ros.nodes.control_nodes import EkfNode, SupervisorNode
from beetle_omni_ros.nodes.node import Distribution
from beetle_omni_ros.nodes.side_nodes import ReferenceNode
from beetle_omni_ros.robot.readings import ImuReading, PoseReading

LEVEL = np.array([0.0, 0.0, 0.0, 1.0])


def test_the_supervisor_refuses_to_arm_with_the_reason_of_bridges_or_estimator(make):
    node = make(SupervisorNode)

    def refusal():
        answer = node._on_request('arm', None, SimpleNamespace())
        assert not answer.success and node._state == 'disarmed'
        return answer.message

    assert 'ekf_node' in refusal()
    node._on_bridge('rotor', 'waiting: battery low')
    node._on_bridge('joint', 'lost: gimbal3 silent')
    assert refusal() == 'arm refused: joint_bridge_node lost: gimbal3 silent; rotor_bridge_node ' \
                        'waiting: battery low'
    for name in ('joint', 'rotor'):
        node._on_bridge(name, 'ready')
    assert 'no fresh state estimate' in refusal()


@pytest.fixture
def reference(make, monkeypatch):
    """Make a reference node of a task, with a clock that the test sets."""
    def build(task):
        node, clock = make(ReferenceNode, f'task:={task}'), SimpleNamespace(now=2000.0)
        monkeypatch.setattr(node, 'now', lambda: clock.now)
        node._poses, node._states = Sent('target_pose'), Sent('reference/state')
        node._trajectories = Sent('target_trajectory')
        return node, clock
    return build


def test_the_reference_node_starts_the_task_in_flight_and_a_landing_aborts_it(reference):
    node, clock = reference('waypoints')
    node._on_timer()
    assert not node._poses
    node._on_supervisor('flying:nmpc')
    while clock.now < 2000 + 14 * 8 + 1:
        node._on_timer()
        clock.now += 0.02
    assert np.allclose(node._poses.stamps(), 2000 + 8 * np.arange(15))
    assert node._states[0].data == 'flying 1/15'
    node._on_supervisor('landing')
    assert node._state == 'aborted'


def test_trajectory_windows_join_without_a_gap_and_keep_to_the_path(reference):
    node, clock = reference('lemniscate')
    node._on_supervisor('flying:nmpc')
    path = node._task.segments[-1].target(2008.0)
    while node._state != 'done':
        node._on_timer()
        clock.now += 0.02
        assert clock.now < 2200
        if node._trajectories and clock.now < path.times[-1] - 0.1:
            window = conversions.read_trajectory(node._trajectories[-1])
            assert window.times[0] <= clock.now and clock.now + 1.0 < max(
                window.times[-1], path.times[-1] - 0.1 + 1.2)
            assert np.linalg.norm(window.at(clock.now).position
                                  - path.at(clock.now).position) < 1e-3
    assert conversions.read_trajectory(node._trajectories[0]).times[0] == pytest.approx(2008.0)


def test_a_stick_push_of_the_task_is_published_for_its_duration(reference):
    node, clock = reference('pushes')
    node._wrenches, impulse = Sent('disturbance'), np.zeros(3)
    node._on_supervisor('flying:nmpc')
    while clock.now < 2012.9:
        node._on_timer()
        force = node._wrenches[-1].wrench.force
        impulse += 0.005 * np.array([force.x, force.y, force.z])
        clock.now += 0.005
    assert impulse == pytest.approx([1.0, 0, 0], abs=0.06)


def test_the_estimator_publishes_only_valid_estimates(make):
    node = make(EkfNode)
    node._publisher = Sent('odom')
    for k in range(400):
        stamp, noise = 100 + 0.005 * k, 1e-6 * np.sin(k)
        if k % 2:
            node._ekf.pose(PoseReading(stamp - 0.01, np.array([noise, 0, 0.3]), LEVEL))
        node._on_imu(ImuReading(stamp, np.array([noise, 0, 9.80665]), np.zeros(3)))
        if k == 3:
            assert not node._publisher      # too few poses for an estimate
    message = node._publisher[-1]
    assert message.pose.pose.position.z == pytest.approx(0.3, abs=0.01)
    for covariance in (message.pose.covariance, message.twist.covariance):
        assert np.linalg.eigvalsh(np.reshape(covariance, (6, 6))).min() > 0


def test_quantiles_agree_with_sorting_within_two_percent():
    distribution = Distribution()
    assert np.isnan(distribution.quantile(0.5))
    samples = 1e-3 * np.exp(np.random.default_rng(1).normal(0, 2.0, 5000))
    for sample in samples:
        distribution.add(float(sample))
    for fraction in (0.5, 0.9, 0.99):
        assert distribution.quantile(fraction) == pytest.approx(
            np.quantile(samples, fraction), rel=0.02)
    assert distribution.max == samples.max() and distribution.count == 5000
