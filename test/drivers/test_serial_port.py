"""The serial port does not block, and reports its loss."""

import os
import pty
import tty

import pytest

pytest.importorskip('serial')

from beetle_omni_ros.drivers.serial_port import SerialPort, SerialPortError

pytestmark = pytest.mark.real_time


def test_a_full_buffer_drops_whole_frames_without_waiting():
    """Without a reader at the other end, pyserial's write would not return."""
    device, other = pty.openpty()
    tty.setraw(other)
    port = SerialPort(os.ttyname(other), 921600)
    assert port.read() == b''
    frames = [bytes([k % 256]) * 55 for k in range(2000)]
    taken = [k for k, frame in enumerate(frames) if port.write(frame)]
    assert 10 < len(taken) < 2000
    received = b''
    while True:
        port.flush()
        try:
            os.set_blocking(device, False)
            received += os.read(device, 65536)
        except BlockingIOError:
            if not port.rest:
                break
    assert received == b''.join(frames[k] for k in taken)
    port.close()


def test_a_port_whose_other_end_is_closed_is_lost():
    device, other = pty.openpty()
    tty.setraw(other)
    port = SerialPort(os.ttyname(other), 1_000_000)
    os.write(device, b'last')
    assert port.read() == b'last'
    os.close(device)
    with pytest.raises(SerialPortError, match='unplugged'):
        port.read()
