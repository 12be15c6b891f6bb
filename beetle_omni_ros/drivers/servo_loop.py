"""The 200 Hz loop of the servo bus in a thread; new goals are written at once."""

from collections.abc import Callable
from contextlib import contextmanager
from threading import Lock, Thread
import time

import numpy as np

from beetle_omni_ros.drivers.servo_bus import ServoBus
from beetle_omni_ros.model.readings import JointReading

PERIOD = 0.005      # [s]
STOP_TIMEOUT = 5.0  # [s] until the thread has ended; a cycle takes at most 0.02 s


class ServoLoop:
    """
    Runs a bus: goals, feedback and upkeep in each cycle.

    A lock allows one transaction at a time. :meth:`offer` writes goals in the caller's thread if
    the bus is free. Otherwise the thread that holds the bus writes them after its transaction.

    Args:
        bus: configured bus; while the loop runs, other threads use it in :meth:`exclusive` only.
        on_reading: called in the thread with the reading of the servos that have answered and,
            with torque on, obey, unless there is none.
        on_written: called with their time of publication after the goals were written.
        clock: monotonic time [s].

    Attributes:
        cycles, incomplete: number of cycles, and of those without a valid reading of each servo.
        missed: number of periods without a cycle; a late cycle does not delay the next one.
        written, stale: number of packets with goals, and of goals that had expired before.
        failure: error that ended the thread, or ''; torque is off then.

    """

    def __init__(self, bus: ServoBus, on_reading: Callable[[JointReading], None],
                 on_written: Callable[[float], None] = lambda published: None,
                 clock: Callable[[], float] = time.monotonic):
        self.cycles = self.missed = self.written = self.stale = self.incomplete = 0
        self.failure = ''
        self._bus, self._on_reading, self._on_written = bus, on_reading, on_written
        self._clock, self._due = clock, clock()
        self._lock = Lock()
        self._goal: tuple[np.ndarray, float, float] | None = None
        self._fresh = self._wrote = self._stopping = False
        self._last_obeying = np.full(4, clock())
        self._thread = Thread(target=self._run, name='servo bus', daemon=True)

    def start(self):
        """Start the thread."""
        self._due = self._clock()
        self._thread.start()

    def stop(self):
        """End the thread after the present cycle; then the caller may use the bus."""
        self._stopping = True
        if self._thread.is_alive():
            self._thread.join(STOP_TIMEOUT)

    def offer(self, tilt: np.ndarray, published: float, expires: float):
        """
        Write tilt targets (4,) [rad] now, or after the present transaction instead of older ones.

        They were ``published`` [s] and are valid until ``expires`` on the monotonic clock [s].
        """
        self._goal = tilt, published, expires
        self._fresh = True
        self._write_pending()

    @contextmanager
    def exclusive(self):
        """Context with the bus for the caller alone; its time does not count as missed cycles."""
        with self._lock:
            try:
                yield self._bus
            finally:
                self._due = now = self._clock()
                self._last_obeying = np.full(4, now)
        self._write_pending()

    def lost(self, patience: float) -> str:
        """Servos that have not obeyed for ``patience`` [s], with reasons; '' if there is none."""
        gone = self._clock() - self._last_obeying > patience
        if self.failure or not gone.any():
            return self.failure
        if not self._bus.link.is_open:
            return f'{self._bus.link.path}: no connection'
        return '; '.join(servo.message or f'{servo.name}: being brought back'
                         for servo, is_gone in zip(self._bus.servos, gone) if is_gone)

    def _run(self):
        try:
            while not self._stopping:
                time.sleep(max(0.0, self._due - self._clock()))
                with self._lock:
                    if not self._stopping:
                        self._cycle()
                self._write_pending()
        except Exception as error:  # also after a programming error torque must go off
            self.failure = f'the bus thread ended: {type(error).__name__}: {error}'
            self._bus.log(self.failure)
            with self._lock:
                self._bus.close()

    def _cycle(self):
        """Goals, feedback and upkeep, with the lock held."""
        passed = int(max(0.0, self._clock() - self._due) / PERIOD)
        self.missed += passed
        self._due += (passed + 1) * PERIOD
        self.cycles += 1
        if self._fresh:
            self._write_fresh()
        elif self._goal is not None and not self._wrote and self._clock() <= self._goal[2]:
            self.written += self._bus.write_goals(self._goal[0])  # a whole period brought none
        self._wrote = False
        answered, obeying = self._bus.read(), self._bus.obeying
        self.incomplete += not answered.all()
        good = answered & obeying if self._bus.enabled else answered
        if good.any():
            self._on_reading(self._bus.reading(good))
        self._write_fresh()
        self._bus.upkeep()
        self._last_obeying = np.where(obeying, self._clock(), self._last_obeying)

    def _write_pending(self):
        """Write new goals if the bus is free; otherwise the holder of the lock does it later."""
        while self._fresh and self._lock.acquire(blocking=False):
            try:
                self._write_fresh()
            finally:
                self._lock.release()

    def _write_fresh(self):
        if not self._fresh:
            return
        self._fresh = False
        tilt, published, expires = self._goal
        if self._clock() > expires:
            self.stale += 1
        elif self._bus.write_goals(tilt):
            self._on_written(published)
            self.written += 1
            self._wrote = True
