"""
Independent pieces of work on several cores, by forking.

A child finds everything as the parent left it, without a copy of megabytes of flights, and sends
back what it made. Where there is no fork, one core or one piece, or where a child dies, the work
is done here: results are the same.

A long analysis has many such pieces, and what a child has learnt on the way (signals, residuals)
would be lost with it. So within :func:`team` the children live on and do the whole analysis, too:
each makes its share of the pieces and gets the others' shares, and all come to the same decisions.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
import os
import pickle
import signal
import socket
import sys
from typing import Any, TypeVar
import warnings

try:
    from threadpoolctl import threadpool_limits
except ImportError:     # apt has it, but rosdep no key for it
    threadpool_limits = None

T = TypeVar('T')
WIDTH_KEY = 'OMP_NUM_THREADS'       # who limits threads by it means processes, too
_inside = False                     # of a piece of work, which is not split again
_team: _Team | None = None


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
    if _team:
        return _team.share(function, items)
    with _together(jobs) as gathered:
        return gathered.share(function, items, tell=False)


@contextmanager
def team() -> Iterator[bool]:
    """
    Let several processes do what stands in the block, and share the work of :func:`forked` there.

    All of them do all of the block, and only the first goes on after it. So the block has to do
    the same in each, and nobody but the first may show or write anything. Without threadpoolctl
    there is no team: the threads of each one's linear algebra would stand in the other's way.

    Yields:
        whether this is the first process.

    """
    size = width()
    if size < 2 or _team or threadpool_limits is None:
        yield not _team or _team.rank == 0
        return
    with threadpool_limits(1), _together(size) as gathered:
        yield gathered.rank == 0


@contextmanager
def _together(size):
    global _team
    sys.stdout.flush()
    sys.stderr.flush()
    _team = _gathered(size)
    try:
        yield _team
    finally:
        if _team.rank:
            os._exit(0)     # nothing of the first's is closed or written a second time
        _team.dismiss()
        _team = None


def _gathered(size):
    """The team, in each of its processes."""
    others = []
    for rank in range(1, size):
        ours, theirs = socket.socketpair()
        with warnings.catch_warnings():
            # Threads of the parent, such as a progress bar's, hold nothing that a child uses.
            warnings.simplefilter('ignore', DeprecationWarning)
            process = os.fork()
        if not process:
            for _, other in others:
                other.close()
            ours.close()
            _silence()
            return _Team(rank, size, [(os.getppid(), theirs.makefile('rwb'))])
        theirs.close()
        others.append((process, ours.makefile('rwb')))
        ours.close()
    return _Team(0, size, others)


def _silence():
    nowhere = os.open(os.devnull, os.O_WRONLY)
    for stream in (1, 2):
        os.dup2(nowhere, stream)


class _Team:
    """
    Processes that do the same.

    Attributes:
        rank: number of this one.
        size: how many there are.
        others: process number and connection: of all others in the first, of the first in others.

    """

    def __init__(self, rank, size, others):
        self.rank, self.size, self.others = rank, size, others
        self._calls = 0

    def share(self, function, items, tell=True):
        """Do as :func:`forked`; ``tell``: the others need the results, too."""
        global _inside
        self._calls += 1
        call = self._calls, len(items)
        shares: list = [None] * self.size
        _inside = True
        try:
            shares[self.rank] = _made(function, items[self.rank::self.size])
            if self.rank:
                shares = self._exchanged(call, shares)
            else:
                for rank, (_, pipe) in enumerate(self.others, 1):
                    shares[rank] = _received(pipe, call)
                if None in shares or tell and not self._told(call, shares):
                    self.dismiss()      # a process died or went its own way; go on alone
                    shares = [share or _made(function, items[rank::self.size])
                              for rank, share in enumerate(shares)]
                    self.size = 1
        finally:
            _inside = False
        results: list = [None] * len(items)
        for first, (good, made) in enumerate(shares):
            if not good:
                raise made
            results[first::len(shares)] = made
        return results

    def _exchanged(self, call, shares):
        """Everybody's shares, for one who is not the first; who is left alone ends."""
        pipe = self.others[0][1]
        if _sent(pipe, (call, shares[self.rank])):
            told = _received(pipe, call)
            if told:
                return [share or own for share, own in zip(told, shares, strict=True)]
        os._exit(1)

    def _told(self, call, shares):
        """Whether all others got what they did not make."""
        told = [_sent(pipe, (call, [None if k == rank else share
                                    for k, share in enumerate(shares)]))
                for rank, (_, pipe) in enumerate(self.others, 1)]
        return all(told)

    def dismiss(self):
        """End the others."""
        for process, pipe in self.others:
            os.kill(process, signal.SIGKILL)
            with suppress(OSError):
                pipe.close()
            os.waitpid(process, 0)
        self.others = []


def _made(function, items):
    """Whether it went well, and what was made, or the error."""
    try:
        return True, [function(item) for item in items]
    except Exception as error:
        return False, error


def _sent(pipe, message):
    """Whether a message could be sent."""
    try:
        pickle.dump(message, pipe, protocol=pickle.HIGHEST_PROTOCOL)
        pipe.flush()
        return True
    except (OSError, pickle.PicklingError, AttributeError, TypeError):
        return False


def _received(pipe, call):
    """What belongs to this call, or None."""
    try:
        of, message = pickle.load(pipe)
    except (OSError, EOFError, pickle.UnpicklingError):
        return None
    return message if of == call else None
