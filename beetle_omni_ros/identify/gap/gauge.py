"""Delays that data cannot tell apart, moved to where they are looked for."""

from __future__ import annotations

import numpy as np

from beetle_omni_ros.identify.gap.keys import THRUST_BUS, TILT_BUS

COMMANDS = ('command_latency', 'joint_command_latency', 'rotor_dead_time')
SENSORS = ('imu_filter_lag.delay', 'mocap_time_offset.delay', 'joint_feedback_delay.delay')


def handed_over(theta, candidate):
    """
    The same delays, with what the bus was blamed for in the candidate's own number.

    Args:
        theta: numbers by key.
        candidate: that joins the model.

    Otherwise a fit that starts with half the delay in a number that it need not leave would
    stay there, for the data cannot tell the two apart.

    """
    key = f'{candidate.name}.delay'
    if candidate.name not in COMMANDS or theta.get(key):
        return theta
    # All sensors late by the same is all commands early by it: an exact gauge.
    late = float(np.mean([theta.get(name, 0.0) for name in SENSORS]))
    made = {**theta, **{name: theta.get(name, 0.0) - late for name in SENSORS}}
    tilt, thrust = (theta.get(name, 0.0) + late for name in (TILT_BUS, THRUST_BUS))
    both = (tilt + thrust) / 2
    own, tilt, thrust = {
        'command_latency': (both, tilt - both, thrust - both),
        'joint_command_latency': (tilt - thrust, thrust, thrust),
        'rotor_dead_time': (thrust - tilt, tilt, tilt)}[candidate.name]
    return {**made, key: own, TILT_BUS: tilt, THRUST_BUS: thrust}
