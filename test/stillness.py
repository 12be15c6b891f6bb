"""Whether the computer stood still: processes that note when they were woken too late."""

from __future__ import annotations

import os
from pathlib import Path
import subprocess
import sys
import tempfile
import time

PERIOD = 0.005      # s that each sleeps at a time
NOTED = 0.02        # s, later than this is written down
MOST = 16           # cores that are watched

# Needs nothing but Python, and ends with the process that started it.
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
    Notes while it runs when a core did not let a process run that only sleeps.

    A computer shared with others stops for tenths of a second; what must answer within
    milliseconds cannot be judged on it then.
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
        """Lengths [s] of the stalls between two times of the monotonic clock."""
        time.sleep(2 * PERIOD)      # one that ends now is written down yet
        found = []
        for line in self._file.read_text().splitlines():
            begun, ended = map(float, line.split())
            if begun < end and ended > start:
                found.append(ended - begun - PERIOD)
        return found

    def close(self) -> None:
        """End them."""
        for process in self._processes:
            process.kill()
            process.wait()
        self._file.unlink()
