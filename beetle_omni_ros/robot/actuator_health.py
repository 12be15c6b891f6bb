"""Which of the eight actuators still do what they are told."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

NO_ZEROS = (0.0,) * 4


@dataclass(frozen=True)
class ActuatorHealth:
    """
    What is left of rotors and tilt servos.

    Attributes:
        rotors: four bools, False for a rotor that gives no thrust.
        stuck: for each joint the true angle at which it is stuck [rad], or None where it moves.
        held: for each rotor the thrust that it gives whatever it is asked [N], or None.
        zeros: reading minus true tilt of each joint that was found in flight [rad].
        thrust_limit: largest thrust that the pack still allows every rotor [N], or None where
            that is no less than the robot's own limit.

    Raises:
        ValueError: not four of each.

    """

    rotors: tuple[bool, ...] = (True,) * 4
    stuck: tuple[float | None, ...] = (None,) * 4
    held: tuple[float | None, ...] = (None,) * 4
    zeros: tuple[float, ...] = NO_ZEROS
    thrust_limit: float | None = None

    def __post_init__(self):
        """Refuse anything but one entry for each rotor and each joint."""
        for name in ('rotors', 'stuck', 'held', 'zeros'):
            if len(getattr(self, name)) != 4:
                raise ValueError(f'{name}: expected four, found {len(getattr(self, name))}')

    @property
    def healthy(self) -> bool:
        """Whether every actuator obeys; a joint whose zero moved does."""
        return all(self.rotors) and self.stuck == self.held == (None,) * 4 \
            and self.thrust_limit is None

    def same_actuators(self, other: ActuatorHealth) -> bool:
        """Whether the same ones obey; angles, thrusts, limit and zeros may differ."""
        return self.rotors == other.rotors and all(
            (a is None) == (b is None) for a, b in zip(
                (*self.stuck, *self.held, self.thrust_limit),
                (*other.stuck, *other.held, other.thrust_limit)))

    def limited(self, thrust: float) -> float:
        """The robot's largest thrust [N], or less where the pack allows less."""
        return thrust if self.thrust_limit is None else min(thrust, self.thrust_limit)

    def possible(self, tilt: np.ndarray, thrust: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """
        Tilts (4,) [rad] and thrusts (4,) [N] with stuck joints and lost rotors as they are.

        No thrust exceeds what the pack allows.
        """
        angles = [own if angle is None else angle for own, angle in zip(tilt, self.stuck)]
        thrusts = [self.limited(own) if held is None else held
                   for own, held in zip(thrust, self.held)]
        return np.array(angles, dtype=float), np.where(self.rotors, thrusts, 0.0)

    def true(self, tilt: np.ndarray) -> np.ndarray:
        """True tilts (4,) of readings or of joint targets [rad]."""
        return tilt if self.zeros == NO_ZEROS else tilt - np.array(self.zeros)

    def read(self, tilt: np.ndarray) -> np.ndarray:
        """Readings (4,) of true tilts [rad], which are also the targets that reach them."""
        return tilt if self.zeros == NO_ZEROS else tilt + np.array(self.zeros)


ALL_WELL = ActuatorHealth()
