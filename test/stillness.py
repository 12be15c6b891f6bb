"""Detection of stalls of the computer, by processes that record late wake-ups."""

from __future__ import annotations

import os
from pathlib import Path
import subprocess
import sys
import tempfile
import time

PERIOD = 0.005      # s of each sleep
NOTED = 0.02        # s; later wake-ups are recorded
MOST = 16           # watched cores

# Needs Python only, and ends with its parent process.
BEAT = f"""
import os, sys, time
os.sched_setaffinity(0, [int(sys.argv[2])])
parent = os.getppid()
with open(sys.argv[1], 'a', buffering=1) as file:
    while os.getppid() == parent:
        begin = time.monotonic()
        time.sleep({PERIOD})
        end = time.monotonic()
        if end - begin > {PERIOD + NOTED}:
            file.write(f'{{begin!r}} {{end!r}}\\n')
"""


class Heartbeat:
    """
    Records times at which a core did not run a process that only sleeps.

    A shared computer may stall for tenths of a second. Tests with limits of milliseconds are not
    valid then.
    """

    def __init__(self):
        """Start one process on each core."""
        handle, name = tempfile.mkstemp(prefix='heartbeat_')
        os.close(handle)
        self._file = Path(name)
        self._processes = [
            subprocess.Popen([sys.executable, '-S', '-c', BEAT, name, str(core)])
            for core in sorted(os.sched_getaffinity(0))[:MOST]]

    def stalls(self, start: float, end: float) -> list[float]:
        """Durations [s] of the stalls between two times of the monotonic clock."""
        time.sleep(2 * PERIOD)      # a stall that ends now is recorded soon
        found = []
        for line in self._file.read_text().splitlines():
            began, ended = map(float, line.split())
            if began < end and ended > start:
                found.append(ended - began - PERIOD)
        return found

    def close(self) -> None:
        """End the processes."""
        for process in self._processes:
            process.kill()
            process.wait()
        self._file.unlink()
