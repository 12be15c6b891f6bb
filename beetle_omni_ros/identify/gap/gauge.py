"""Delays that data cannot tell apart, moved to where they are looked for."""

from __future__ import annotations

import numpy as np

from beetle_omni_ros.identify.gap.keys import delays_of, THRUST_BUS, TILT_BUS
from beetle_omni_ros.robot.effects import CATALOGUE

SENSORS = delays_of('imu', 'mocap', 'encoders')


def handed_over(theta, candidate):
    """
    The same delays, with what the bus was blamed for in the candidate's own number.

    Args:
        theta: numbers by key.
        candidate: that joins the model.

    Otherwise a fit that starts with half the delay in a number that it need not leave would
    stay there, for the data cannot tell the two apart.

    """
    key, late = f'{candidate.name}.delay', CATALOGUE[candidate.name].delays
    if not {'tilt', 'thrust'} & set(late) or theta.get(key):
        return theta
    # All sensors late by the same is all commands early by it: an exact gauge.
    common = float(np.mean([theta.get(name, 0.0) for name in SENSORS]))
    made = {**theta, **{name: theta.get(name, 0.0) - common for name in SENSORS}}
    tilt, thrust = (theta.get(name, 0.0) + common for name in (TILT_BUS, THRUST_BUS))
    if len(late) == 2:
        own = (tilt + thrust) / 2
        tilt, thrust = tilt - own, thrust - own
    elif late == ('tilt',):
        own, tilt = tilt - thrust, thrust
    else:
        own, thrust = thrust - tilt, tilt
    return {**made, key: own, TILT_BUS: tilt, THRUST_BUS: thrust}
