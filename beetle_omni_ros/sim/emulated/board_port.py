"""A pseudo-terminal under a name that stays, and that can be unplugged."""

from __future__ import annotations

import os
from pathlib import Path
import shutil
import tempfile
import tty


class PluggablePort:
    """
    The device's end of a serial cable.

    Attributes:
        path: the name to open from the other end; it exists only while plugged in.

    """

    def __init__(self, name: str):
        """Plug in under a path that ends in ``name``."""
        self._folder = Path(tempfile.mkdtemp(prefix='beetle_omni_'))
        self.path = str(self._folder / name)
        self._device = self._other = -1
        self.plug()

    @property
    def plugged(self) -> bool:
        """Whether the other end can be open."""
        return self._device >= 0

    def fileno(self) -> int:
        """Descriptor, for select; -1 unplugged."""
        return self._device

    def plug(self) -> None:
        """Connect; nothing if connected."""
        if self.plugged:
            return
        # The other end is kept open too: a serial device does not notice who listens.
        self._device, self._other = os.openpty()
        tty.setraw(self._other)
        os.set_blocking(self._device, False)
        os.symlink(os.ttyname(self._other), self.path)

    def unplug(self) -> None:
        """Pull the cable: whoever has the port open gets an error or an end of file."""
        if not self.plugged:
            return
        os.unlink(self.path)
        device, other, self._device, self._other = self._device, self._other, -1, -1
        os.close(other)
        os.close(device)

    def read(self) -> bytes:
        """What has arrived; nothing if unplugged."""
        try:
            return os.read(self._device, 4096)
        except OSError:
            return b''

    def write(self, data: bytes) -> None:
        """Send; what finds no room is lost, as where nobody listens."""
        try:
            os.write(self._device, data)
        except OSError:
            pass

    def close(self) -> None:
        """Unplug for good."""
        self.unplug()
        shutil.rmtree(self._folder, ignore_errors=True)
