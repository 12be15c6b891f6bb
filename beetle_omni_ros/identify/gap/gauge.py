"""Delays that data cannot tell apart, moved to where they are looked for."""

from __future__ import annotations

import numpy as np

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
    delay, split = theta.get('base.delay', 0.0) + late, theta.get('base.split', 0.0)
    own, delay, split = {
        'command_latency': (delay, 0.0, split),
        'joint_command_latency': (split, delay - split / 2, 0.0),
        'rotor_dead_time': (-split, delay + split / 2, 0.0)}[candidate.name]
    return {**made, key: own, 'base.delay': delay, 'base.split': split}
