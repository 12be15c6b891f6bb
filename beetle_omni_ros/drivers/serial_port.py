"""
A serial port that never blocks.

pyserial opens and configures the port; reading and writing go to its descriptor, because
pyserial's write waits in a busy loop for room in a full output buffer, also without a time limit.
"""

from __future__ import annotations

import os
import select
import termios

import serial


class SerialPortError(OSError):
    """The port cannot be used; one line with its name and what to do."""


ADVICE = {
    2: 'no such device: is it plugged in and powered, is the name right?',
    13: "no permission: add the user to the group 'dialout' or install the udev rule",
    11: 'in use by another process', 16: 'in use by another process',
}


class SerialPort:
    """
    One open port, locked against other processes.

    Attributes:
        name: its path.
        dropped: writes refused because the output buffer was full.

    """

    def __init__(self, name: str, baud: int):
        """
        Open ``name`` at ``baud`` [bit/s]; what waits in its buffers is thrown away.

        Raises:
            SerialPortError: it is absent, taken, not permitted, or no serial port.

        """
        self.name = name
        self.dropped = 0
        try:
            self._serial = serial.Serial(name, baud, timeout=0, exclusive=True)
        except (serial.SerialException, OSError, ValueError, termios.error) as error:
            number = getattr(error, 'errno', None)
            text = ADVICE.get(number) or str(error).splitlines()[0]
            raise SerialPortError(f'{name}: cannot be opened ({text})') from None
        try:
            self._serial.set_low_latency_mode(True)
        except (OSError, ValueError, AttributeError, NotImplementedError):
            pass        # pseudo-terminals and USB CDC have no such setting, nor the need
        os.set_blocking(self._serial.fileno(), False)
        self._rest = b''

    def fileno(self) -> int:
        """Descriptor, for select."""
        return self._serial.fileno()

    def read(self) -> bytes:
        """
        Return what has arrived, perhaps nothing.

        Raises:
            SerialPortError: the device is gone.

        """
        try:
            data = os.read(self.fileno(), 4096)
        except BlockingIOError:
            return b''
        except (OSError, serial.SerialException) as error:
            raise self._gone(error) from None
        if not data and select.select([self.fileno()], [], [], 0)[0]:
            # Readable and yet empty is how a tty tells that its other end hung up.
            raise SerialPortError(f'{self.name}: device is gone (end of file)')
        return data

    def write(self, frame: bytes) -> bool:
        """
        Hand a frame to the driver's buffer as a whole, or drop it if there is no room.

        A frame that fits in part is completed before anything else is written.

        Raises:
            SerialPortError: the device is gone.

        """
        if self._rest and not self.flush():
            self.dropped += 1
            return False
        written = self._write(frame)
        if not written:
            self.dropped += 1
            return False
        self._rest = frame[written:]
        return True

    def flush(self) -> bool:
        """Go on with a frame written in part; tell whether it is complete."""
        if self._rest:
            self._rest = self._rest[self._write(self._rest):]
        return not self._rest

    @property
    def waiting(self) -> bool:
        """Whether part of a frame waits for room."""
        return bool(self._rest)

    def _write(self, data):
        try:
            return os.write(self.fileno(), data)
        except BlockingIOError:
            return 0
        except (OSError, serial.SerialException) as error:
            raise self._gone(error) from None

    def _gone(self, error):
        text = getattr(error, 'strerror', None) or str(error).splitlines()[0]
        return SerialPortError(f'{self.name}: device is gone ({text})')

    def close(self) -> None:
        """Give the port back; what is still unsent is dropped, or closing would wait for it."""
        try:
            self._serial.reset_output_buffer()
        except (OSError, termios.error):
            pass        # of a device that is gone
        try:
            self._serial.close()
        except OSError:
            pass
