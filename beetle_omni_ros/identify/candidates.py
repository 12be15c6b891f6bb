"""What a servo model may hold beside frequency and damping, and where a fit of it starts."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from beetle_omni_ros.identify.joint_log import JointLog
from beetle_omni_ros.identify.servo_model import NAMES

LINEAR = ('natural_frequency', 'damping_ratio')   # always there


@dataclass(frozen=True)
class Candidate:
    """
    What may join the model.

    Attributes:
        members: names of its numbers in a parameter set.
        starts: (log, joint index) -> values of the members to start from, several.
        needs: a candidate that must be there before.

    """

    members: tuple[str, ...]
    starts: Callable[[JointLog, int], list[tuple[float, ...]]]
    needs: str | None = None


def _speeds(log, joint):
    return [(0.97 * log.speed()[joint],), (0.8 * log.speed()[joint],)]


def _errors(log, joint):
    largest = np.abs(log.command[joint] - log.measured[joint]).max()
    return [(0.9 * largest,), (0.6 * largest,)]


CANDIDATES = {
    'delay': Candidate(('delay',), lambda log, joint: [(0.006,), (0.02,)]),
    'coulomb_friction': Candidate(('coulomb_friction',), lambda log, joint: [(0.01,), (0.04,)]),
    'backlash': Candidate(('backlash',), lambda log, joint: [(0.01,), (0.03,)]),
    'offset': Candidate(('offset',), lambda log, joint: [(
        float(np.mean(log.measured[joint] - log.command[joint])),)]),
    'stiction': Candidate(('stiction', 'stribeck_velocity'),
                          lambda log, joint: [(0.005, 0.1), (0.005, 1.0)], 'coulomb_friction'),
    'velocity_limit': Candidate(('velocity_limit',), _speeds),
    'torque_limit': Candidate(('torque_limit',), _errors),
    'load': Candidate(('load_sine', 'load_cosine'),
                      lambda log, joint: [(0.005, 0.005), (-0.005, -0.005)]),
}

# Offered in this order. A delay and friction or play are certain to be there in some size, a limit
# that was met spoils all else, and what comes later imitates them on slow logs: stiction, above
# all, can stand in for a delay.
TIERS = (('delay', 'coulomb_friction', 'backlash', 'offset', 'velocity_limit', 'torque_limit'),
         ('stiction',), ('load',))
# What looks much alike: a dead band or play, a limit of speed or of torque.
RIVALS = {'coulomb_friction': 'backlash', 'backlash': 'coulomb_friction',
          'velocity_limit': 'torque_limit', 'torque_limit': 'velocity_limit'}


def free_mask(kept: tuple[str, ...]) -> np.ndarray:
    """(n,) which numbers a model with these candidates fits."""
    names = set(LINEAR).union(*(CANDIDATES[name].members for name in kept))
    return np.array([name in names for name in NAMES])
