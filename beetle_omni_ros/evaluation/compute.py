"""CPU time of controller steps."""

from contextlib import contextmanager
import gc
import time

import numpy as np


@contextmanager
def collector_off():
    """
    Disable Python's cycle collector during a flight, as the nodes do.

    Its passes become longer with the log. A controller step that it interrupts would appear to
    take tens of milliseconds.
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
    CPU times of all steps of one controller.

    The CPU time of the calling thread is measured, because wall time on a shared computer includes
    other programs. A deadline miss is a step that takes longer than the period.
    """

    def __init__(self, period: float):
        """``period``: period of the controller [s]."""
        self._period, self._times = period, []

    def call(self, function, *arguments):
        """Run ``function(*arguments)`` and store its CPU time."""
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
