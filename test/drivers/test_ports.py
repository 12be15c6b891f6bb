"""Check of a port, and that an open one does not block and reports its loss."""

import os
import pty
import pwd
import tty
from types import SimpleNamespace

import pytest

pytest.importorskip('serial')

from serial.tools import list_ports

from beetle_omni_ros.drivers import device_checks as devices
from beetle_omni_ros.drivers.findings import Findings
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


def test_a_missing_port_lists_the_existing_ports(adapter, monkeypatch):
    found, remedy = devices.unusable_port('/dev/beetle_servos')
    assert found == '/dev/beetle_servos: no such port'
    assert '/dev/ttyUSB0: FTDI USB <-> Serial (USB VID:PID=0403:6014 SER=FT4THV5O)' in remedy
    monkeypatch.setattr(list_ports, 'comports', lambda: [])
    assert 'no USB serial port is present' in devices.unusable_port('/dev/beetle_servos')[1]


def test_a_port_without_permission_is_reported_with_the_remedy(monkeypatch):
    device, line = os.openpty()
    name, user = os.ttyname(line), pwd.getpwuid(os.geteuid()).pw_name
    assert devices.unusable_port(name) == ('', '')
    monkeypatch.setattr(devices.os, 'access', lambda *_: False)
    monkeypatch.setattr(devices.grp, 'getgrgid', lambda _: SimpleNamespace(gr_name='dialout'))
    found, remedy = devices.unusable_port(name)
    os.close(device)
    os.close(line)
    assert f'no permission for {user}' in found and f'usermod -aG dialout {user}' in remedy


@pytest.mark.parametrize(('timer', 'levels'), [
    ('16', ['ok', 'fail']), ('1', ['ok', 'ok']), ('', ['ok'])])
def test_product_and_latency_timer_of_an_open_port_are_reported(adapter, monkeypatch, timer,
                                                                levels):
    adapter.write_text(timer)
    monkeypatch.setattr(devices, 'unusable_port', lambda path: ('', ''))
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
