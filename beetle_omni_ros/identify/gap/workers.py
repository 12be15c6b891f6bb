"""
Worker processes that share the calls on one object.

They are forked, so a worker has flights, splines and compiled equations without reading or
sending them, and keeps its own caches. With one core, one call, no fork or a crashed worker, the
calls run in this process; the results are the same.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack, suppress
import multiprocessing
import os
import signal
import sys
from threading import Thread
from typing import Any
import warnings

import joblib
from threadpoolctl import threadpool_limits

WIDTH_KEY = 'OMP_NUM_THREADS'       # a limit of threads also limits the processes
_inside = False                     # whether this process is a worker
_subject: Any = None                # subject of a worker


def width() -> int:
    """Number of processes; one where processes are not forked."""
    if sys.platform != 'linux':
        return 1
    allowed = os.environ.get(WIDTH_KEY, '')
    cores = joblib.cpu_count()
    return max(1, min(cores, int(allowed))) if allowed.isdigit() else cores


class Workers:
    """
    A context with worker processes; they end with it and with this process.

    Args:
        subject: first argument of every call, in its state at the first shared call. Later changes
            by a call stay in the worker.

    """

    def __init__(self, subject: Any = None):
        self.subject, self.width = subject, width()
        self._pool: ProcessPoolExecutor | None = None
        self._stack = ExitStack()

    def __enter__(self) -> Workers:
        """Limit linear algebra to one thread for each process."""
        if self.width > 1:
            self._stack.enter_context(threadpool_limits(1))
        return self

    def __exit__(self, *_) -> None:
        """End the workers."""
        self._end()
        self.width = 1
        self._stack.close()

    def map(self, function: Callable, items: Iterable, *common: Any) -> list:
        """
        ``[function(subject, item, *common) for item in items]``.

        Args:
            function: module-level function; arguments and results are picklable.
            items: independent items, dealt out in turn; the longest calls first.
            common: further arguments, sent once to each worker.

        """
        items = list(items)
        shares = [items[k::self.width] for k in range(min(self.width, len(items)))]
        if len(shares) < 2 or _inside:
            return _made(self.subject, function, items, common)
        results: list = [None] * len(items)
        try:
            pool = self._pool or self._forked()
            futures = [pool.submit(_do, function, share, common) for share in shares]
            for first, future in enumerate(futures):
                results[first::len(shares)] = future.result()
        except BrokenProcessPool:
            self._end()
            self.width = 1
            return _made(self.subject, function, items, common)
        return results

    def _forked(self):
        held, self._line = multiprocessing.Pipe(duplex=False)
        self._pool = ProcessPoolExecutor(
            self.width, multiprocessing.get_context('fork'), _begin,
            (self.subject, held, self._line))
        with warnings.catch_warnings():
            # Threads of this process, such as the progress bar, hold no lock of a worker.
            warnings.simplefilter('ignore', DeprecationWarning)
            self._pool.submit(os.getpid)
        held.close()
        return self._pool

    def _end(self):
        if self._pool:
            self._line.close()
            self._pool.shutdown(cancel_futures=True)
            self._pool = None


def _made(subject, function, items, common):
    return [function(subject, item, *common) for item in items]


def _do(function, items, common):
    return _made(_subject, function, items, common)


def _begin(subject, held, line):
    """Initialise a worker, which ends when the parent's end of ``held`` closes."""
    global _inside, _subject
    _inside, _subject = True, subject
    line.close()
    signal.signal(signal.SIGINT, signal.SIG_IGN)    # the parent handles it
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    Thread(target=_wait, args=(held,), daemon=True).start()


def _wait(held):
    with suppress(EOFError, OSError):
        held.recv()
    os._exit(0)
