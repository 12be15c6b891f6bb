"""
Processes that hold a copy of a problem each and share its work.

They are forked: a worker finds flights, splines and compiled equations as they stand, without
reading or sending them, and keeps what it computes later. A pool of concurrent.futures deals out
the calls. Where there is one core or one call, no fork, or where a worker died, the work is done
in this process; the results are the same.
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

try:
    from threadpoolctl import threadpool_limits
except ImportError:     # apt has it, but rosdep no key for it
    threadpool_limits = None

WIDTH_KEY = 'OMP_NUM_THREADS'       # who limits threads by it means processes, too
_inside = False                     # of a worker, which shares nothing
_subject: Any = None                # of a worker


def width() -> int:
    """How many processes work at a time; one where threads of linear algebra cannot be limited."""
    if sys.platform != 'linux' or threadpool_limits is None:
        return 1
    allowed = os.environ.get(WIDTH_KEY, '')
    cores = joblib.cpu_count()
    return max(1, min(cores, int(allowed))) if allowed.isdigit() else cores


class Workers:
    """
    A context in which calls are shared; its workers end with it, and with this process.

    Args:
        subject: first argument of every call, as it stands at the first shared one. What calls
            change in it later stays in the worker.

    """

    def __init__(self, subject: Any = None):
        self.subject, self.width = subject, width()
        self._pool: ProcessPoolExecutor | None = None
        self._stack = ExitStack()

    def __enter__(self) -> Workers:
        """One thread of linear algebra for each process."""
        if self.width > 1:
            self._stack.enter_context(threadpool_limits(1))
        return self

    def __exit__(self, *_) -> None:
        """End the workers, whatever they do."""
        self._end()
        self.width = 1
        self._stack.close()

    def map(self, function: Callable, items: Iterable, *common: Any) -> list:
        """
        ``[function(subject, item, *common) for item in items]``.

        Args:
            function: of a module; it, arguments and results can be pickled.
            items: independent of each other; the longest first, they are dealt out in turn.
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
            # Threads of this process, such as a progress bar's, hold nothing that a worker uses.
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
    """Start a worker: it ends as soon as nobody holds the other end of ``held``."""
    global _inside, _subject
    _inside, _subject = True, subject
    line.close()
    signal.signal(signal.SIGINT, signal.SIG_IGN)    # the parent's to hear
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    Thread(target=_wait, args=(held,), daemon=True).start()


def _wait(held):
    with suppress(EOFError, OSError):
        held.recv()
    os._exit(0)
