"""`beetle_omni gap` from bags to verdict, JSON, page and robot file."""

from dataclasses import replace
from io import StringIO
import json
import shutil
import sys

from flown_once import flight, hover, TWO_POSES, WIND
import numpy as np
import pytest
from rich.console import Console

from beetle_omni_ros import cli
from beetle_omni_ros.identify.gap import workers
from beetle_omni_ros.identify.gap.command import gap_results, run_gap
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.robot.schema import ParameterError
from beetle_omni_ros.runs.bag import read_messages
from beetle_omni_ros.runs.bag_writer import BagWriter

TRUE = np.array(WIND)


def quiet():
    return Console(file=StringIO(), width=120)


@pytest.fixture(scope='module')
def made(tmp_path_factory):
    """Results of two short flights in a wind that is not in the robot file."""
    folder = tmp_path_factory.mktemp('gap')
    console = quiet()
    results = gap_results([flight('windy_0')], [flight('windy_1')], apply=folder / 'new.yaml',
                          json_path=folder / 'gap.json', page=folder / 'gap.html',
                          console=console)
    return folder, results, console.file.getvalue()


def test_the_hidden_wind_is_named_with_its_size(made):
    effect, = made[1]['effects']
    assert 'wind' in effect['names']
    force = effect['parameters']['force']
    assert np.allclose(force['value'][:2], TRUE[:2], atol=0.1)
    assert all(low < high for low, high in force['interval'])
    assert force['unit'] == 'N'


@pytest.mark.skipif(sys.platform != 'linux', reason='forks on Linux only')
def test_two_cores_give_the_same_result_as_one(made, monkeypatch):
    _, results, _ = made
    monkeypatch.setattr(workers, 'width', lambda: 2)
    again = gap_results([flight('windy_0')], [flight('windy_1')], console=quiet())
    for name in results.keys() - {'meta'}:
        assert again[name] == results[name], name


def test_the_held_out_gap_shrinks_and_a_placebo_does_not_shrink_it(made):
    results = made[1]
    assert results['held_out'] and results['gap_after'] < results['gap_before']
    assert results['closure'] > 0.8
    assert results['horizons']['0.5 s']['placebo'] > results['gap_before']


def test_an_effect_that_worsens_held_out_flights_is_not_named():
    # another day: no wind
    results = gap_results([flight('windy_0')], [flight('calm')], console=quiet())
    assert results['verdict'] == 'unknown' and results['effects'] == []
    assert 'wind' in results['reason'] and 'makes the held-out ones worse' in results['reason']
    assert results['gap_after'] == results['gap_before']


def test_an_effect_that_leaves_most_of_a_large_gap_is_not_named(tmp_path):
    hover(tmp_path / 'storm', TWO_POSES, 6 * TRUE, seed=3)
    results = gap_results([flight('windy_0')], [tmp_path / 'storm'], console=quiet())
    assert results['gap_before'] > 10
    assert results['verdict'] == 'unknown' and results['effects'] == []
    assert 'wind' in results['reason'] and 'does not explain most' in results['reason']


def test_the_json_has_the_fixed_keys(made):
    results = json.loads((made[0] / 'gap.json').read_text())
    for key in ('verdict', 'effects', 'where', 'gap_before', 'gap_after', 'noise_floor',
                'closure', 'candidates', 'next_experiment'):
        assert key in results
    assert {'channel', 'regime', 'excess'} <= set(results['where'][0])
    names = {row['name'] for row in results['candidates']}
    assert {'wind', 'mass', 'rotor_drag', 'joint_command_latency'} <= names
    assert {'delta_bic', 'cv_gain_se'} <= set(results['effects'][0]['evidence'])


def test_the_new_robot_file_is_the_old_one_with_the_wind(made):
    robot = RobotParameters.load(made[0] / 'new.yaml')
    assert np.allclose(robot.effects['wind']['force'][:2], TRUE[:2], atol=0.1)
    assert replace(robot, effects={}).hash() == RobotParameters.load().hash()
    assert robot.provenance['runs'] and robot.provenance['date']


def test_page_and_terminal_state_the_finding(made):
    folder, _, printed = made
    page = (folder / 'gap.html').read_text()
    assert 'wind' in printed and 'wind' in page
    assert page.count('<img') >= 2 and 'src="http' not in page


def _bag_of_something_else(folder):
    with BagWriter(folder / 'other', topics=('battery_state',)):
        pass
    return folder / 'other'


