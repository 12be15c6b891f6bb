"""Base of the emulated devices: a serial port without hardware, served by a thread, and faults."""

from contextlib import suppress
from dataclasses import dataclass, fields
import heapq
import itertools
from math import inf
import os
from pathlib import Path
from random import Random
import select
import shutil
import tempfile
from threading import RLock, Thread
import time
import tty

import numpy as np

from beetle_omni_ros.robot.schema import parameter

CHUNK = 4096    # [B] size of the kernel's buffer
PERIOD = 0.01   # [s] longest sleep of the thread
SHARE = {'low': 0, 'high': 1}
LISTED = {'low': 1, 'high': 252}
DELAY = {'unit': 's', 'low': 0, 'high': 10}


@dataclass(kw_only=True)
class ServoFaults:
    """Faults of the servo bus, which may be changed at any time."""

    bad_crc: float = parameter(0.0, doc='share of answers with a flipped bit', **SHARE)
    dropped: float = parameter(0.0, doc='share of lost answers', **SHARE)
    delayed: float = parameter(0.0, doc='share of late answers', **SHARE)
    delay: float = parameter(0.02, doc='delay of late answers', **DELAY)
    silent: np.ndarray = parameter([], doc='IDs that receive and answer nothing', **LISTED)
    overload: np.ndarray = parameter([], doc='IDs with a permanent overload', **LISTED)
    supply_voltage: float = parameter(12.0, doc='supply voltage of the servos', unit='V', low=0,
                                      high=30)


@dataclass(kw_only=True)
class BoardFaults:
    """Faults of motor board, rotors and cable, as :class:`ServoFaults`."""

    corrupt_out: float = parameter(0.0, doc='share of packets of the board with a flipped bit',
                                   **SHARE)
    corrupt_in: float = parameter(0.0, doc='share of packets to the board with a flipped bit',
                                  **SHARE)
    drop_out: float = parameter(0.0, doc='share of lost packets of the board', **SHARE)
    drop_in: float = parameter(0.0, doc='share of lost packets to the board', **SHARE)
    delay_out: float = parameter(0.0, doc='delay of packets of the board', **DELAY)
    delay_in: float = parameter(0.0, doc='delay of packets to the board', **DELAY)
    failed_escs: np.ndarray = parameter([], doc='rotors (1 to 4) that do not turn', low=1, high=4)


def switched_on(faults: ServoFaults | BoardFaults) -> list[str]:
    """Levels that differ from their defaults, such as 'silent [2]'."""
    healthy, found = type(faults)(), []
    for name in (entry.name for entry in fields(faults)):
        value = getattr(faults, name)
        if name == 'delay' or np.array_equal(value, getattr(healthy, name)):
            continue
        if isinstance(value, np.ndarray):
            found.append(f'{name} {sorted({int(one) for one in value})}')
        else:
            found.append(f'{name} {value:g}')
    return found


class Line:
    """One direction of a cable, which loses, corrupts and delays packets."""

    def __init__(self, seed: int):
        self._random, self._count = Random(seed), itertools.count()
        self._waiting: list[tuple[float, int, bytes]] = []

    def put(self, data: bytes, now: float, drop: float = 0.0, corrupt: float = 0.0,
            delay: float = 0.0, delayed: float = 1.0) -> None:
        """Send a packet at ``now`` [s]; ``drop``, ``corrupt`` and ``delayed`` are shares."""
        draw = self._random.random
        if draw() < drop:
            return
        if draw() < corrupt:
            place, bit = self._random.randrange(len(data)), 1 << self._random.randrange(8)
            data = data[:place] + bytes((data[place] ^ bit,)) + data[place + 1:]
        due = now + delay * (draw() < delayed)
        heapq.heappush(self._waiting, (due, next(self._count), data))

    def take(self, now: float) -> bytes:
        """Receive everything that has arrived by ``now`` [s]."""
        pieces = []
        while self.next() <= now:
            pieces.append(heapq.heappop(self._waiting)[2])
        return b''.join(pieces)

    def next(self) -> float:
        """Arrival of the next packet [s], inf without one."""
        return self._waiting[0][0] if self._waiting else inf

    def clear(self) -> None:
        """Lose all packets that have not arrived."""
        self._waiting.clear()


class Device:
    """
    The device's end of a serial cable, as a context manager.

    A thread calls ``_serve(now)`` of the subclass, at the latest at the time ``_due()`` [s]. The
    path ``port`` for the driver, by default ``name`` in a temporary folder, is a link to the
    present terminal. It exists while plugged in; an OSError reports that it cannot be created.
    """

    def __init__(self, name: str, port: str | Path | None, seed: int):
        self._folder = None if port else tempfile.mkdtemp(prefix='emulated_')
        self.port = str(port or Path(self._folder) / name)
        self._lock, self._device, self._line = RLock(), -1, -1
        self._incoming, self._outgoing = Line(seed), Line(seed + 1)
        self._running = True
        self.plug()
        self._thread = Thread(target=self._run, name=f'emulated {name}', daemon=True)
        self._thread.start()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.close()

    def close(self) -> None:
        """Stop the thread and remove the port."""
        if self._running:
            self._running = False
            self._thread.join(2.0)
            self.unplug()
            if self._folder:
                shutil.rmtree(self._folder, ignore_errors=True)

    def plug(self) -> None:
        """Plug the cable in, unless it is."""
        link = Path(self.port)
        fresh = link.with_name(f'{link.name}.new')
        with self._lock:
            if self._device >= 0:
                return
            if os.path.lexists(link) and not link.is_symlink():
                raise OSError(f'{link}: cannot be used as a port, it exists and is no link')
            # The driver's end is kept open, because a serial device cannot detect its driver.
            self._device, self._line = os.openpty()
            tty.setraw(self._line)
            os.set_blocking(self._device, False)
            try:
                fresh.unlink(missing_ok=True)
                fresh.symlink_to(os.ttyname(self._line))
                fresh.replace(link)
            except OSError as error:
                self.unplug()
                raise OSError(f'{link}: cannot be used as a port ({error.strerror})') from None

    def unplug(self) -> None:
        """Unplug the cable; a driver that has the port open gets an error or an end of file."""
        with self._lock:
            if self._device < 0:
                return
            link = Path(self.port)
            if link.is_symlink() and os.readlink(link) == os.ttyname(self._line):
                link.unlink()       # another device may have replaced it
            os.close(self._line)
            os.close(self._device)
            self._device = self._line = -1
            self._incoming.clear()
            self._outgoing.clear()

    def _run(self):
        while self._running:
            now = time.monotonic()
            timeout = max(0.0, min(self._due(), now + PERIOD) - now)
            device = self._device
            with suppress(OSError, ValueError):     # it was unplugged meanwhile
                select.select([device] if device >= 0 else [], [], [], timeout)
            with self._lock:
                self._serve(time.monotonic())

    def _read(self) -> bytes:
        """Received bytes; empty without any, or if unplugged."""
        with suppress(OSError):
            return os.read(self._device, CHUNK)
        return b''

    def _flush(self, now: float) -> None:
        """Send what is due; it is lost if the buffer is full or the cable unplugged."""
        if data := self._outgoing.take(now):
            with suppress(OSError):
                os.write(self._device, data)

    def _due(self) -> float:
        return min(self._incoming.next(), self._outgoing.next())

    def _serve(self, now: float) -> None:
        raise NotImplementedError
