"""Which of the eight actuators still do what they are told."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class ActuatorHealth:
    """
    What is left of rotors and tilt servos.

    Attributes:
        rotors: four bools, False for a rotor that gives no thrust.
        stuck: for each joint the angle at which it is stuck [rad], or None where it moves.

    Raises:
        ValueError: not four of each.

    """

    rotors: tuple[bool, ...] = (True,) * 4
    stuck: tuple[float | None, ...] = (None,) * 4

    def __post_init__(self):
        """Refuse anything but one entry for each rotor and each joint."""
        if len(self.rotors) != 4 or len(self.stuck) != 4:
            raise ValueError(f'expected four rotors and four joints, found {len(self.rotors)} '
                             f'and {len(self.stuck)}')

    @property
    def healthy(self) -> bool:
        """Whether everything works."""
        return all(self.rotors) and all(angle is None for angle in self.stuck)

    def possible(self, tilt: np.ndarray, thrust: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Tilts (4,) [rad] and thrusts (4,) [N] with stuck joints and lost rotors as they are."""
        angles = [own if angle is None else angle for own, angle in zip(tilt, self.stuck)]
        return np.array(angles, dtype=float), np.where(self.rotors, thrust, 0.0)


ALL_WELL = ActuatorHealth()
