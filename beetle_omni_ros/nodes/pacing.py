"""When the simulator's ticks are due, and which stamps they get; plain arithmetic on clocks."""

from __future__ import annotations

# After a stall of the computer the plant catches up by so much and forgets the rest:
# a node that tried to make good every lost tick would never be on time again.
CATCH_UP_TICKS = 8
EARLY = 0.3             # part of a tick that the timer may come before the tick
PHASE_WINDOW = 50       # calls of the timer that tell its phase
SLEW = 0.01             # most that a tick's stamp may be stretched for it
CLOCK_STEP = 0.005      # s of change between ROS and steady time: the clock was set
CLOCK_READING = 0.001   # s in which both clocks must have been read to be compared
# Simulated time waits for who is farther behind than in any flight in real time, where the newest
# sample is one period old, but not for the dead.
LAG = 0.02              # s between the newest sample sent and the one that was answered last
PATIENCE = 0.3          # s of steady time


class Pacing:
    """
    Ticks on the steady clock, stamps in ROS time.

    Args:
        tick: length of one [s].
        steady: clock that nobody sets; returns seconds.
        ros: the clock of the stamps; returns seconds.

    Attributes:
        ticks: counted so far.
        lost_ticks: left out after stalls; the world stood still meanwhile.
        clock_steps: how often the ROS clock was set.

    """

    def __init__(self, tick: float, steady, ros):
        """Start with the first call of :meth:`due`."""
        self._tick, self._steady, self._ros = tick, steady, ros
        self._started: float | None = None
        self._offset = ros() - steady()     # ROS time minus steady time
        self._lateness: list[float] = []
        self._slew = 0.0
        self.ticks = self.lost_ticks = self.clock_steps = 0

    @property
    def started(self) -> bool:
        """Whether the first tick was due."""
        return self._started is not None

    @property
    def epoch(self) -> float:
        """ROS time at which simulated time is zero [s]."""
        return self._offset + self._started

    def due(self) -> int:
        """Count and return the ticks that are due now; called by the timer, once a tick."""
        now, tick = self._steady(), self._tick
        if self._started is None:
            self._started = now - tick
        self._follow_clock()
        due = int((now - self._started) / tick + EARLY) - self.ticks
        lost = max(0, due - CATCH_UP_TICKS)
        self.lost_ticks += lost
        self._started += lost * tick
        due -= lost
        self._follow_timer(now, due)
        self.ticks += due
        return due

    def _follow_timer(self, now, due):
        """
        Let the times of the ticks glide to those at which the timer fires.

        Its phase is unknown at first; a tick that is always due some milliseconds before
        the timer would make every stamp that much too old.
        """
        if due > 0:
            self._lateness.append(now - self._started - (self.ticks + due) * self._tick)
        if len(self._lateness) == PHASE_WINDOW:
            self._slew = min(self._lateness)
            self._lateness.clear()
        limit = SLEW * self._tick
        step = min(max(self._slew, -limit), limit)
        self._slew -= step
        self._started += step

    def _follow_clock(self):
        """Keep ROS time minus steady time, unless the clock was set."""
        before = self._steady()
        ros = self._ros()
        after = self._steady()
        if after - before > CLOCK_READING:
            return      # held up between the readings, they do not belong together
        offset = ros - 0.5 * (before + after)
        if abs(offset - self._offset) > CLOCK_STEP:
            self.clock_steps += 1
            self._offset = offset


class Waiting:
    """
    Ticks of simulated time: one each time the timer fires, none while somebody is late.

    What takes too long on a slow computer then takes longer, and is not missed. Who falls silent
    is waited for once, and again when it has come back.

    Args:
        tick: length of one [s].
        steady: clock that nobody sets; returns seconds.
        epoch: time of the stamps at which simulated time is zero [s].

    Attributes:
        ticks: counted so far.
        waits: calls of :meth:`due` that had to wait.
        started, lost_ticks, clock_steps: as in :class:`Pacing`; nothing is lost here.

    """

    started, lost_ticks, clock_steps = True, 0, 0

    def __init__(self, tick: float, steady, epoch: float):
        """Start with the first call of :meth:`due`."""
        self._tick, self._steady, self.epoch = tick, steady, epoch
        self._sent = float('-inf')
        self._heard: dict[str, tuple[float, float]] = {}
        self._last = steady()
        self.ticks = self.waits = 0

    @property
    def now(self) -> float:
        """Simulated time, as in the stamps [s]."""
        return self.epoch + self.ticks * self._tick

    def sent(self, stamp: float) -> None:
        """Note the stamp of a sample that others answer."""
        self._sent = stamp

    def heard(self, name: str, stamp: float) -> None:
        """Note an answer of ``name`` to the sample with this stamp."""
        self._heard[name] = (stamp, self._steady())

    def due(self) -> int:
        """Count and return the ticks that are due now: one, or none."""
        now = self._steady()
        late = any(self._sent - stamp > LAG and now - arrived < PATIENCE
                   for stamp, arrived in self._heard.values())
        if late and now - self._last < PATIENCE:
            self.waits += 1
            return 0
        self._last = now
        self.ticks += 1
        return 1
