"""The installer of the onboard computer, the images and the container."""

from pathlib import Path
import re
import shutil
import subprocess

import pytest

from beetle_omni_ros.ros import graph
from beetle_omni_ros.ros.graph import AUTOSTART

ROOT = Path(__file__).resolve().parents[1]
DEPLOY = ROOT / 'deploy'
pytestmark = pytest.mark.skipif(not DEPLOY.is_dir(), reason='no source checkout')
RULES = 'etc/udev/rules.d/99-beetle-omni.rules'
LIMITS = 'etc/security/limits.d/99-beetle-omni.conf'
UNIT = 'etc/systemd/system/beetle-omni-bridges.service'


def install(root, *options):
    return subprocess.run(['sh', str(DEPLOY / 'install.sh'), '--root', str(root), '--user',
                           'pilot', *options], capture_output=True, text=True, timeout=60)


def files(root):
    return {str(path.relative_to(root)): path.read_text()
            for path in root.rglob('*') if path.is_file()}


def test_uninstalling_removes_exactly_the_installed_files(tmp_path):
    other = tmp_path / 'etc/udev/rules.d/10-other.rules'
    other.parent.mkdir(parents=True)
    other.write_text('# another\n')
    assert install(tmp_path).returncode == 0
    written = files(tmp_path)
    assert {RULES, LIMITS, UNIT} <= set(written) and 'pilot - rtprio' in written[LIMITS]
    assert install(tmp_path).stdout.count('unchanged') == 3
    assert install(tmp_path, '--no-service').returncode == 0 and UNIT not in files(tmp_path)
    assert install(tmp_path, '--uninstall').returncode == 0
    assert files(tmp_path) == {'etc/udev/rules.d/10-other.rules': '# another\n'}


def test_the_rules_name_both_ports_and_set_the_latency_timer(tmp_path):
    assert install(tmp_path, '--servo-serial', 'FT2N08', '--board-serial', '3276').returncode == 0
    rules = files(tmp_path)[RULES]
    lines = [line for line in rules.splitlines() if not line.startswith('#')]
    assert len(lines) == 3
    servos, timer, board = lines
    assert 'ATTRS{serial}=="FT2N08"' in servos and 'SYMLINK+="beetle_servos"' in servos
    assert 'ATTRS{serial}=="3276"' in board and 'SYMLINK+="motor_board"' in board
    assert 'ATTR{latency_timer}="1"' in timer
    for line in lines:      # key, operator and quoted value, separated by commas
        assert re.fullmatch(r'(?:[A-Z_]+(?:\{\w+\})?(?:==|\+=|=)"[^"]*"(?:, |$))+', line), line


def test_the_service_starts_the_bridges_without_arming(tmp_path):
    robot = tmp_path / 'robot.yaml'
    robot.touch()
    done = install(tmp_path, '--workspace', '/home/pilot/ws', *(word for option in (
        '--robot', '--servo-bus', '--motor-board') for word in (option, str(robot))))
    assert done.returncode == 0, done.stderr
    unit = (tmp_path / UNIT).read_text()
    start = re.search(r'^ExecStart=(.*)$', unit, re.M)[1]
    assert AUTOSTART['configure'] == 'inactive'
    for node in ('joint_bridge_node', 'rotor_bridge_node'):
        assert node in graph.NODES
        assert re.findall(rf'-p {node}:autostart:=(\w+)', start) == ['configure']
        assert f'-p {node}:robot_file:={robot}' in start
    assert f'-p joint_bridge_node:servo_bus_file:={robot}' in start
    assert f'-p rotor_bridge_node:motor_board_file:={robot}' in start
    assert 'activate ' not in start.replace('/bin/activate', '') and 'supervisor' not in start
    assert {'User=pilot', 'KillSignal=SIGINT'} <= set(unit.splitlines())
    analyse = shutil.which('systemd-analyze')
    if analyse:
        output = subprocess.run([analyse, 'verify', str(tmp_path / UNIT)], capture_output=True,
                                text=True, timeout=60).stderr
        assert not re.search(r'Unknown|Invalid|Failed to parse|ignoring', output), output


@pytest.mark.parametrize('options', [
    ['--user', 'x;reboot'], ['--servo-serial', '"'], ['--robot', '/does/not/exist'],
    ['--servo-serial'], ['--wrong']])
def test_unusable_options_are_refused_in_one_line_and_write_nothing(tmp_path, options):
    done = install(tmp_path, *options)
    assert done.returncode == 2 and done.stderr.startswith('install: error: ')
    assert not files(tmp_path)
