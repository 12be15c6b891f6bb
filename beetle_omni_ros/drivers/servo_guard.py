"""
Cuts the servos' torque when the process that drives them was killed.

Runs as a process of its own, holds no port and uses no time; :class:`Guard` starts it. Its
standard input is a pipe from the driver: a byte means that all is well and it may go; the pipe's
end without one means that the driver died with torque on. The servos' own watchdog would only
stop them.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time

import serial

PATIENCE = 2.0      # [s] for a port that is busy or away at that moment
REPEATS = 3         # nobody acknowledges a broadcast
PAUSE = 0.02        # [s] between them


class Guard:
    """
    The helper process of one bus.

    Args:
        port: serial port.
        baud_rate: [bit/s].
        packet: bytes that take the torque off all servos.

    """

    def __init__(self, port: str, baud_rate: int, packet: bytes):
        self._process = subprocess.Popen(
            [sys.executable, __file__, port, str(baud_rate), packet.hex()],
            stdin=subprocess.PIPE, start_new_session=True)

    def release(self):
        """Let it act now: the driver could not make sure that the torque is off."""
        if self._process is not None:
            self._process.stdin.close()
            self._process = None

    def dismiss(self):
        """All servos are without torque: let it end."""
        if self._process is None:
            return
        try:
            self._process.stdin.write(b'.')
            self._process.stdin.close()
            self._process.wait(2.0)
        except (OSError, subprocess.TimeoutExpired):
            self._process.kill()
            self._process.wait()
        self._process = None


def cut(port: str, baud_rate: int, packet: bytes):
    """Send ``packet`` as soon as the port can be opened."""
    end = time.monotonic() + PATIENCE
    while time.monotonic() < end:
        try:
            with serial.Serial(port, baud_rate, timeout=0, write_timeout=0.1) as line:
                # An unfinished packet of the dead driver ends here: the servos find the header.
                for _ in range(REPEATS):
                    line.write(packet)
                    line.flush()
                    time.sleep(PAUSE)
            return
        except OSError:
            time.sleep(PAUSE)


def main():
    """Wait for the driver's end."""
    port, baud_rate, packet = sys.argv[1:4]
    if not os.read(0, 1):
        cut(port, int(baud_rate), bytes.fromhex(packet))


if __name__ == '__main__':
    main()
