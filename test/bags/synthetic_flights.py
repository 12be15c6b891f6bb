"""Synthetic flights for the tests: known errors instead of a simulator."""

import numpy as np

from beetle_omni_ros.bags.messages import Diagnostic
from beetle_omni_ros.control.base import Command, PoseTarget
from beetle_omni_ros.model import rotations
from beetle_omni_ros.model.readings import BatteryReading, ImuReading, JointReading, PoseReading
from beetle_omni_ros.model.rotations import BodyState

TICK = 0.005


def targets_of(task, start):
    """All targets of a flight of a task that starts at ``start`` [s]."""
    begins = start + np.concatenate([[0.0], task.ends[:-1]])
    return [segment.target(float(begin))
            for begin, segment in zip(begins, task.segments, strict=True) if segment.target]


def fly(recorder, task, *, start=1.0, controller='nmpc', offset=0.02, angle=3.0, approach=0.5,
        seed=0, duration=None, after=0.2, tick=TICK):
    """
    Record a flight that follows every target with a decaying and a steady error.

    Args:
        recorder: LogRecorder, BagWriter or Recorder.
        task: task to fly.
        start: time of the first target [s].
        controller: name of the active controller.
        offset: steady position error along x [m].
        angle: steady orientation error about the body's z [deg].
        approach: time constant of the approach [s].
        seed: seed of the noise of commands and estimate.
        duration: cut the flight after this time [s].
        after: time of recording after the task [s].
        tick: time between samples [s].

    """
    rng = np.random.default_rng(seed)
    targets = targets_of(task, start)
    length = (task.duration if duration is None else duration) + after
    write_state(recorder, start - 1.0, 'takeoff')
    write_state(recorder, start - 0.01, f'flying:{controller}')
    target, previous, current = None, np.array([0.0, 0.0, 1.0]), -1
    for k in range(-20, round(length / tick) + 1):
        t = start + k * tick
        while current + 1 < len(targets) and targets[current + 1].stamp <= t + 1e-9:
            current += 1
            if target is not None:
                previous = target.at(t).position
            target = targets[current]
            write_target(recorder, target)
        reference = (target or PoseTarget(previous, np.array([0.0, 0, 0, 1]))).at(t)
        decay = 0.0
        if isinstance(target, PoseTarget):
            decay = np.exp(-(t - target.stamp) / approach)
        position = reference.position + decay * (previous - reference.position) \
            + [offset, 0.0, 0.0]
        turn = rotations.exp(np.array([0, 0, np.radians(angle)]))
        quaternion = rotations.multiply(reference.quaternion, turn)
        _record(recorder, t, k, rng, position, quaternion, reference, controller)
    write_state(recorder, start + length, 'landing')


def _record(recorder, t, k, rng, position, quaternion, reference, controller):
    velocity, rate = reference.velocity, reference.angular_velocity
    write_truth(recorder, t, position, quaternion, velocity, rate)
    write_odom(recorder, t, position + 1e-3 * rng.normal(size=3), quaternion, velocity, rate)
    write_imu(recorder, t, np.array([0, 0, 9.8]) + 0.05 * rng.normal(size=3), rate)
    tilt = 0.3 * np.sin(0.5 * t + np.arange(4.0))
    write_joints(recorder, t - 0.01, tilt - 0.005, np.zeros(4), np.full(4, 0.01), received=t)
    if k % 2 == 0:
        thrust = 7.45 + 0.1 * rng.normal(size=4)
        recorder.write('mocap/pose', PoseReading(t - 0.01, position, quaternion), t)
        recorder.write(f'{controller}/command', Command(t, tilt, thrust), t + 0.002)
        write_command(recorder, t, tilt, thrust, received=t + 0.003)
    if k % 20 == 0:
        recorder.write('battery_state', BatteryReading(t, 25.0 - 0.001 * t, -20.0))
    if k % 200 == 0:
        write_diagnostic(recorder, t, f'{controller}_node: compute', {
            'median_ms': 0.2, 'p99_ms': 0.4, 'max_ms': 0.9, 'deadline_misses': 0,
            'count': max(0, k // 2)})
        write_diagnostic(
            recorder, t, 'ekf_node: estimator', {'rejected_mocap': max(0, k) // 400},
            1 if k == 400 else 0, 'one MoCap pose was no unit quaternion')


def write_truth(recorder, t, position, quaternion, velocity, angular_velocity):
    """Simulated truth; velocity in world, angular velocity in base_link."""
    recorder.write('ground_truth/odom', BodyState(t, position, velocity, quaternion,
                                                  angular_velocity))


def write_odom(recorder, t, position, quaternion, velocity, angular_velocity):
    """Record an estimate; velocity in world."""
    recorder.write('odom', BodyState(t, position, velocity, quaternion, angular_velocity))


def write_imu(recorder, t, specific_force, angular_velocity):
    """One IMU sample in base_link."""
    recorder.write('imu/data_raw', ImuReading(t, specific_force, angular_velocity))


def write_joints(recorder, t, position, velocity, effort=None, received=None):
    """One joint feedback, captured at ``t``, available at ``received``."""
    recorder.write('joint_states', JointReading(t, position, velocity, effort), received)


def write_command(recorder, t, tilt, thrust, received=None):
    """Record the selected command; ``t`` is the stamp of the estimate that it answers."""
    recorder.write('command', Command(t, tilt, thrust), received)


def write_state(recorder, t, state):
    """Record the supervisor's state, e.g. 'flying:nmpc', whenever it changes."""
    recorder.write('supervisor/state', state, t)


def write_target(recorder, target):
    """Record a target, valid from its stamp."""
    recorder.write('target_pose' if isinstance(target, PoseTarget) else 'target_trajectory',
                   target)


def write_diagnostic(recorder, t, name, values, level=0, message=''):
    """Record one status such as 'ekf_node: estimator', with numbers or text as values."""
    recorder.write('diagnostics', [Diagnostic(t, name, level, message, {
        key: str(value) for key, value in values.items()})])
