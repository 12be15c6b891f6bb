"""
A serial port whose calls do not block.

pyserial opens and configures the port. Reading and writing use its descriptor, because pyserial's
write waits in a busy loop, without a time limit, if the output buffer is full.
"""

import errno
import os
import select
import termios

import serial


class SerialPortError(OSError):
    """The port cannot be used; the message has its name and a remedy."""


CAUSES = {errno.ENOENT: 'no such port; check plug, power, name and udev rule',
          errno.EACCES: 'no permission; add the user to the group dialout and log in again, or '
                        'install the udev rule',
          errno.EAGAIN: 'in use by another process; stop it',
          errno.EBUSY: 'in use by another process; stop it',
          errno.EIO: 'unplugged', errno.ENXIO: 'unplugged', errno.ENODEV: 'unplugged'}
OPEN_ERRORS = OSError, ValueError, termios.error


def open_serial(name: str, baud: int) -> serial.Serial:
    """Open a port for this process only, without timeout; raises one of OPEN_ERRORS."""
    port = serial.Serial(name, baud, timeout=0, exclusive=True)
    try:
        port.set_low_latency_mode(True)
    except (OSError, ValueError, AttributeError, NotImplementedError):
        pass        # pseudo-terminals and USB CDC do not need this setting
    return port


def cause(error: Exception) -> str:
    """Cause and remedy of a port's error."""
    number = getattr(error, 'errno', None)
    if number is None and error.args and isinstance(error.args[0], int):
        number = error.args[0]
    return CAUSES.get(number) or (str(error).splitlines() or ['unplugged'])[0]


class SerialPort:
    """
    One open port, locked against other processes.

    Attributes:
        name: path of the port.
        dropped: number of frames dropped because the output buffer was full.

    """

    def __init__(self, name: str, baud: int):
        """
        Open ``name`` at ``baud`` [bit/s] and empty its buffers.

        Raises:
            SerialPortError: it is absent, in use, not permitted, or no serial port.

        """
        self.name = name
        self.dropped = 0
        try:
            self._serial = open_serial(name, baud)
        except OPEN_ERRORS as error:
            raise SerialPortError(f'{name}: cannot be opened ({cause(error)})') from None
        os.set_blocking(self._serial.fileno(), False)
        self._rest = b''

    def fileno(self) -> int:
        """Descriptor, for select."""
        return self._serial.fileno()

    def read(self) -> bytes:
        """
        Return the received bytes, also if there are none.

        Raises:
            SerialPortError: the device is gone.

        """
        try:
            data = os.read(self.fileno(), 4096)
        except BlockingIOError:
            return b''
        except OSError as error:
            raise self._gone(error) from None
        if not data and select.select([self.fileno()], [], [], 0)[0]:
            # A tty whose other end is closed is readable and empty.
            raise SerialPortError(f'{self.name}: device is gone (end of file)')
        return data

    def write(self, frame: bytes) -> bool:
        """
        Write a frame, or drop it if the output buffer is full.

        A frame that fits only in part is completed before the next frame.

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
        """Continue a partly written frame; return whether it is complete."""
        if self._rest:
            self._rest = self._rest[self._write(self._rest):]
        return not self._rest

    @property
    def waiting(self) -> bool:
        """Whether part of a frame is not written yet."""
        return bool(self._rest)

    def _write(self, data):
        try:
            return os.write(self.fileno(), data)
        except BlockingIOError:
            return 0
        except OSError as error:
            raise self._gone(error) from None

    def _gone(self, error):
        text = getattr(error, 'strerror', None) or str(error).splitlines()[0]
        return SerialPortError(f'{self.name}: device is gone ({text})')

    def close(self) -> None:
        """Close the port and drop unsent bytes, for which closing would wait."""
        try:
            self._serial.reset_output_buffer()
        except (OSError, termios.error):
            pass        # of a device that is gone
        try:
            self._serial.close()
        except OSError:
            pass
