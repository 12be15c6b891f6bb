"""
Independent pieces of work on several cores, by forking.

A child finds everything as the parent left it, without a copy of megabytes of flights, and sends
back what it made. Where there is no fork, one core or one piece, or where a child dies, the work
is done here: results are the same.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
import os
import pickle
import signal
import sys
from typing import Any, TypeVar
import warnings

T = TypeVar('T')
WIDTH_KEY = 'OMP_NUM_THREADS'       # who limits threads by it means processes, too
_inside = False                     # of a child, whose work is not split again


def width() -> int:
    """How many processes work at a time."""
    if _inside or sys.platform != 'linux':
        return 1
    allowed = os.environ.get(WIDTH_KEY, '')
    cores = len(os.sched_getaffinity(0))
    return max(1, min(cores, int(allowed))) if allowed.isdigit() else cores


def forked(function: Callable[[Any], T], items: Iterable[Any]) -> list[T]:
    """
    ``[function(item) for item in items]``, on several cores.

    Args:
        function: of one item; changes that it makes to anything are lost, and what it gives or
            raises can be pickled.
        items: independent of each other; the longest first, they are dealt out in turn.

    """
    items = list(items)
    jobs = min(width(), len(items))
    if jobs < 2:
        return [function(item) for item in items]
    sys.stdout.flush()
    sys.stderr.flush()
    living = [_child(function, items[first::jobs]) for first in range(1, jobs)]
    try:
        shares = [[function(item) for item in items[::jobs]]]
        while living:
            shares.append(_answer(*living.pop(0)))
    except BaseException:
        for process, pipe in living:
            os.kill(process, signal.SIGKILL)
            pipe.close()
            os.waitpid(process, 0)
        raise
    results: list = [None] * len(items)
    for first, share in enumerate(shares):
        if share is None:       # the child died
            share = [function(item) for item in items[first::jobs]]
        results[first::jobs] = share
    return results


def _child(function, items):
    """Process number and readable end of the pipe of a child that does these items."""
    read, write = os.pipe()
    with warnings.catch_warnings():
        # Threads of the parent, such as a progress bar's, hold nothing that a child uses.
        warnings.simplefilter('ignore', DeprecationWarning)
        process = os.fork()
    if process:
        os.close(write)
        return process, os.fdopen(read, 'rb')
    try:
        os.close(read)
        global _inside
        _inside = True
        try:
            made = True, [function(item) for item in items]
        except Exception as error:
            made = False, error
        with os.fdopen(write, 'wb') as pipe:
            pickle.dump(made, pipe, protocol=pickle.HIGHEST_PROTOCOL)
    finally:
        os._exit(0)     # nothing of the parent's is closed or written a second time


def _answer(process, pipe):
    """What a child made, or None where it died."""
    try:
        with pipe:
            good, made = pickle.load(pipe)
    except (EOFError, pickle.UnpicklingError):
        good, made = True, None
    finally:
        os.waitpid(process, 0)
    if not good:
        raise made
    return made
