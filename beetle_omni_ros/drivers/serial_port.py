"""
A serial port whose calls do not block.

pyserial opens and configures the port. Reading and writing use its descriptor, because pyserial's
write waits in a busy loop, without a time limit, if the output buffer is full.
"""

import errno
import os
import termios

import serial
from serial.tools import list_ports


class SerialPortError(OSError):
    """The port cannot be opened, or is lost; one line with its name and a remedy."""


CAUSES = {errno.ENOENT: 'no such port; check plug, power, name and udev rule',
          errno.EACCES: 'no permission; add the user to the group dialout and log in again, or '
                        'install the udev rule',
          **dict.fromkeys((errno.EAGAIN, errno.EBUSY), 'in use by another process; stop it'),
          **dict.fromkeys((errno.EIO, errno.ENXIO, errno.ENODEV), 'unplugged')}


class SerialPort:
    """
    One open port, locked against other processes. Each call raises SerialPortError if it is lost.

    ``fd`` is its descriptor, ``rest`` the part of a frame that is not written yet.
    """

    def __init__(self, name: str, baud: int):
        """Open ``name`` at ``baud`` [bit/s] and empty its buffers."""
        self.name, self.rest = name, b''
        try:
            # With the last argument an empty read of a lost port differs from one without bytes.
            self._serial = serial.Serial(name, baud, timeout=0, exclusive=True,
                                         inter_byte_timeout=0)
        except (OSError, ValueError, termios.error) as error:
            raise SerialPortError(f'{name}: cannot be opened ({_cause(error)})') from None
        try:
            self._serial.set_low_latency_mode(True)
        except (OSError, ValueError, AttributeError, NotImplementedError):
            pass        # pseudo-terminals and USB CDC do not need this setting
        self.fd = self._serial.fileno()
        os.set_blocking(self.fd, False)

    def read(self, size: int = 4096) -> bytes:
        """Return the received bytes, at most ``size``, also if there are none."""
        try:
            data = os.read(self.fd, size)
        except BlockingIOError:
            return b''
        except OSError as error:
            raise SerialPortError(f'{self.name}: {_cause(error)}') from None
        if not data:    # the other end is closed
            raise SerialPortError(f'{self.name}: unplugged')
        return data

    def clear(self) -> None:
        """Drop received bytes."""
        try:
            termios.tcflush(self.fd, termios.TCIFLUSH)
        except (OSError, termios.error) as error:
            raise SerialPortError(f'{self.name}: {_cause(error)}') from None

    def write(self, frame: bytes) -> bool:
        """
        Write a frame, or drop it if the output buffer is full; return whether it was written.

        A frame that fits only in part is completed before the next frame.
        """
        written = self._write(frame) if self.flush() else 0
        if written:
            self.rest = frame[written:]
        return written > 0

    def flush(self) -> bool:
        """Continue a partly written frame; return whether it is complete."""
        if self.rest:
            self.rest = self.rest[self._write(self.rest):]
        return not self.rest

    def _write(self, data):
        try:
            return os.write(self.fd, data)
        except BlockingIOError:
            return 0
        except OSError as error:
            raise SerialPortError(f'{self.name}: {_cause(error)}') from None

    def close(self) -> None:
        """Close the port and drop unsent bytes, for which closing would wait."""
        for step in (self._serial.reset_output_buffer, self._serial.close):
            try:
                step()
            except (OSError, termios.error):
                pass        # of a device that is gone


def _cause(error):
    """Cause and remedy of an error of the port; pyserial has the number in ``args`` at times."""
    number = getattr(error, 'errno', None) or (error.args or [None])[0]
    return CAUSES.get(number) or (str(error).splitlines() or ['unplugged'])[0]


def usb_ports() -> dict[str, str]:
    """USB serial ports of this computer: device -> maker, product, IDs and serial number."""
    return {port.device: ' '.join(filter(None, (
        port.manufacturer, port.product, f'({port.usb_info()})')))
        for port in list_ports.comports() if port.vid is not None}
