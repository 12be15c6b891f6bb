"""Due times and stamps of the simulator's ticks, in real and in simulated time."""

# Ticks that are caught up after a stall of the computer; more would delay the next ones.
CATCH_UP_TICKS = 8
EARLY = 0.3             # part of a tick that the timer may come before the tick
PHASE_WINDOW = 50       # calls of the timer from which its phase is estimated
SLEW = 0.01             # largest shift of a tick towards the timer's phase, in ticks
CLOCK_STEP = 0.005      # s of change between ROS and steady time above which the clock was set
CLOCK_READING = 0.001   # s within which both clocks must have been read to be compared
# Simulated time waits for a node that is farther behind than in real time, where the newest sample
# is one period old. It does not wait for a node that has stopped.
LAG = 0.02              # s between the newest sample and the newest answered one
PATIENCE = 0.3          # s of steady time without an answer after which a node has stopped


class RealTimePacing:
    """
    Ticks on the steady clock, stamps in ROS time; starts with the first call of :meth:`due`.

    Attributes:
        ticks: number of ticks so far.
        lost_ticks: ticks skipped after stalls; the simulation stopped meanwhile.
        clock_steps: how often the ROS clock was set.

    """

    def __init__(self, tick: float, steady, ros):
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
        """Return the number of ticks that are due now; called by the timer, once a tick."""
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
        Shift the ticks towards the times at which the timer fires.

        The phase of the timer is unknown at first. If ticks were always due some milliseconds
        before the timer, every stamp would be too old by this time.
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
        """Detect that the ROS clock was set, and update its offset from the steady clock."""
        before = self._steady()
        ros = self._ros()
        after = self._steady()
        if after - before > CLOCK_READING:
            return      # preempted between the readings
        offset = ros - 0.5 * (before + after)
        if abs(offset - self._offset) > CLOCK_STEP:
            self.clock_steps += 1
            self._offset = offset


class SimulatedTimePacing:
    """
    Ticks of simulated time: one each time the timer fires, none while a node is late.

    On a slow computer, time passes more slowly and no deadline is missed. For a node that has
    stopped, simulated time waits once.

    Args:
        tick: period [s].
        steady: steady clock [s].
        epoch: time of the stamps at which simulated time is zero [s].

    Attributes:
        ticks: number of ticks so far.
        waits: calls of :meth:`due` that returned no tick.
        started, lost_ticks, clock_steps: as in :class:`RealTimePacing`; no tick is lost.

    """

    started, lost_ticks, clock_steps = True, 0, 0

    def __init__(self, tick: float, steady, epoch: float):
        self._tick, self._steady, self.epoch = tick, steady, epoch
        self._sent = float('-inf')
        self._answers: dict[str, tuple[float, float]] = {}
        self._last = steady()
        self.ticks = self.waits = 0

    @property
    def now(self) -> float:
        """Simulated time [s]."""
        return self.epoch + self.ticks * self._tick

    def sample_sent(self, stamp: float) -> None:
        """Record the stamp of a published sample."""
        self._sent = stamp

    def answered(self, name: str, stamp: float) -> None:
        """Record that ``name`` has answered the sample with this stamp."""
        self._answers[name] = (stamp, self._steady())

    def due(self) -> int:
        """Return the number of ticks that are due now: 1 or 0."""
        now = self._steady()
        late = any(self._sent - stamp > LAG and now - arrived < PATIENCE
                   for stamp, arrived in self._answers.values())
        if late and now - self._last < PATIENCE:
            self.waits += 1
            return 0
        self._last = now
        self.ticks += 1
        return 1
