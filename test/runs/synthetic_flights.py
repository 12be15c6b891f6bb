"""Synthetic flights for the tests: known errors instead of a simulator."""

import numpy as np

from beetle_omni_ros.control.base import PoseTarget
from beetle_omni_ros.robot import rotations

TICK = 0.005


def fly(recorder, task, *, start=1.0, controller='nmpc', offset=0.02, angle=3.0, approach=0.5,
        seed=0, duration=None, after=0.2):
    """
    Record a flight that follows every target with a decaying and a steady error.

    Args:
        recorder: LogRecorder, BagWriter or Tee.
        task: what to fly.
        start: when the first target is issued [s].
        controller: who flies.
        offset: steady position error along x [m].
        angle: steady orientation error about the body's z [deg].
        approach: time constant of the approach [s].
        seed: of the noise of commands and estimate.
        duration: cut the flight after this time [s].
        after: how long the recording goes on after the task [s].

    """
    rng = np.random.default_rng(seed)
    targets = task.targets(start)
    length = (task.duration if duration is None else duration) + after
    recorder.write_state(start - 1.0, 'takeoff')
    recorder.write_state(start - 0.01, f'flying:{controller}')
    target, previous, current = None, np.array([0.0, 0.0, 1.0]), -1
    for k in range(-20, round(length / TICK) + 1):
        t = start + k * TICK
        while current + 1 < len(targets) and targets[current + 1].stamp <= t + 1e-9:
            current += 1
            if target is not None:
                previous = target.at(t).position
            target = targets[current]
            recorder.write_target(target)
        reference = (target or PoseTarget(previous, np.array([0.0, 0, 0, 1]))).at(t)
        decay = 0.0
        if isinstance(target, PoseTarget):
            decay = np.exp(-(t - target.stamp) / approach)
        position = reference.position + decay * (previous - reference.position) \
            + [offset, 0.0, 0.0]
        turn = rotations.exp(np.array([0, 0, np.radians(angle)]))
        quaternion = rotations.multiply(reference.quaternion, turn)
        _record(recorder, t, k, rng, position, quaternion, reference, controller)
    recorder.write_state(start + length, 'landing')


def _record(recorder, t, k, rng, position, quaternion, reference, controller):
    velocity, rate = reference.velocity, reference.angular_velocity
    recorder.write_truth(t, position, quaternion, velocity, rate)
    recorder.write_odom(t, position + 1e-3 * rng.normal(size=3), quaternion, velocity, rate)
    recorder.write_imu(t, np.array([0, 0, 9.8]) + 0.05 * rng.normal(size=3), rate)
    tilt = 0.3 * np.sin(0.5 * t + np.arange(4.0))
    recorder.write_joints(t - 0.01, tilt - 0.005, np.zeros(4), np.full(4, 0.01), received=t)
    if k % 2 == 0:
        thrust = 7.45 + 0.1 * rng.normal(size=4)
        recorder.write_mocap(t - 0.01, position, quaternion, received=t)
        recorder.write_request(controller, t, tilt, thrust, received=t + 0.002)
        recorder.write_command(t, tilt, thrust, received=t + 0.003)
    if k % 20 == 0:
        recorder.write_battery(t, 25.0 - 0.001 * k * TICK, -20.0)
    if k % 200 == 0:
        recorder.write_compute(t, controller, median=0.2, p99=0.4, max=0.9, deadline_misses=0,
                               count=max(0, k // 2))
        recorder.write_diagnostic(t, 'ekf_node: estimator', {'rejected_mocap': max(0, k) // 400},
                                  1 if k == 400 else 0, 'one MoCap pose was no unit quaternion')
