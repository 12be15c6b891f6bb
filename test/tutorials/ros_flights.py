"""Files that a tutorial's flight of the whole graph needs in the test, and checks of its bag."""

import json
import shutil

import pytest

from beetle_omni_ros.bags.bag import read_bag
from beetle_omni_ros.control import registry
from beetle_omni_ros.model.resources import share_path

FAULTS = 'faults: {after: {strike: [{kind: rotor_weak, rotor: 1, share: 0.5, at: 100}]}, ' \
    'within: {strike: [{kind: mocap_lost, at: 3, duration: 0.3}]}}\n'


def write_faults(folder):
    """Write a list of faults: one after the flight, and one in the task."""
    (folder / 'faults.yaml').write_text(FAULTS)


def check_own_controller(folder):
    """A user's controller flies in the graph, is read back, and a fault acts at its time."""
    results = json.loads((folder / 'flown.json').read_text())
    assert set(results) == {'meta', 'mine'}
    assert results['mine']['success_rate'] == 1.0 and results['mine']['guidance'] == 'none'
    assert results['mine']['compute_ms']['median'] > 0
    log = read_bag(folder / 'flown')
    assert 'flying:mine' in log.states and not log.warnings
    assert set(log.requests) == {'mine', *registry.STANDING_BY}

    assert log.meta['faults'][1] == 'mocap_lost at=3 duration=0.3'
    begin = log.targets[0].stamp
    late = log.mocap.t[(log.mocap.t > begin) & (log.mocap.t < begin + 7)]
    gap = (late[1:] - late[:-1]).argmax()
    assert late[gap + 1] - late[gap] == pytest.approx(0.3, abs=0.03)
    assert late[gap] - begin == pytest.approx(3.0, abs=0.3)


def write_policy(folder):
    """Copy a shipped policy under another name."""
    shutil.copy(share_path('policies/rl_any.onnx'), folder / 'hover.onnx')


def check_policy(folder):
    """A policy from a file flies, and the bag has the commands of both controllers."""
    results = json.loads((folder / 'flown.json').read_text())
    assert set(results) == {'meta', 'rl'} and not results['rl']['crashed']
    assert results['rl']['poses'][0]['U_position_m'] < 0.5
    log = read_bag(folder / 'emulated')
    assert 'flying:rl' in log.states and 'flying:nmpc' not in log.states
    for name in ('nmpc', 'rl'):     # 8 s at 100 Hz; the climb compensates skipped steps
        assert len(log.requests[name].t) > 800
        assert log.compute[name]['count'] > 800


# Page -> (preparation, check), both of the reader's folder.
FLIGHTS = {'own_controller': (write_faults, check_own_controller),
           'hardware_flight': (write_policy, check_policy)}
