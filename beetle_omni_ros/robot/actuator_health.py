"""Failures of rotors and tilt servos, as known to allocation and controllers."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

NO_ZEROS = (0.0,) * 4


@dataclass(frozen=True)
class ActuatorHealth:
    """
    State of the four rotors and four tilt servos.

    Attributes:
        rotors: four bools, False for a rotor without thrust.
        stuck: true angle of each stuck joint [rad], None for a joint that moves.
        held: thrust of each rotor that ignores its command [N], else None.
        zeros: reading minus true tilt of each joint, estimated in flight [rad].
        thrust_limit: largest thrust of every rotor that the pack allows [N], None if it is not
            below the robot's own limit.

    Raises:
        ValueError: a field does not have four entries.

    """

    rotors: tuple[bool, ...] = (True,) * 4
    stuck: tuple[float | None, ...] = (None,) * 4
    held: tuple[float | None, ...] = (None,) * 4
    zeros: tuple[float, ...] = NO_ZEROS
    thrust_limit: float | None = None

    def __post_init__(self):
        """Check that each field has four entries."""
        for name in ('rotors', 'stuck', 'held', 'zeros'):
            if len(getattr(self, name)) != 4:
                raise ValueError(f'{name}: expected four, found {len(getattr(self, name))}')

    @cached_property
    def healthy(self) -> bool:
        """Whether every actuator follows commands; a wrong joint zero counts as healthy."""
        return all(self.rotors) and self.stuck == self.held == (None,) * 4 \
            and self.thrust_limit is None

    def same_actuators(self, other: ActuatorHealth) -> bool:
        """Whether the same actuators have failed; angles, thrusts, limit and zeros may differ."""
        return self.rotors == other.rotors and all(
            (a is None) == (b is None) for a, b in zip(
                (*self.stuck, *self.held, self.thrust_limit),
                (*other.stuck, *other.held, other.thrust_limit)))

    def limited(self, thrust: float) -> float:
        """Limit ``thrust`` [N] to what the pack allows."""
        return thrust if self.thrust_limit is None else min(thrust, self.thrust_limit)

    def possible(self, tilt: np.ndarray, thrust: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """
        Tilts (4,) [rad] and thrusts (4,) [N] that the failed actuators and the pack allow.

        Stuck joints keep their angle, and lost rotors have no thrust.
        """
        angles = [own if angle is None else angle for own, angle in zip(tilt, self.stuck)]
        thrusts = [self.limited(own) if held is None else held
                   for own, held in zip(thrust, self.held)]
        return np.array(angles, dtype=float), np.where(self.rotors, thrusts, 0.0)

    def true(self, tilt: np.ndarray) -> np.ndarray:
        """True tilts (4,) for readings or joint targets [rad]."""
        return tilt if self.zeros == NO_ZEROS else tilt - np.array(self.zeros)

    def read(self, tilt: np.ndarray) -> np.ndarray:
        """Readings (4,) for true tilts [rad]; these are also the joint targets for them."""
        return tilt if self.zeros == NO_ZEROS else tilt + np.array(self.zeros)


ALL_HEALTHY = ActuatorHealth()
