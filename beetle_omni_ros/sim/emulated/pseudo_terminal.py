"""A serial port without hardware: a pseudo-terminal behind a link that can be unplugged."""

from __future__ import annotations

import os
from pathlib import Path
import select
import shutil
import tempfile
import termios
import tty

SPEEDS = {getattr(termios, name): int(name[1:]) for name in dir(termios)
          if name[0] == 'B' and name[1:].isdigit()}


class PseudoTerminal:
    """
    The device's side of a serial line.

    Attributes:
        port: path that a driver opens; a link, because another terminal may be behind it after
            the cable was out.

    """

    def __init__(self, port: str | Path | None = None, name: str = 'port'):
        self._folder = None if port else tempfile.mkdtemp(prefix='emulated_')
        self.port = str(port or Path(self._folder) / name)
        self._device = self._line = None
        self._waker, self._wake = os.pipe()
        os.set_blocking(self._wake, False)
        os.set_blocking(self._waker, False)
        self.plug()

    @property
    def plugged(self) -> bool:
        """Whether the port exists."""
        return self._device is not None

    @property
    def baud_rate(self) -> int:
        """Speed that the driver has set [bit/s]; 0 while unplugged."""
        return SPEEDS.get(termios.tcgetattr(self._line)[5], 0) if self.plugged else 0

    def plug(self):
        """Make the port."""
        if self.plugged:
            return
        self._device, self._line = os.openpty()
        tty.setraw(self._line)
        os.set_blocking(self._device, False)
        link = f'{self.port}.new'
        Path(link).unlink(missing_ok=True)
        os.symlink(os.ttyname(self._line), link)
        os.replace(link, self.port)
        self.interrupt()

    def unplug(self):
        """Take the port away, under the driver's hands."""
        if not self.plugged:
            return
        Path(self.port).unlink(missing_ok=True)
        device, line = self._device, self._line
        self._device = self._line = None
        os.close(device)
        os.close(line)
        self.interrupt()

    def receive(self, timeout: float) -> bytes:
        """Bytes from the driver; empty after ``timeout`` seconds or :meth:`interrupt`."""
        watched = [self._waker] + ([self._device] if self.plugged else [])
        ready, _, _ = select.select(watched, [], [], timeout)
        if self._waker in ready:
            os.read(self._waker, 4096)
        if not self.plugged or self._device not in ready:
            return b''
        try:
            return os.read(self._device, 4096)
        except OSError:
            return b''

    def send(self, data: bytes):
        """Give bytes to the driver; lost when nobody reads, as on a wire."""
        try:
            if self.plugged:
                os.write(self._device, data)
        except OSError:
            pass

    def interrupt(self):
        """Let :meth:`receive` return in its thread."""
        try:
            os.write(self._wake, b'\0')
        except (BlockingIOError, OSError):
            pass

    def close(self):
        """Remove port and folder."""
        self.unplug()
        for descriptor in (self._waker, self._wake):
            os.close(descriptor)
        if self._folder:
            shutil.rmtree(self._folder, ignore_errors=True)
