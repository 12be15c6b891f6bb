"""Which actuators work."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class ActuatorHealth:
    """
    What is left of rotors and joints.

    Attributes:
        rotors: four, False: the rotor gives no thrust.
        stuck: four, the angle [rad] at which a joint is stuck; None: it moves.

    """

    rotors: tuple[bool, bool, bool, bool] = (True,) * 4
    stuck: tuple[float | None, float | None, float | None, float | None] = (None,) * 4

    @property
    def healthy(self) -> bool:
        """Whether all of them work."""
        return all(self.rotors) and all(angle is None for angle in self.stuck)


ALL_WELL = ActuatorHealth()
