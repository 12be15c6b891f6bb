"""What sensors and devices say, simulated or real: stamps of capture [s], SI units."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from beetle_omni_ros.robot.parameters import JOINT_NAMES


@dataclass(frozen=True, slots=True)
class ImuReading:
    """
    One IMU reading (REP-145), in the IMU's own axes.

    Attributes:
        stamp: when it was measured [s].
        specific_force: (3,) acceleration minus gravity [m/s^2]; +g along up at rest.
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
        stamp: when it was captured [s], not when it arrived.
        position: (3,) [m].
        quaternion: (4,) body to world (x, y, z, w); its sign is free.

    """

    stamp: float
    position: np.ndarray
    quaternion: np.ndarray


@dataclass(frozen=True, slots=True)
class JointReading:
    """
    Measured tilt joints.

    Attributes:
        stamp: of capture [s].
        position: (4,) [rad].
        velocity: (4,) [rad/s], or None where none were measured.
        effort: (4,) [N m], or None where none were measured.
        names: of the joints, where a message is written for fewer than four.

    """

    stamp: float
    position: np.ndarray
    velocity: np.ndarray | None
    effort: np.ndarray | None = None
    names: Sequence[str] = JOINT_NAMES


@dataclass(frozen=True, slots=True)
class BatteryReading:
    """Pack voltage under load [V] and current [A, negative while discharging]; cells, if known."""

    stamp: float
    voltage: float
    current: float
    cells: int = 0


@dataclass(frozen=True, slots=True)
class RotorReading:
    """Speeds of the rotors by their ESCs (4,) [rad/s], positive for both spins; NaN unknown."""

    stamp: float
    speed: np.ndarray


class SpikeFilter:
    """
    Holds a reading that is far from the one before; the next one tells whether it was real.

    Args:
        force_change: of the specific force between two readings that is far [m/s^2].
        rate_change: of the angular rate, likewise [rad/s].

    Attributes:
        lasted: whether the reading just passed follows one that was held and is far, too: an
            impact, of which one reading is missing.

    """

    def __init__(self, force_change: float, rate_change: float):
        self._limits = force_change**2, rate_change**2
        self.reset()

    def reset(self) -> None:
        """Begin anew at the next reading."""
        self._last: tuple[np.ndarray, np.ndarray] | None = None
        self._held = self.lasted = False

    def passes(self, force: np.ndarray, rate: np.ndarray) -> bool:
        """Whether a reading (3,) [m/s^2], (3,) [rad/s] may be used now."""
        far = self._last is not None and any(
            float(change @ change) > limit for change, limit in zip(
                (force - self._last[0], rate - self._last[1]), self._limits))
        self.lasted = far and self._held
        self._held = far and not self._held
        if not self._held:
            self._last = force, rate
        return not self._held
