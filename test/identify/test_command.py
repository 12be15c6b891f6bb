"""`beetle_omni identify` from the command line."""

from dataclasses import replace
import json

import numpy as np
import pytest
from rotor_logs import bench
from rotor_logs import write as write_bench
from servo_logs import log_of, sweep, write

from beetle_omni_ros import cli
from beetle_omni_ros.model.parameters import RobotParameters

SERVOS = [{'coulomb': 0.012}, {'coulomb': 0.02}]


@pytest.fixture(scope='module')
def logs(tmp_path_factory):
    """Paths of a slow log and of two fast ones."""
    folder = tmp_path_factory.mktemp('logs')
    fast = sweep(3.0, periods=(0.4, 0.6), amplitudes=(0.3, 0.5))
    return [write(folder / 'slow.csv', log_of(*sweep(3.0, periods=(0.8, 1.0)), SERVOS, seed=1)),
            write(folder / 'fast.csv', log_of(*fast, SERVOS, seed=2)),
            write(folder / 'first.csv', log_of(*fast, SERVOS[:1], seed=3))]


def test_joint_writes_all_its_files(logs, tmp_path, capsys):
    slow, fast, first = logs
    json_path, page, params = (tmp_path / name for name in ('r.json', 'r.html', 'robot.yaml'))
    assert cli.main([str(a) for a in (
        'identify', 'joint', slow, '--validate', fast, first, '--json', json_path, '--report',
        page, '--params', params)]) == 0
    shown = capsys.readouterr().out
    assert 'held-out' in shown and 'coulomb_friction' in shown
    joints = json.loads(json_path.read_text())['joints']
    assert [joint['joint'] for joint in joints] == [1, 2]
    for joint in joints:
        assert joint['heldout_rms_rad'] < joint['published_rms_rad'] / 5
        assert len(joint['validation_rms_rad']) == 2
        for term in joint['terms'].values():
            assert set(term) == {'value', 'unit', 'interval', 'kept'}
            assert len(term['interval']) == 2
    assert joints[1]['validation_rms_rad'][1] is None       # the other log has only joint 1
    assert page.read_text().count('<img') == 3
    written = RobotParameters.load(params).joints
    assert written.natural_frequency == pytest.approx(
        np.median([joint['terms']['natural_frequency']['value'] for joint in joints]), rel=0.05)


def test_logs_of_different_joints_make_one_file(logs, tmp_path, capsys):
    first, page, params = logs[2], tmp_path / 'r.html', tmp_path / 'robot.yaml'
    made = log_of(*sweep(3.0, periods=(0.4, 0.6), amplitudes=(0.3, 0.5)), SERVOS[1:], seed=4)
    third = write(tmp_path / 'third.csv', replace(made, joints=(3,)))
    assert cli.main([str(a) for a in ('identify', 'robot', first, third, '--params', params)]) == 0
    assert 'joint 3' in capsys.readouterr().out
    bands = RobotParameters.load(params).effects['joint_friction']['coulomb']
    assert bands[2] > 1.3 * bands[0] and bands[1] == bands[3] == pytest.approx(
        (bands[0] + bands[2]) / 2, rel=1e-3)
    assert cli.main([str(a) for a in ('identify', 'joint', first, '--validate', third,
                                      '--report', page)]) == 0
    assert 'absent' in capsys.readouterr().out and page.read_text().count('<img') == 1


def test_rotor_writes_all_its_files(tmp_path, capsys):
    log = write_bench(tmp_path / 'bench.csv', bench(np.random.default_rng(0)))
    json_path, page, params = (tmp_path / name for name in ('r.json', 'r.html', 'robot.yaml'))
    assert cli.main([str(a) for a in ('identify', 'rotor', log, '--json', json_path, '--report',
                                      page, '--params', params)]) == 0
    assert 'torque to thrust ratio' in capsys.readouterr().out
    results = json.loads(json_path.read_text())
    assert len(results['plateaus']) == 5
    assert page.read_text().count('<img') == 2
    assert len(RobotParameters.load(params).rotors.map) == 5
