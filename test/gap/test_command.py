"""What `beetle_omni gap` refuses; test_learn has its results, the tutorials its named effects."""

from io import StringIO
import json
from pathlib import Path
import runpy
import shutil
import sys

from flown_once import flight
import pytest
from rich.console import Console

from beetle_omni_ros import cli
from beetle_omni_ros.bags.bag import read_messages
from beetle_omni_ros.bags.bag_writer import BagWriter
from beetle_omni_ros.identify.flights import command
from beetle_omni_ros.identify.flights.command import gap_results
from beetle_omni_ros.model.schema import ParameterError

EXAMPLE = Path(__file__).parents[2] / 'examples' / 'gap_two_bags.py'
FOUND = {'verdict': 'named', 'gap_before': 2.0, 'gap_after': 1.1, 'noise_floor': 1.0, 'effects': [
    {'names': ['wind'], 'parameters': {'force': {'value': [1.21, 0.0], 'unit': 'N', 'interval': [
        [1.1, 1.3], [-0.1, 0.1]]}}}]}


def test_the_example_prints_the_result_of_its_two_bags(monkeypatch, capsys):
    asked = []
    monkeypatch.setattr(command, 'gap_results',
                        lambda runs, holdout, *_, **__: asked.extend([runs, holdout]) or FOUND)
    monkeypatch.setattr(sys, 'argv', [str(EXAMPLE), 'a', 'b'])
    runpy.run_path(str(EXAMPLE), run_name='__main__')
    assert asked == [[Path('a')], [Path('b')]]
    assert capsys.readouterr().out.splitlines() == [
        'named: gap 2.00 before, 1.10 after, noise 1.00',
        'wind force [1.21 0.  ] N 95 % within [1.1, 1.3] [-0.1, 0.1]']


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
                    console=Console(file=StringIO()))
