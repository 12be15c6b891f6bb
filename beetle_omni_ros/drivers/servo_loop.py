"""The servo bus at 200 Hz in a thread of its own; goals go out as soon as they come."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from contextlib import contextmanager
from dataclasses import dataclass
from threading import Lock, Thread
import time

import numpy as np

from beetle_omni_ros.drivers.servo_bus import ServoBus
from beetle_omni_ros.drivers.servo_state import ServoHealth, ServoReadings

READ_AFTER = 0.001  # [s] cycles begin so long after goals came: these find the bus free
SLEW = 0.01         # most that a period is stretched for that
GAIN = 0.1          # of the phase error in each cycle: single late goals hardly count
CAME = 0.1          # [s] goals older than this tell no phase
PERIOD = 0.005      # [s]
STOP_TIMEOUT = 5.0  # [s] for the thread to end; a cycle takes at most 0.02 s
EVENTS_KEPT = 200   # lines for the log that wait to be taken


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


@dataclass(frozen=True, slots=True)
class Goal:
    """Tilt targets (4,) [rad], when they were published [s], until when they count [steady s]."""

    tilt: np.ndarray
    published: float
    expires: float


class ServoLoop:
    """
    Runs a bus: goals, feedback and upkeep in each cycle.

    Never two transactions at a time: whoever has goals writes them where the bus is free, and
    leaves them to the one who uses it otherwise, who writes them after its present transaction.

    Args:
        bus: configured; nobody else calls it while the loop runs, save in :meth:`exclusive`.
        on_readings: called in the thread with the readings and (4,) bool: valid, and obeying
            where torque is on.
        on_written: called with ``Goal.published`` as soon as its last byte was written.
        clock: steady time [s].

    Attributes:
        cycles: run so far.
        written: packets of goals sent, repetitions included.
        stale: goals that were too old when the bus was free.
        incomplete: cycles in which a servo gave no valid reading.
        failure: what ended the thread, '' while all is well; torque is off then.

    """

    def __init__(self, bus: ServoBus, on_readings: Callable[[ServoReadings, np.ndarray], None],
                 on_written: Callable[[float], None] = lambda published: None,
                 clock: Callable[[], float] = time.monotonic):
        self.cycles = self.written = self.stale = self.incomplete = 0
        self.failure = ''
        self._bus, self._on_readings, self._on_written = bus, on_readings, on_written
        self._clock = clock
        self._pace = ServoPace(PERIOD)
        self._lock = Lock()
        self._goal: Goal | None = None
        self._fresh = self._wrote = self._stopping = False
        self._obeyed = [clock()] * 4
        self._events: deque[str] = deque(maxlen=EVENTS_KEPT)
        self._thread = Thread(target=self._run, name='servo bus', daemon=True)

    # --- from other threads -------------------------------------------------------------------

    def start(self):
        """Begin."""
        self._pace.start(self._clock())
        self._thread.start()

    def stop(self):
        """End after the present cycle; the bus is the caller's then."""
        self._stopping = True
        if self._thread.is_alive():
            self._thread.join(STOP_TIMEOUT)

    def offer(self, goal: Goal):
        """Write goals now, or as soon as the present transaction is over; the newest count."""
        self._pace.goals_came(self._clock())
        self._goal = goal
        self._fresh = True
        self._hand_over()

    @contextmanager
    def exclusive(self):
        """Keep the bus to oneself for longer; the time does not count as missed cycles."""
        with self._lock:
            try:
                yield self._bus
            finally:
                now = self._clock()
                self._obeyed = [now] * len(self._obeyed)
                self._pace.start(now)
        self._hand_over()

    @property
    def missed(self) -> int:
        """Periods that passed without a cycle."""
        return self._pace.missed

    def health(self) -> list[ServoHealth]:
        """What is known about each servo."""
        with self._lock:
            return self._bus.health()

    def lost(self, patience: float) -> str:
        """Say which servos have not obeyed for so long [s], and why; '' when all do."""
        if self.failure:
            return self.failure
        limit = self._clock() - patience
        gone = [k for k, seen in enumerate(self._obeyed) if seen < limit]
        if not gone:
            return ''
        if not self._bus.connected:
            return f'{self._bus.parameters.port}: no connection'
        health = self.health()
        return '; '.join(health[k].message or f'{health[k].name}: being brought back'
                         for k in gone)

    def take_events(self) -> list[str]:
        """Lines for the log since the last call."""
        events = []
        while self._events:
            events.append(self._events.popleft())
        return events

    # --- the thread ---------------------------------------------------------------------------

    def _run(self):
        try:
            while not self._stopping:
                time.sleep(self._pace.wait(self._clock()))
                with self._lock:
                    if not self._stopping:
                        self._cycle()
                self._hand_over()
        except Exception as error:  # a mistake in the code must not leave torque on
            self.failure = f'the bus thread ended: {type(error).__name__}: {error}'
            self._events.append(self.failure)
            with self._lock:
                self._bus.close()

    def _cycle(self):
        """Goals, feedback, upkeep; the bus is ours."""
        self._pace.begin(self._clock())
        self.cycles += 1
        self._write()
        readings = self._bus.read()
        good = readings.valid
        self.incomplete += not good.all()
        obeying = self._bus.obeying
        if self._bus.enabled:
            good = good & obeying
        self._on_readings(readings, good)
        self._write_fresh()
        self._bus.upkeep()
        self._events.extend(self._bus.take_events())
        now = self._clock()
        if obeying.all():
            self._obeyed = [now] * len(self._obeyed)
        else:
            self._obeyed = [now if obeys else seen
                            for obeys, seen in zip(obeying, self._obeyed, strict=True)]

    def _hand_over(self):
        """Write what came while the bus was busy; whoever has the bus now does it otherwise."""
        while self._fresh and self._lock.acquire(blocking=False):
            try:
                self._write_fresh()
            finally:
                self._lock.release()

    def _write(self):
        """Write new goals, or the last ones again where a whole period brought none."""
        if self._fresh:
            self._write_fresh()
        elif self._goal is not None and not self._wrote and self._clock() <= self._goal.expires:
            self.written += self._bus.write_goals(self._goal.tilt)
        self._wrote = False

    def _write_fresh(self):
        if not self._fresh:
            return
        self._fresh = False
        goal = self._goal
        if self._clock() > goal.expires:
            self.stale += 1
        elif self._bus.write_goals(goal.tilt):
            self._on_written(goal.published)
            self.written += 1
            self._wrote = True
