"""One call of `fly` with a user's controller in the whole graph and a fault."""

import json
import os
from pathlib import Path
import subprocess
import sys

import pytest
from witness import HEADER, READY

from beetle_omni_ros.control import registry
from beetle_omni_ros.runs.bag import read_bag

pytestmark = pytest.mark.simulated_time
OWN = f"{Path(__file__).resolve().parents[2] / 'examples' / 'own_controller.py'}:PoseController"
FAULTS = 'faults: [{what: rotor_half, at: 100}, {what: mocap_lost, at: 3, duration: 0.3}]\n'


@pytest.fixture(scope='module')
def flown(tmp_path_factory):
    """Results and log of a flight: one pose, a controller from a file, MoCap lost shortly."""
    folder = tmp_path_factory.mktemp('flown')
    (folder / 'poses.csv').write_text(HEADER + '0.3,0,1,20,0,30\n')
    (folder / 'faults.yaml').write_text(FAULTS)
    environment = {**os.environ, 'COLUMNS': '200'}
    environment.pop('ROS_DOMAIN_ID', None)
    done = subprocess.run(
        [sys.executable, '-m', 'beetle_omni_ros.start', 'beetle_omni', 'fly', '--controller', OWN,
         '--task', 'poses.csv', '--clock', 'simulated', '--faults', 'faults.yaml', '--bag', 'bag',
         '--json', 'result.json'],
        cwd=folder, env=environment, capture_output=True, text=True, timeout=READY, check=False)
    assert done.returncode == 0, done.stderr
    return json.loads((folder / 'result.json').read_text()), read_bag(folder / 'bag')


def test_a_class_of_a_file_flies_the_whole_graph_and_is_read_back(flown):
    results, log = flown
    assert results['pose_controller']['success_rate'] == 1.0
    assert results['pose_controller']['guidance'] == 'none'
    assert results['pose_controller']['compute_ms']['median'] > 0
    assert 'flying:pose_controller' in log.states and not log.warnings
    assert set(log.requests) == {'pose_controller', *registry.standing_by()}


def test_a_fault_strikes_so_long_after_the_task_began(flown):
    _, log = flown
    assert log.meta['faults'][1] == 'mocap_lost at 3 s for 0.3 s'
    begin = log.targets[0].stamp
    late = log.mocap_t[(log.mocap_t > begin) & (log.mocap_t < begin + 7)]
    gap = (late[1:] - late[:-1]).argmax()
    assert late[gap + 1] - late[gap] == pytest.approx(0.3, abs=0.03)
    assert late[gap] - begin == pytest.approx(3.0, abs=0.3)
