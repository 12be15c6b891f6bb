"""
Offset between two clocks from requests and answers, with an error bound.

The remote clock is read between the request and the answer, so each exchange gives a lower and an
upper bound of the offset. Bounds of earlier exchanges are widened by the largest possible drift,
and all bounds are intersected. The estimate is the centre of this interval, and its error is at
most half the width, for any delays.
"""

import math


class ClockOffset:
    """
    Offset of a remote clock, remote minus local [s].

    Attributes:
        jumps: number of answers outside the interval, because the remote clock was set.

    """

    def __init__(self, drift: float):
        """``drift``: bound of the relative drift of the clocks [s/s]."""
        self._drift = drift
        self.jumps = 0
        self.restart()

    def restart(self) -> None:
        """Forget all exchanges."""
        # Other threads read this tuple, so it is only replaced as a whole.
        self._bounds = -math.inf, math.inf, 0.0

    @property
    def known(self) -> bool:
        """Whether an answer arrived since the restart."""
        return math.isfinite(self._bounds[0])

    def add(self, sent: float, remote: float, received: float) -> bool:
        """
        Use one exchange.

        Args:
            sent: local time of the request [s].
            remote: remote time in the answer [s].
            received: local time of the answer [s].

        Returns:
            whether it contradicts the earlier exchanges, which are then forgotten.

        """
        if received < sent:
            return False
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
        """Remote minus local clock [s]; NaN while unknown."""
        low, high, _ = self._bounds
        return 0.5 * (low + high) if math.isfinite(low) else math.nan

    def uncertainty(self, now: float) -> float:
        """Bound of the offset's error [s] at local time ``now``; inf while unknown."""
        low, high, at = self._bounds
        return 0.5 * (high - low) + self._drift * max(0.0, now - at)
