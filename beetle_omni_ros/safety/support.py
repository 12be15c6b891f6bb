"""How much of the weight the rotors carry, and so whether something else does."""

from __future__ import annotations

from math import exp

import numpy as np

from beetle_omni_ros.control.base import Command
from beetle_omni_ros.robot import rotations
from beetle_omni_ros.robot.allocation import Allocator

BASELINE_TIME = 2.0             # [s] over which the thrust that carries the weight is learnt
BASELINE_RANGE = (0.7, 1.4)     # of the modelled one; more is a disturbance, not the rotors
LEAST_THRUST = 0.3              # [weights] below it the ratio says nothing


class SupportGauge:
    """
    How much of the weight the rotors do not carry, from commands and accelerometer.

    The rotors' true strength differs from the model's by several percent, so the ratio of
    specific force to commanded thrust is learnt in free flight and held while landing.
    """

    def __init__(self, allocator: Allocator, gravity: float, time_constant: float):
        self._allocator, self._gravity, self._lag = allocator, gravity, time_constant
        self._baseline = 1.0
        self.thrust = 0.0     # along world up, in weights, as it has built up
        self.lift = 0.0       # the same, corrected by the baseline

    def update(self, command: Command | None, quaternion: np.ndarray, dt: float,
               specific_force_up: float | None, learn: bool) -> None:
        """One tick."""
        now = 0.0
        if command is not None:
            force, _ = self._allocator.wrench(command.tilt, command.thrust)
            now = float(rotations.matrix(quaternion)[2] @ force) \
                / (self._allocator.mass * self._gravity)
        self.thrust += (1.0 - exp(-dt / self._lag)) * (now - self.thrust)
        if learn and specific_force_up is not None and self.thrust > LEAST_THRUST:
            low, high = BASELINE_RANGE
            ratio = min(max(specific_force_up / self._gravity / self.thrust, low), high)
            self._baseline += min(1.0, dt / BASELINE_TIME) * (ratio - self._baseline)
        self.lift = self._baseline * self.thrust

    def support(self, specific_force_up: float | None) -> float:
        """Share of the weight that something else carries."""
        felt = 1.0 if specific_force_up is None else specific_force_up / self._gravity
        return felt - self.lift
