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
