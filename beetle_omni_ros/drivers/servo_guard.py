"""
Switches the servos' torque off if their driver was killed; their own watchdog only stops them.

:func:`start` runs this module as a separate process, which sleeps and has no port open. Its
standard input is a pipe from the driver. A byte ends it without action. The end of the pipe
without a byte means that the driver died with torque on.
"""

import os
import subprocess
import sys
import time

import serial

HOLD = 10.0         # [s] with torque, but stopped by the watchdogs: a landing from 2 m
OPEN_TIMEOUT = 2.0  # [s] for a port that is busy or unplugged
REPEATS = 3         # a broadcast has no acknowledgement
PAUSE = 0.02        # [s] between repetitions


def start(port: str, baud_rate: int, packet: bytes) -> subprocess.Popen:
    """
    Start the guard of one bus; ``packet`` switches the torque of all servos off.

    It does so when the ``stdin`` of the returned process is closed.
    """
    return subprocess.Popen([sys.executable, __file__, port, str(baud_rate), packet.hex()],
                            stdin=subprocess.PIPE, start_new_session=True)


def dismiss(guard: subprocess.Popen):
    """End a guard without action, because the torque of all servos is off."""
    try:
        guard.communicate(b'.', 2.0)
    except subprocess.TimeoutExpired:
        guard.kill()


def main():
    """Wait for the end of the pipe and a landing, then send the packet; not to a new driver."""
    port, baud_rate, packet = sys.argv[1], int(sys.argv[2]), bytes.fromhex(sys.argv[3])
    if os.read(0, 1):
        return
    time.sleep(HOLD)
    end = time.monotonic() + OPEN_TIMEOUT
    while time.monotonic() < end:
        try:
            with serial.Serial(port, baud_rate, timeout=0, write_timeout=0.1,
                               exclusive=True) as line:
                # The header of this packet also ends an incomplete packet of the driver.
                for _ in range(REPEATS):
                    line.write(packet)
                    line.flush()
                    time.sleep(PAUSE)
            return
        except OSError:
            time.sleep(PAUSE)


if __name__ == '__main__':
    main()
