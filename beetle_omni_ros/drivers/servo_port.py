"""The port of the DYNAMIXEL SDK, without its busy waits, wall clock and blocking writes."""

import os
import select
import termios
import time

from dynamixel_sdk import port_handler

from beetle_omni_ros.drivers.serial_port import cause, OPEN_ERRORS, open_serial

# [ms] With the SDK's default of 16 a missing answer takes 34 ms. The adapter must be set
# accordingly: docs/how-to/hardware.md.
port_handler.LATENCY_TIMER = 1


class PortLost(OSError):
    """The serial port does not exist, cannot be opened, or was unplugged."""


class ServoPort(port_handler.PortHandler):
    """
    A serial port for the SDK's packet handler.

    ``reply_time`` is the time limit of an answer without its time on the wire [s].
    """

    def __init__(self, path: str, baud_rate: int, reply_time: float):
        super().__init__(path)
        self.baudrate = baud_rate
        self.reply_time = reply_time
        self.unsent = 0

    def setupPort(self, cflag_baud):
        """Open the port exclusively and set low latency."""
        if self.is_open:
            self.closePort()
        try:
            self.ser = open_serial(self.port_name, self.baudrate)
        except OPEN_ERRORS as error:
            raise PortLost(cause(error)) from None
        self.is_open = True
        self.tx_time_per_byte = 10_000.0 / self.baudrate
        return True

    def closePort(self):
        """Close the port; raises nothing."""
        if self.ser is not None:
            try:
                self.ser.close()
            except (OSError, termios.error):
                pass
        self.is_open = False

    def clearPort(self):
        """Drop received bytes."""
        try:
            termios.tcflush(self.ser.fd, termios.TCIFLUSH)
        except (OSError, termios.error, TypeError) as error:
            raise PortLost(cause(error)) from None

    def readPort(self, length):
        """Wait for bytes, at most until the packet's time limit."""
        remaining = (self.packet_timeout - self.getTimeSinceStart()) / 1000
        try:
            ready, _, _ = select.select([self.ser.fd], [], [], max(0.0, remaining))
            data = os.read(self.ser.fd, length) if ready else b''
        except BlockingIOError:
            return b''
        except (OSError, TypeError, ValueError) as error:
            raise PortLost(cause(error)) from None
        if ready and not data:
            raise PortLost('unplugged')
        return data

    def writePort(self, packet):
        """Write without waiting, also if the buffer is full."""
        self.unsent = len(packet)
        try:
            return os.write(self.ser.fd, bytes(packet))
        except BlockingIOError:
            return 0
        except (OSError, TypeError) as error:
            raise PortLost(cause(error)) from None

    def getCurrentTime(self):
        """Milliseconds of the monotonic clock."""
        return time.monotonic() * 1000

    def setPacketTimeout(self, packet_length):
        """Set the time limit: both packets' time on the wire and one reply time."""
        self.packet_start_time = self.getCurrentTime()
        self.packet_timeout = self.tx_time_per_byte * (self.unsent + packet_length) \
            + self.reply_time * 1000
