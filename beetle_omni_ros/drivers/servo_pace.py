"""When the cycles of the servo bus are due: evenly, and when the goals have just come."""

from __future__ import annotations

READ_AFTER = 0.001  # [s] cycles begin so long after goals came: these find the bus free
SLEW = 0.01         # most that a period is stretched for that
GAIN = 0.1          # of the phase error in each cycle: single late goals hardly count
CAME = 0.1          # [s] goals older than this tell no phase


class ServoPace:
    """
    Times of the cycles on a steady clock.

    A cycle that starts late is made up for by the next; a period that passes without any is
    missed. Goals come at a multiple of the period or of two; the phase glides to where they do
    not meet a transaction.

    Args:
        period: of the cycles [s].

    Attributes:
        missed: periods that passed without a cycle.

    """

    def __init__(self, period: float):
        self.missed = 0
        self._period = period
        self._due = 0.0
        self._goals = float('-inf')

    def start(self, now: float):
        """Let the next cycle be due at ``now`` [s]."""
        self._due = now

    def wait(self, now: float) -> float:
        """Time left until the next cycle is due [s]."""
        return max(0.0, self._due - now)

    def goals_came(self, now: float):
        """Note goals that came at ``now`` [s]."""
        self._goals = now

    def begin(self, now: float):
        """Begin a cycle at ``now`` [s]; the next one becomes due."""
        passed = int(max(0.0, now - self._due) / self._period)
        self.missed += passed
        self._due += (passed + 1) * self._period
        if now - self._goals < CAME:
            period = self._period
            late = (self._due - self._goals - READ_AFTER + period / 2) % period - period / 2
            limit = SLEW * period
            self._due -= min(max(GAIN * late, -limit), limit)
