"""Lone readings of the IMU that no body makes."""

from __future__ import annotations

import numpy as np


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
        """See the class."""
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
