"""`beetle_omni gap` from bags to verdict, JSON, page and robot file."""

from dataclasses import replace
from io import StringIO
import json
from pathlib import Path
import re
import runpy
import shutil
import sys

from flown_once import flight, WIND
import numpy as np
import pytest
from rich.console import Console

from beetle_omni_ros import cli
from beetle_omni_ros.bags.bag import read_messages
from beetle_omni_ros.bags.bag_writer import BagWriter
from beetle_omni_ros.identify.flights import command
from beetle_omni_ros.identify.flights.command import gap_results
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.model.schema import ParameterError

EXAMPLE = Path(__file__).parents[2] / 'examples' / 'gap_two_bags.py'
TRUE = np.array(WIND)


def quiet():
    return Console(file=StringIO(), width=120)


@pytest.fixture(scope='module')
def made(tmp_path_factory):
    """Results of two flights in a wind that is not in the robot file."""
    folder = tmp_path_factory.mktemp('gap')
    console = quiet()
    results = gap_results([flight('windy_0')], [flight('windy_1')], apply=folder / 'new.yaml',
                          json_path=folder / 'gap.json', page=folder / 'gap.html',
                          console=console)
    return folder, results, console.file.getvalue()


def test_the_hidden_wind_is_named_with_its_size_and_closes_the_held_out_gap(made):
    results = json.loads((made[0] / 'gap.json').read_text())
    effect, = results['effects']
    assert 'wind' in effect['names']
    force = effect['parameters']['force']
    assert np.allclose(force['value'][:2], TRUE[:2], atol=0.1)
    assert all(low < high for low, high in force['interval'])
    assert force['unit'] == 'N'
    assert results['held_out'] and results['gap_after'] < results['gap_before']
    assert results['closure'] > 0.8
    assert results['false_alarm_probability'] < 1e-3


def test_the_example_prints_the_result_of_its_two_bags(made, monkeypatch, capsys):
    asked, bags = [], [flight('windy_0'), flight('windy_1')]
    monkeypatch.setattr(command, 'gap_results',
                        lambda runs, holdout, *more, **_: asked.extend([runs, holdout]) or made[1])
    monkeypatch.setattr(sys, 'argv', [str(EXAMPLE), *map(str, bags)])
    runpy.run_path(str(EXAMPLE), run_name='__main__')
    assert asked == [bags[:1], bags[1:]]
    assert re.match(r'named: gap [\d.]+ before, [\d.]+ after.*\nwind', capsys.readouterr().out)


def test_the_json_has_the_fixed_keys(made):
    results = json.loads((made[0] / 'gap.json').read_text())
    for key in ('verdict', 'effects', 'where', 'gap_before', 'gap_after', 'noise_floor',
                'closure', 'candidates', 'next_experiment', 'groups', 'false_alarm_probability'):
        assert key in results
    assert all(group['used'] for group in results['groups'].values())
    assert {'channel', 'regime', 'excess'} <= set(results['where'][0])
    assert {'flight', 'rotate', 'tilted'} <= {row['regime'] for row in results['where']}
    names = {row['name'] for row in results['candidates']}
    assert {'wind', 'mass', 'rotor_drag', 'joint_command_latency'} <= names
    assert 'ln_bayes_factor' in results['effects'][0]['evidence']


def test_page_terminal_and_the_new_robot_file_state_the_wind(made):
    folder, _, printed = made
    robot = RobotParameters.load(folder / 'new.yaml')
    assert np.allclose(robot.effects['wind']['force'][:2], TRUE[:2], atol=0.1)
    assert replace(robot, effects={}).hash() == RobotParameters.load().hash()
    assert robot.provenance['runs'] and robot.provenance['date']
    page = (folder / 'gap.html').read_text()
    assert 'wind' in printed and 'wind' in page
    assert '<img' in page and 'src="http' not in page


def copied(source, folder, keep=lambda message: True, change=bytes):
    """A bag with some messages of another, with changed bytes."""
    with BagWriter(folder) as bag:
        for message in read_messages(flight(source)):
            if keep(message):
                bag.write_raw(message.topic, message.type, change(message.data), message.received)
    return folder


def test_a_recording_of_another_robot_with_the_same_sensors_is_refused(tmp_path, capsys):
    # names of the same length keep the layout
    other = copied('windy_0', tmp_path / 'other', change=lambda data: bytes(data).replace(
        b'gimbal', b'swivel').replace(b'rotor', b'motor'))
    assert cli.main(['gap', str(other)]) == 2
    error = capsys.readouterr().err
    assert 'no recording of this robot' in error and 'swivel1' in error and 'gimbal1' in error


def test_the_same_recording_twice_is_refused_under_any_name(tmp_path, capsys):
    first = flight('windy_0')
    (tmp_path / 'link').symlink_to(first)
    shutil.copytree(first, tmp_path / 'copy')
    for other in (first, tmp_path / 'link', tmp_path / 'copy'):
        assert cli.main(['gap', str(first), '--holdout', str(other)]) == 2
        error = capsys.readouterr().err
        assert 'the same recording twice' in error and str(other) in error


def test_a_part_of_a_fitted_flight_is_refused_as_held_out_flight(tmp_path, capsys):
    part = copied('windy_0', tmp_path / 'part', lambda message: message.received > 2.0)
    assert cli.main(['gap', str(flight('windy_0')), '--holdout', str(part)]) == 2
    assert 'the same flight in two recordings' in capsys.readouterr().err


def test_a_damaged_held_out_flight_gives_bad_data(tmp_path, capsys):
    damaged = copied('windy_1', tmp_path / 'damaged',
                     lambda message: not message.topic.endswith('imu/data_raw'))
    assert cli.main([str(a) for a in (
        'gap', flight('windy_0'), '--holdout', damaged, '--json', tmp_path / 'gap.json',
        '--report', tmp_path / 'gap.html')]) == 3
    results = json.loads((tmp_path / 'gap.json').read_text())
    assert results['verdict'] == 'bad_data'
    assert results['effects'] == [] and results['closure'] is None
    row, = results['bad_data']
    assert (row['run'], row['topic']) == ('damaged', 'imu/data_raw')
    assert 'damaged' in results['summary']
    assert ' '.join(capsys.readouterr().out.split()).count(results['summary']) == 1
    page = (tmp_path / 'gap.html').read_text()
    assert 'bad data' in page and page.index('class="said"') < page.index('<img')


def test_the_base_file_is_not_overwritten(tmp_path):
    (tmp_path / 'mine.yaml').write_text('extends: robot.yaml\n')
    with pytest.raises(ParameterError, match='extends'):
        gap_results([tmp_path], robot=tmp_path / 'mine.yaml', apply=tmp_path / 'mine.yaml',
                    console=quiet())
