"""The serial port does not block, and its errors name the cause."""

import os
import pty
import tty

import pytest

pytest.importorskip('serial')

from beetle_omni_ros.drivers.serial_port import SerialPort

pytestmark = pytest.mark.real_time


@pytest.fixture
def ends():
    """Other end and path of a port."""
    device, other = pty.openpty()
    tty.setraw(other)
    yield device, os.ttyname(other)
    for descriptor in (device, other):
        try:
            os.close(descriptor)
        except OSError:
            pass


def test_a_full_buffer_drops_whole_frames_without_waiting(ends):
    """Without a reader at the other end, pyserial's write would not return."""
    device, name = ends
    port = SerialPort(name, 921600)
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


def test_bytes_that_arrive_during_a_read_are_no_lost_port(ends, monkeypatch):
    far, name = ends
    port, read = SerialPort(name, 1_000_000), os.read

    def late(descriptor, size):
        data = read(descriptor, size)
        os.write(far, b'late')
        return data

    monkeypatch.setattr(os, 'read', late)
    received = [port.read() for _ in range(3)]
    os.write(far, b'early')
    received += [port.read() for _ in range(3)]
    monkeypatch.undo()
    port.close()
    assert b'early' in b''.join(received)
