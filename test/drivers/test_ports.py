"""Check of a port, and that an open one does not block and reports its loss."""

import errno
import os
import pty
import tty
from types import SimpleNamespace

import pytest

pytest.importorskip('serial')

import serial
from serial.tools import list_ports

from beetle_omni_ros.drivers import device_checks as devices
from beetle_omni_ros.drivers.check import Findings
from beetle_omni_ros.drivers.serial_port import SerialPort, SerialPortError


@pytest.fixture
def adapter(tmp_path, monkeypatch):
    """A USB adapter at ttyUSB0, with its latency timer."""
    timer = tmp_path / 'bus/usb-serial/devices/ttyUSB0/latency_timer'
    timer.parent.mkdir(parents=True)
    port = SimpleNamespace(device='/dev/ttyUSB0', manufacturer='FTDI', product='USB <-> Serial',
                           vid=0x403, usb_info=lambda: 'USB VID:PID=0403:6014 SER=FT4THV5O')
    monkeypatch.setattr(list_ports, 'comports', lambda: [port])
    monkeypatch.setattr(devices, 'SYS', tmp_path)
    return timer


@pytest.mark.parametrize('present', [True, False])
def test_a_missing_port_lists_the_existing_ports(adapter, monkeypatch, present):
    if not present:
        monkeypatch.setattr(list_ports, 'comports', lambda: [])
    findings, path = Findings(), '/dev/beetle_servos'
    device = SimpleNamespace(open=lambda: SerialPort(path, 9600))
    assert not devices.open_port(findings, device, 'servo', path, 'joint_bridge', None)
    (finding,) = findings
    assert finding.level == 'fail' and f'{path}: cannot be opened (no such port' in finding.found
    assert finding.remedy.endswith(
        '/dev/ttyUSB0: FTDI USB <-> Serial (USB VID:PID=0403:6014 SER=FT4THV5O)' if present
        else 'none')


def test_a_port_without_permission_is_reported_with_the_remedy(monkeypatch):
    def refuse(*_, **__):
        raise PermissionError(errno.EACCES, 'Permission denied')

    monkeypatch.setattr(serial, 'Serial', refuse)
    with pytest.raises(SerialPortError, match='no permission; add the user to the group dialout'):
        SerialPort('/dev/ttyUSB0', 9600)


@pytest.mark.parametrize(('timer', 'levels'), [
    ('16', ['ok', 'fail']), ('1', ['ok', 'ok']), ('', ['ok'])])
def test_product_and_latency_timer_of_an_open_port_are_reported(adapter, monkeypatch, timer,
                                                                levels):
    adapter.write_text(timer)
    findings, device = Findings(), SimpleNamespace(open=lambda: None)
    assert devices.open_port(findings, device, 'servo', '/dev/ttyUSB0', 'joint_bridge', None)
    assert [finding.level for finding in findings] == levels
    assert 'FTDI USB' in findings[0].found


@pytest.mark.real_time
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


@pytest.mark.real_time
def test_a_port_whose_other_end_is_closed_is_lost():
    device, other = pty.openpty()
    tty.setraw(other)
    port = SerialPort(os.ttyname(other), 1_000_000)
    os.write(device, b'last')
    assert port.read() == b'last'
    os.close(device)
    with pytest.raises(SerialPortError, match='unplugged'):
        port.read()
