"""`fly --faults`: what fails in a flight through ROS, from the task's start on."""

import os
import subprocess
import sys

import pytest
from witness import HEADER, READY

from beetle_omni_ros import cli
from beetle_omni_ros.runs.bag import read_bag


@pytest.mark.parametrize(('fault', 'more', 'named'), [
    ('controller_silent, at: 1', [], 'expected a fault of the robot'),
    ('joints_lost', ['--actuators', 'emulated'], 'expected --actuators direct'),
    ('rotor_stops', [], "'rotor' is missing")])
def test_what_this_flight_cannot_make_fail_is_refused(capsys, tmp_path, fault, more, named):
    file = tmp_path / 'faults.yaml'
    file.write_text(f'faults: [{{what: {fault}}}]\n')
    assert cli.main(['fly', '--bag', str(tmp_path / 'bag'), '--faults', str(file), *more]) == 2
    line, = capsys.readouterr().err.splitlines()
    assert named in line and not (tmp_path / 'bag').exists()


def test_a_fault_strikes_so_long_after_the_task_began(tmp_path):
    (tmp_path / 'poses.csv').write_text(HEADER + '0,0,1,0,0,0\n')
    (tmp_path / 'faults.yaml').write_text(
        'faults: [{what: rotor_half, at: 100}, {what: mocap_lost, at: 3, duration: 0.3}]\n')
    environment = {**os.environ, 'COLUMNS': '200'}
    environment.pop('ROS_DOMAIN_ID', None)
    done = subprocess.run(
        [sys.executable, '-m', 'beetle_omni_ros.start', 'beetle_omni', 'fly', '--clock',
         'simulated', '--task', 'poses.csv', '--faults', 'faults.yaml', '--bag', 'bag', '--alone'],
        cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=READY, check=False)
    assert done.returncode == 0, done.stderr
    log = read_bag(tmp_path / 'bag')
    assert log.meta['faults'][1] == 'mocap_lost at 3 s for 0.3 s'
    begin = log.targets[0].stamp
    late = log.mocap_t[(log.mocap_t > begin) & (log.mocap_t < begin + 7)]
    gap = (late[1:] - late[:-1]).argmax()
    assert late[gap + 1] - late[gap] == pytest.approx(0.3, abs=0.03)
    assert late[gap] - begin == pytest.approx(3.0, abs=0.3)
