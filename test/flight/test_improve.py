"""A corrected robot file beside the file before, flown by controllers."""

import json

import numpy as np
import pytest
from typer.testing import CliRunner

from beetle_omni_ros.cli import app
from beetle_omni_ros.flight.experiment import compared, conclusions, ERRORS, is_worse


def poses(values, reached=True):
    return [{'reached': reached, **dict.fromkeys(ERRORS, value)} for value in values]


def test_an_error_is_worse_if_its_increase_is_certain():
    before = list(np.random.default_rng(0).uniform(1.0, 3.0, 30))
    assert is_worse(before, [1.2 * value for value in before])
    assert not is_worse(before, [1.04 * value for value in before])
    assert not is_worse(before, before[1:] + before[:1])    # noise of equal size
    assert is_worse(before, [None] * 30)


def test_lost_poses_and_larger_errors_keep_the_file_before():
    same, larger = poses([1.0, 2.0, 3.0]), poses([1.3, 2.6, 3.9])
    results = {'a': compared({'before': larger, 'after': same}),
               'b': compared({'before': same, 'after': larger}),
               'c': compared({'before': same, 'after': poses([1.0, 2.0, 3.0], False)})}
    assert [results[name]['better'] for name in 'abc'] == [True, False, False]
    assert results['a']['ratio']['U_position_m'] == pytest.approx(1 / 1.3)
    better, worse, lost = conclusions(results)
    assert better.startswith('a flies better')
    assert 'L orientation are more than 5 % larger' in worse and '3 more poses' in lost


@pytest.mark.parametrize('verdict', ['named', 'no_gap'])
def test_the_command_flies_both_files_after_a_named_effect_alone(tmp_path, monkeypatch, verdict):
    corrected = 'extends: robot.yaml\neffects: {rotor_lag: {time_constant: 0.14}}\n'

    def results(runs, holdout, robot, apply, *_, **__):
        apply.write_text(corrected)
        return {'verdict': verdict, 'summary': 'Rotor lag of 0.14 s.',
                'effects': ['rotor_lag'] * (verdict == 'named')}

    monkeypatch.setattr('beetle_omni_ros.identify.flights.command.gap_results', results)
    (tmp_path / 'poses.csv').write_text(
        'x_m,y_m,z_m,roll_deg,pitch_deg,yaw_deg\n0.3,0,1,20,0,0\n')
    command = ['improve', 'flight', '--output', str(tmp_path / 'made'), '--controllers', 'rl',
               '--task', str(tmp_path / 'poses.csv'), '--flights', '1', '--jobs', '1']
    shown = CliRunner().invoke(app, command)
    assert shown.exit_code == 0, shown.output
    made = json.loads((tmp_path / 'made' / 'improve.json').read_text())
    if verdict == 'no_gap':
        assert made['controllers'] == {} and 'nothing to fly' in shown.output
        assert not (tmp_path / 'made' / 'robot.yaml').exists()      # that of an earlier run
        return
    assert made['controllers']['rl']['ratio']['U_position_m'] < 0.5
    assert made['controllers']['rl']['after']['reached'] == 1
    assert 'rl flies better' in (tmp_path / 'made' / 'improve.html').read_text()
    kept = sorted((tmp_path / 'made' / 'flights').iterdir())
    times = [path.stat().st_mtime_ns for path in kept]
    assert CliRunner().invoke(app, command).exit_code == 0      # continues: nothing is flown
    assert [path.stat().st_mtime_ns for path in kept] == times
