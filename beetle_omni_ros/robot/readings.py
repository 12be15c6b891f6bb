"""Readings of sensors and devices, simulated or real: stamps of capture [s], SI units."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from beetle_omni_ros.robot.parameters import JOINT_NAMES


@dataclass(frozen=True, slots=True)
class ImuReading:
    """
    One IMU reading (REP-145), in the IMU's own axes.

    Attributes:
        stamp: time of measurement [s].
        specific_force: (3,) acceleration minus gravity [m/s^2]; +g upward at rest.
        angular_velocity: (3,) [rad/s].

    """

    stamp: float
    specific_force: np.ndarray
    angular_velocity: np.ndarray


@dataclass(frozen=True, slots=True)
class PoseReading:
    """
    One MoCap pose of the tracked body in world.

    Attributes:
        stamp: time of capture [s], not of arrival.
        position: (3,) [m].
        quaternion: (4,) body to world (x, y, z, w), of either sign.

    """

    stamp: float
    position: np.ndarray
    quaternion: np.ndarray


@dataclass(frozen=True, slots=True)
class JointReading:
    """
    One reading of the tilt joints.

    Attributes:
        stamp: time of capture [s].
        position: (4,) [rad].
        velocity: (4,) [rad/s], or None if not measured.
        effort: (4,) [N m], or None if not measured.
        names: joint names; fewer than four are legal in a written message.

    """

    stamp: float
    position: np.ndarray
    velocity: np.ndarray | None
    effort: np.ndarray | None = None
    names: Sequence[str] = JOINT_NAMES


@dataclass(frozen=True, slots=True)
class BatteryReading:
    """Pack voltage under load [V], current [A], negative in discharge, and cells (0: unknown)."""

    stamp: float
    voltage: float
    current: float
    cells: int = 0


@dataclass(frozen=True, slots=True)
class RotorReading:
    """Rotor speeds from the ESCs (4,) [rad/s], positive for both spins; NaN: unknown."""

    stamp: float
    speed: np.ndarray


class SpikeFilter:
    """
    Rejects single outliers of the IMU: a jump is used only if the next reading confirms it.

    Args:
        force_change: largest change of the specific force between two readings [m/s^2].
        rate_change: largest change of the angular rate between two readings [rad/s].

    Attributes:
        lasted: whether the latest reading confirmed a held one. That is an impact, of which one
            reading is missing.

    """

    def __init__(self, force_change: float, rate_change: float):
        self._limits = force_change**2, rate_change**2
        self.reset()

    def reset(self) -> None:
        """Forget the readings so far."""
        self._last: tuple[np.ndarray, np.ndarray] | None = None
        self._held = self.lasted = False

    def passes(self, force: np.ndarray, rate: np.ndarray) -> bool:
        """Whether a reading (3,) [m/s^2], (3,) [rad/s] is used; False holds it back."""
        far = False
        if self._last is not None:
            push, turn = force - self._last[0], rate - self._last[1]
            far = bool(push.dot(push) > self._limits[0] or turn.dot(turn) > self._limits[1])
        self.lasted = far and self._held
        self._held = far and not self._held
        if not self._held:
            self._last = force, rate
        return not self._held
