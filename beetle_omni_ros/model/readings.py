"""Readings of sensors and devices, simulated or real: stamps of capture [s], SI units."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from beetle_omni_ros.model.parameters import JOINT_NAMES
from beetle_omni_ros.model.terms import SensorErrors


@dataclass(slots=True)
class ImuReading:
    """One IMU reading (REP-145), in the IMU's own axes."""

    stamp: float
    specific_force: np.ndarray      # (3,) acceleration minus gravity [m/s^2]; +g upward at rest
    angular_velocity: np.ndarray    # (3,) [rad/s]


@dataclass(slots=True)
class PoseReading:
    """One MoCap pose of the tracked body in world."""

    stamp: float
    position: np.ndarray        # (3,) [m]
    quaternion: np.ndarray      # (4,) body to world (x, y, z, w), of either sign


@dataclass(slots=True)
class JointReading:
    """One reading of the tilt joints."""

    stamp: float
    position: np.ndarray                # (4,) [rad]
    velocity: np.ndarray | None         # (4,) [rad/s], None if not measured
    effort: np.ndarray | None = None    # (4,) [N m], None if not measured
    names: Sequence[str] = JOINT_NAMES  # fewer than four are legal in a written message

    def corrected(self, errors: SensorErrors) -> JointReading:
        """The reading without the errors of the encoders that the robot file states."""
        return replace(self, position=errors.tilts(self.position)) if errors.encoders_err \
            else self


@dataclass(slots=True)
class BatteryReading:
    """Pack voltage under load [V] and current [A], negative in discharge."""

    stamp: float
    voltage: float
    current: float


@dataclass(slots=True)
class RotorReading:
    """Rotor speeds from the ESCs (4,) [rad/s], positive for both spins; NaN: unknown."""

    stamp: float
    speed: np.ndarray


# Changes of specific force [m/s^2] and rate [rad/s] between two readings that are jumps; full
# thrust and torque cause 1.4 and 0.5.
FORCE_JUMP, RATE_JUMP = 30.0, 3.0
AGREE = 0.5         # squared cosine: two independent errors agree with a probability of 5 %
LONGEST_HELD = 5    # readings


class SpikeFilter:
    """
    Rejects outliers of the IMU: a jump is used only if the next reading confirms it.

    An impact pushes again in about the same direction, and the rate that it causes remains. Two
    independent errors in a row rarely agree in all six axes.
    """

    def __init__(self):
        self._last: tuple[np.ndarray, np.ndarray] | None = None
        self._held, self._count = np.zeros(6), 0

    def passes(self, force: np.ndarray, rate: np.ndarray) -> bool:
        """Whether a reading (3,) [m/s^2], (3,) [rad/s] is used; False holds it back."""
        if self._last is not None:
            push, turn = force - self._last[0], rate - self._last[1]
            if push.dot(push) > FORCE_JUMP**2 or turn.dot(turn) > RATE_JUMP**2:
                held, self._count = self._held, self._count + 1
                self._held = jump = np.concatenate([push / FORCE_JUMP, turn / RATE_JUMP])
                dot = held.dot(jump)
                agree = dot > 0 and dot**2 >= AGREE * held.dot(held) * jump.dot(jump)
                if not agree and self._count <= LONGEST_HELD:
                    return False
        self._held, self._count, self._last = np.zeros(6), 0, (force, rate)
        return True
