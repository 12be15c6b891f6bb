"""
Offset between two clocks from request and answer, with a bound on its error.

The other clock was read between sending and receiving, so each exchange bounds the offset from
both sides. The bounds of all exchanges are intersected, each widened by what the clocks can have
drifted since; the middle is the estimate, half the width its largest error, whatever the delays.
"""

from __future__ import annotations

import math


class ClockOffset:
    """
    Offset of a remote clock, remote minus local [s].

    Attributes:
        exchanges: number of answers taken.
        jumps: how often an answer contradicted all before it: the remote clock was set anew.

    """

    def __init__(self, drift: float):
        """Take clocks to run apart by at most ``drift`` [s/s]."""
        self._drift = drift
        self.exchanges = self.jumps = 0
        self.restart()

    def restart(self) -> None:
        """Know nothing."""
        # One tuple, replaced as a whole: other threads read it.
        self._bounds = -math.inf, math.inf, 0.0

    @property
    def known(self) -> bool:
        """Whether there was an answer since the restart."""
        return math.isfinite(self._bounds[0])

    def add(self, sent: float, remote: float, received: float) -> bool:
        """
        Take one exchange.

        Args:
            sent: local time of the request [s].
            remote: the remote time that the answer tells [s].
            received: local time of the answer [s].

        Returns:
            whether it contradicted what was known; then it alone counts.

        """
        if received < sent:
            return False
        self.exchanges += 1
        within = self._drift * (received - sent)
        low, high = remote - received - within, remote - sent + within
        known_low, known_high, at = self._bounds
        widening = self._drift * max(0.0, received - at)
        new_low, new_high = max(low, known_low - widening), min(high, known_high + widening)
        jumped = new_low > new_high
        if jumped:
            self.jumps += 1
            new_low, new_high = low, high
        self._bounds = new_low, new_high, received
        return jumped

    def offset(self) -> float:
        """Remote minus local [s]; nan while unknown."""
        low, high, _ = self._bounds
        return 0.5 * (low + high) if math.isfinite(low) else math.nan

    def uncertainty(self, now: float) -> float:
        """Bound of the error [s] at local time ``now``; inf while unknown."""
        low, high, at = self._bounds
        return 0.5 * (high - low) + self._drift * max(0.0, now - at)
