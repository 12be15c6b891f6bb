"""CPU time of controller steps."""

from __future__ import annotations

from contextlib import contextmanager
import gc
import time

import numpy as np


@contextmanager
def collector_off():
    """
    Keep Python's cycle collector out of the flight, as the nodes do.

    A growing log makes each of its passes longer, and whichever step it interrupts
    would seem to have taken tens of milliseconds.
    """
    was_on = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_on:
            gc.enable()


class ComputeTimer:
    """
    Collects the CPU time of every step of one controller.

    CPU time of the calling thread, because on a shared computer wall time holds other
    programs' slices; a deadline miss is a step that took longer than the period.
    """

    def __init__(self, period: float):
        """``period`` is the controller's [s]."""
        self._period, self._times = period, []

    def call(self, function, *arguments):
        """Run ``function(*arguments)`` and keep how long it took."""
        start = time.thread_time()
        result = function(*arguments)
        self._times.append(time.thread_time() - start)
        return result

    def summary(self) -> dict[str, float | int]:
        """Median, 99th percentile and maximum [ms], deadline misses, number of steps."""
        if not self._times:
            return {'median': 0.0, 'p99': 0.0, 'max': 0.0, 'deadline_misses': 0, 'count': 0}
        times = 1e3 * np.array(self._times)
        return {'median': float(np.median(times)), 'p99': float(np.percentile(times, 99)),
                'max': float(times.max()),
                'deadline_misses': int(np.sum(times > 1e3 * self._period)), 'count': len(times)}
