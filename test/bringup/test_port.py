"""Check of a closed port: absent, not permitted, in use, slow, or ok."""

import grp
import os
import pwd
import subprocess
import sys

import pytest

from beetle_omni_ros.bringup import port as room
from beetle_omni_ros.bringup.port import holders, latency_finding, port_finding


@pytest.fixture
def terminal(tmp_path):
    """Path of a link to a pseudo-terminal."""
    device, line = os.openpty()
    link = tmp_path / 'beetle_servos'
    link.symlink_to(os.ttyname(line))
    yield str(link)
    os.close(device)
    os.close(line)


@pytest.fixture
def sys_root(tmp_path):
    """A sysfs with one FTDI adapter, ttyUSB0."""
    usb = tmp_path / 'sys/devices/usb1/1-2'
    tty = usb / '1-2:1.0/ttyUSB0'
    tty.mkdir(parents=True)
    for name, text in {'idVendor': '0403', 'idProduct': '6014', 'manufacturer': 'FTDI',
                       'product': 'USB <-> Serial', 'serial': 'FT4THV5O'}.items():
        (usb / name).write_text(text + '\n')
    (tty / 'latency_timer').write_text('16\n')
    for folder in ('class/tty/ttyUSB0', 'bus/usb-serial/devices'):
        (tmp_path / 'sys' / folder).mkdir(parents=True)
    (tmp_path / 'sys/class/tty/ttyUSB0/device').symlink_to(tty)
    (tmp_path / 'sys/bus/usb-serial/devices/ttyUSB0').symlink_to(tty)
    return tmp_path / 'sys'


def test_a_missing_port_lists_the_existing_ports(tmp_path, sys_root):
    finding = port_finding('port', '/dev/beetle_servos', sys_root)
    assert finding.level == 'fail' and '/dev/beetle_servos: no such port' in finding.found
    assert '/dev/ttyUSB0: FTDI USB <-> Serial (0403:6014, serial FT4THV5O)' in finding.remedy
    finding = port_finding('port', '/dev/beetle_servos', tmp_path / 'empty')
    assert 'no USB serial port is present' in finding.remedy


def test_a_dangling_link_and_a_regular_file_are_refused_as_ports(tmp_path):
    (tmp_path / 'link').symlink_to('/dev/ttyUSB77')
    assert '/dev/ttyUSB77' in port_finding('port', str(tmp_path / 'link')).found
    (tmp_path / 'file').touch()
    for path in (tmp_path, tmp_path / 'file'):
        finding = port_finding('port', str(path))
        assert finding.level == 'fail' and 'no serial port' in finding.found


def as_group(monkeypatch, name, members, mode):
    """Make a port inaccessible; it belongs to group ``name`` with these members."""
    real = os.stat
    monkeypatch.setattr(room.os, 'access', lambda *_: False)
    monkeypatch.setattr(room.grp, 'getgrgid', lambda _: (name, 'x', 20, members))
    monkeypatch.setattr(room.grp, 'getgrnam', lambda _: grp.struct_group(
        (name, 'x', 20, members)))

    def stat(path, **options):
        found = real(path, **options)
        return os.stat_result((0o20000 | mode, *found[1:]), {'st_rdev': found.st_rdev})
    monkeypatch.setattr(room.os, 'stat', stat)


@pytest.mark.parametrize(('group', 'joined', 'mode', 'remedy'), [
    ('dialout', False, 0o660, 'sudo usermod -aG dialout {user}'),
    ('dialout', True, 0o660, 'log out and in again'),
    ('dialout', False, 0o600, 'udev rule'),
    ('root', False, 0o660, 'udev rule')])
def test_a_port_without_permission_is_reported_with_the_remedy(terminal, monkeypatch, group,
                                                               joined, mode, remedy):
    user = pwd.getpwuid(os.geteuid()).pw_name
    as_group(monkeypatch, group, [user] if joined else [], mode)
    finding = port_finding('port', terminal)
    assert finding.level == 'fail' and f'no permission for {user}' in finding.found
    assert group in finding.found and remedy.format(user=user) in finding.remedy


def other_process(program, *arguments):
    """Start a Python program that prints a line when it is ready, and waits."""
    process = subprocess.Popen([sys.executable, '-c', program, *arguments], text=True,
                               stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    return process, process.stdout.readline().strip()


def test_the_process_that_uses_the_port_is_named(terminal):
    process, _ = other_process('import sys; f = open(sys.argv[1], "rb", 0); '
                               'print("open", flush=True); sys.stdin.read()', terminal)
    try:
        assert [pid for pid, _ in holders(terminal)] == [process.pid]
        finding = port_finding('port', terminal)
    finally:
        process.communicate()
    assert finding.level == 'fail' and f'used by process {process.pid}' in finding.found
    assert finding.values['holders'] == 1
    assert port_finding('port', terminal).level == 'ok'


def test_the_device_behind_a_pseudo_terminal_is_not_a_user_of_the_port():
    process, name = other_process('import os, sys; a, b = os.openpty(); '
                                  'print(os.ttyname(b), flush=True); sys.stdin.read()')
    try:
        assert holders(name) == []
    finally:
        process.communicate()


def test_the_latency_timer_is_read_if_it_exists(sys_root):
    finding = latency_finding('timer', '/dev/ttyUSB0', 1, sys_root)
    assert finding.level == 'fail' and finding.values == {'latency_timer_ms': 16}
    assert 'latency_timer' in finding.remedy
    (sys_root / 'bus/usb-serial/devices/ttyUSB0/latency_timer').write_text('1\n')
    assert latency_finding('timer', '/dev/ttyUSB0', 1, sys_root).level == 'ok'
    assert latency_finding('timer', '/dev/ttyACM0', 1, sys_root).level == 'ok'
