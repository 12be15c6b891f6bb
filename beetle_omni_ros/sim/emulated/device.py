"""Base of the emulated devices: a serial port without hardware, served by a thread, and faults."""

from contextlib import AbstractContextManager, suppress
from dataclasses import dataclass
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

from beetle_omni_ros.model.schema import parameter

CHUNK = 4096    # [B] size of the kernel's buffer
PERIOD = 0.01   # [s] longest sleep of the thread
SHARE = {'low': 0, 'high': 1}
LISTED = {'low': 1, 'high': 252}


@dataclass(kw_only=True)
class ServoFaults:
    """Faults of the servo bus, which may be changed at any time."""

    bad_crc: float = parameter(0.0, doc='share of answers with a flipped bit', **SHARE)
    dropped: float = parameter(0.0, doc='share of lost answers', **SHARE)
    delayed: float = parameter(0.0, doc='share of late answers', **SHARE)
    delay: float = parameter(0.02, doc='delay of late answers', unit='s', low=0, high=10)
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
    failed_escs: np.ndarray = parameter([], doc='rotors (1 to 4) that do not turn', low=1, high=4)


def switched_on(faults: ServoFaults | BoardFaults) -> list[str]:
    """Faults that differ from their defaults, such as 'silent [2]'."""
    healthy = vars(type(faults)())
    return [f'{name} {value.astype(int).tolist() if isinstance(value, np.ndarray) else value}'
            for name, value in vars(faults).items() if not np.array_equal(value, healthy[name])]


class Device(AbstractContextManager):
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
        self._random = Random(seed)
        self._running = True
        self.plug()
        self._thread = Thread(target=self._run, name=f'emulated {name}', daemon=True)
        self._thread.start()

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
                link.unlink(missing_ok=True)
                link.symlink_to(os.ttyname(self._line))
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

    def _send(self, data: bytes) -> None:
        """Send; it is lost if the buffer is full or the cable unplugged."""
        with suppress(OSError):
            os.write(self._device, data)

    def _spoilt(self, data: bytes, lost: float, corrupt: float) -> bytes:
        """Bytes after a cable that loses them, or flips a bit, with these probabilities."""
        draw = self._random.random
        if not data or draw() < lost:
            return b''
        if draw() < corrupt:
            bit = self._random.randrange(8 * len(data))
            return (int.from_bytes(data, 'big') ^ 1 << bit).to_bytes(len(data), 'big')
        return data

    def _due(self) -> float:
        raise NotImplementedError

    def _serve(self, now: float) -> None:
        raise NotImplementedError