@pytest.mark.parametrize(('made', 'words'), [
    (lambda folder: folder / 'none', 'no such bag'),
    (lambda folder: folder, 'no .mcap file'),
    (lambda folder: folder / 'photo.jpg', 'expected a rosbag2 folder'),
    (_bag_of_something_else, 'no recording of this robot')])
def test_a_run_of_another_kind_is_refused_with_one_line_and_status_2(made, words, tmp_path,
                                                                     capsys):
    (tmp_path / 'photo.jpg').write_bytes(b'no bag')
    run = made(tmp_path)
    for arguments in ([run], ['x', '--holdout', run]):
        (tmp_path / 'x').mkdir(exist_ok=True)
        assert cli.main(['gap', *map(str, arguments)]) == 2
        error = capsys.readouterr().err.strip()
        assert len(error.splitlines()) == 1
    assert cli.main(['gap', str(run)]) == 2
    assert words in capsys.readouterr().err


def test_a_recording_of_another_robot_with_the_same_sensors_is_refused(tmp_path, capsys):
    other = tmp_path / 'other'
    with BagWriter(other) as bag:
        for message in read_messages(flight('windy_0')):
            data = bytes(message.data)      # names of the same length keep the layout
            for own, strange in ((b'gimbal', b'swivel'), (b'rotor', b'motor')):
                data = data.replace(own, strange)
            bag.write_raw(message.topic, message.type, data, message.received)
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
    part = tmp_path / 'part'
    with BagWriter(part) as bag:
        for message in read_messages(flight('windy_0')):
            if message.received > 2.0:
                bag.write_raw(message.topic, message.type, message.data, message.received)
    assert cli.main(['gap', str(flight('windy_0')), '--holdout', str(part)]) == 2
    assert 'the same flight in two recordings' in capsys.readouterr().err


def test_a_damaged_held_out_flight_gives_bad_data(tmp_path):
    damaged = tmp_path / 'damaged'
    with BagWriter(damaged) as bag:
        for message in read_messages(flight('windy_1')):
            if not message.topic.endswith('imu/data_raw'):
                bag.write_raw(message.topic, message.type, message.data, message.received)
    console = quiet()
    status = run_gap([flight('windy_0')], [damaged], json_path=tmp_path / 'gap.json',
                     page=tmp_path / 'gap.html', console=console)
    results = json.loads((tmp_path / 'gap.json').read_text())
    assert status == 3 and results['verdict'] == 'bad_data'
    assert results['effects'] == [] and results['closure'] is None
    row, = results['bad_data']
    assert (row['run'], row['topic']) == ('damaged', 'imu/data_raw')
    assert 'damaged' in results['summary']
    assert console.file.getvalue().count(results['summary']) == 1
    page = (tmp_path / 'gap.html').read_text()
    assert 'bad data' in page and page.index('class="said"') < page.index('<img')


def test_each_cause_is_printed_once(tmp_path):
    folders = []
    for k in range(2):
        folders.append(tmp_path / f'damaged{k}')
        with BagWriter(folders[-1]) as bag:
            for message in read_messages(flight(f'windy_{k}')):
                if not message.topic.endswith('imu/data_raw'):
                    bag.write_raw(message.topic, message.type, message.data, message.received)
    console = Console(file=StringIO(), width=300)
    results = gap_results(folders, console=console)
    printed = console.file.getvalue()
    assert [row['run'] for row in results['bad_data']] == ['damaged0', 'damaged1']
    assert printed.count('damaged1') == 1 and results['findings'] == []


def test_the_page_begins_with_verdict_sentence_and_picture(made):
    page = (made[0] / 'gap.html').read_text()
    begin = page.index('class="verdict"')
    assert begin < page.index('class="said"') < page.index('<img') < page.index('<table')
    assert made[1]['summary'][:40] in page


def test_the_sentence_states_size_and_closure(made):
    assert made[1]['summary'].startswith('Wind of 1.2') and '+-' in made[1]['summary']
    assert f'{made[1]["closure"]:.0%}' in made[1]['summary']


def test_tables_explain_their_columns(made):
    for words in ('sign reversed', 'closure: closed share', 'standard deviations'):
        assert words in made[2]
    assert 'placebo' not in made[2]


def test_the_base_file_is_not_overwritten(tmp_path):
    (tmp_path / 'mine.yaml').write_text('extends: robot.yaml\n')
    with pytest.raises(ParameterError, match='extends'):
        run_gap([tmp_path], robot=tmp_path / 'mine.yaml', apply=tmp_path / 'mine.yaml',
                console=quiet())
