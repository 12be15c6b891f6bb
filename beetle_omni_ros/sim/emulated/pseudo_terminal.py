"""A serial port without hardware: a pseudo-terminal with a fixed path, which can be unplugged."""

from contextlib import suppress
import os
from pathlib import Path
import select
import shutil
import tempfile
import termios
import tty

SPEEDS = {getattr(termios, name): int(name[1:]) for name in dir(termios)
          if name[0] == 'B' and name[1:].isdigit()}
CHUNK = 4096    # [B] size of the kernel's buffer


class PseudoTerminal:
    """
    The device's end of a serial cable.

    One thread calls :meth:`wait`. Any thread may call the other methods, under a lock of the
    owner. ``port`` is the path for the driver, a link to the present terminal; it exists only
    while plugged in. Without a given path it is ``name`` in a temporary folder.

    Raises:
        OSError: the path cannot be created; the message has the path.

    """

    def __init__(self, port: str | Path | None = None, name: str = 'port'):
        self._folder = None if port else tempfile.mkdtemp(prefix='emulated_')
        self.port = str(port or Path(self._folder) / name)
        self._device = self._line = -1
        self._waker, self._wake = os.pipe()
        os.set_blocking(self._wake, False)
        try:
            self.plug()
        except OSError:
            self.close()
            raise

    @property
    def baud_rate(self) -> int:
        """Baud rate set by the driver [bit/s]."""
        return SPEEDS.get(termios.tcgetattr(self._line)[5], 0)

    def plug(self) -> None:
        """
        Create the port if it does not exist.

        Raises:
            OSError: the path exists and is not a link, or cannot be created.

        """
        if self._device >= 0:
            return
        link = Path(self.port)
        if os.path.lexists(link) and not link.is_symlink():
            raise OSError(f'{link}: cannot be used as a port, it exists and is no link')
        # The driver's end is kept open, because a serial device cannot detect its driver.
        device, line = os.openpty()
        try:
            tty.setraw(line)
            os.set_blocking(device, False)
            fresh = Path(f'{link}.new')
            fresh.unlink(missing_ok=True)
            fresh.symlink_to(os.ttyname(line))
            fresh.replace(link)
        except OSError as error:
            os.close(device)
            os.close(line)
            raise OSError(f'{link}: cannot be used as a port ({error.strerror})') from None
        self._device, self._line = device, line
        self.interrupt()

    def unplug(self) -> None:
        """Remove the port; a driver that has it open gets an error or an end of file."""
        if self._device < 0:
            return
        device, line, self._device, self._line = self._device, self._line, -1, -1
        link = Path(self.port)
        if link.is_symlink() and os.readlink(link) == os.ttyname(line):
            link.unlink()       # another device may have replaced it
        os.close(line)
        os.close(device)
        self.interrupt()

    def wait(self, timeout: float) -> None:
        """Return when bytes arrive, after ``timeout`` [s], or on :meth:`interrupt`."""
        device = self._device
        watched = [self._waker, device] if device >= 0 else [self._waker]
        with suppress(OSError):     # the port was unplugged during the call
            if self._waker in select.select(watched, [], [], max(0.0, timeout))[0]:
                os.read(self._waker, CHUNK)

    def read(self) -> bytes:
        """Received bytes; empty without any, or if unplugged."""
        try:
            return os.read(self._device, CHUNK)
        except OSError:
            return b''

    def write(self, data: bytes) -> None:
        """Send bytes; they are lost if the buffer is full or the port unplugged."""
        with suppress(OSError):
            os.write(self._device, data)

    def interrupt(self) -> None:
        """Let :meth:`wait` return."""
        with suppress(BlockingIOError):
            os.write(self._wake, b'\0')

    def close(self) -> None:
        """Remove port and folder."""
        self.unplug()
        for descriptor in (self._waker, self._wake):
            os.close(descriptor)
        if self._folder:
            shutil.rmtree(self._folder, ignore_errors=True)
