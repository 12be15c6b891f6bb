"""`gap --learn`: a force that no candidate explains becomes a formula, and a null flight none."""

from dataclasses import replace
from io import StringIO
import json
from pathlib import Path

from flights import P, ROBOT
from flown_once import flight, WIND
import numpy as np
import pytest
from rich.console import Console
import yaml

from beetle_omni_ros.identify.flights import engine
from beetle_omni_ros.identify.flights.bag_flight import BagFlight
from beetle_omni_ros.identify.flights.body import BodyModel
from beetle_omni_ros.identify.flights.command import gap_results
from beetle_omni_ros.identify.flights.keys import all_keys, extra_keys
from beetle_omni_ros.identify.flights.learn import learned
from beetle_omni_ros.identify.flights.verdict import judged
from beetle_omni_ros.identify.recording.bag import read_recording
from beetle_omni_ros.identify.recording.flight import prepare
from beetle_omni_ros.model.formula import library
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.model.schema import ParameterError


@pytest.fixture(scope='module')
def made(tmp_path_factory):
    """Results of two flights in a wind that is no candidate."""
    folder, console = tmp_path_factory.mktemp('learn'), Console(file=StringIO(), width=160)
    (folder / 'without.yaml').write_text('without: [wind]\n')
    result = gap_results([flight('windy_0')], [flight('windy_1')], console=console,
                         parameters=folder / 'without.yaml', apply=folder / 'corrected.yaml',
                         learn=folder / 'effect.yaml', page=folder / 'gap.html',
                         json_path=folder / 'gap.json')
    return folder, result, console.file.getvalue()


def test_a_force_outside_the_candidates_is_found_with_its_size(made):
    folder, result, printed = made
    effect = yaml.safe_load((folder / 'effect.yaml').read_text())
    found = dict(zip(effect['expressions'], effect['coefficients'], strict=True))
    assert found.keys() == {'force: world_x', 'force: world_y'}
    assert np.allclose([found['force: world_x'], found['force: world_y']], WIND[:2], atol=0.15)
    for value, (low, high) in zip(effect['coefficients'], effect['intervals'], strict=True):
        assert low < value < high
    assert effect['units'] == ['N', 'N'] and effect['source']['runs'] == [str(flight('windy_0'))]
    assert result['verdict'] == 'named' and result['formula']['closure'] > 0.9
    assert result['gap_after'] < result['gap_before']
    page = (folder / 'gap.html').read_text()
    assert 'F += k X' in printed and 'F += k X' in page and 'src="http' not in page


def test_the_json_has_the_fixed_keys(made):
    results = json.loads((made[0] / 'gap.json').read_text())
    for key in ('verdict', 'effects', 'where', 'gap_before', 'gap_after', 'noise_floor',
                'closure', 'candidates', 'next_experiment', 'groups', 'false_alarm_probability'):
        assert key in results
    assert results['held_out'] and all(group['used'] for group in results['groups'].values())
    assert {'channel', 'regime', 'excess'} <= set(results['where'][0])
    assert {'flight', 'rotate', 'tilted'} <= {row['regime'] for row in results['where']}
    names = {row['name'] for row in results['candidates']}
    assert {'mass', 'rotor_drag', 'joint_command_latency'} <= names and 'wind' not in names


def residual(robot, path):
    """RMS of the specific forces [m/s^2] that a robot file leaves of a flight."""
    keys = {**all_keys(robot), **extra_keys(robot)}
    own = prepare(read_recording(path), robot, P, False)
    made = BagFlight(own, robot, BodyModel(robot, keys, (0.0, 0.0)), keys, P)
    return made.residual({}, 'B')['B'][made.mask[:, 0], :3].std()


def test_the_written_files_explain_another_flight(made):
    file = made[0] / 'robot_new.yaml'
    file.write_text('extends: robot.yaml\neffects: {formula: effect.yaml}\n')
    before, learned_effect, corrected = (residual(replace(robot, multibody=None), flight(
        'windy_1')) for robot in (ROBOT, RobotParameters.load(file),
                                  RobotParameters.load(made[0] / 'corrected.yaml')))
    assert learned_effect < 0.6 * before and corrected < 0.6 * before
    new = RobotParameters.load(made[0] / 'corrected.yaml')
    assert replace(new, effects={}).hash() == RobotParameters.load().hash()
    assert new.provenance['runs'] and new.provenance['date']


def test_flights_that_the_robot_file_explains_have_no_formula():
    robot = replace(ROBOT, effects={'wind': {'force': WIND}})
    recordings = [prepare(replace(read_recording(Path(flight(name))), name=name), robot, P, False)
                  for name in ('windy_0', 'windy_1')]
    result = learned(lambda robot, then: judged(
        recordings[:1], recordings[1:], robot, P, then=then), robot, {
        'held_out': True, 'findings': [], 'candidates': [],
        'groups': {'torque': {'used': True}, 'joint': {'used': True}}})
    assert result['formula'] == {
        'reason': f'none of {len(library())} terms has enough evidence beside the catalogue'}
    assert result['findings'] == [f"No formula: {result['formula']['reason']}"]


def test_a_set_that_replaces_another_is_linearised_at_its_own_values(monkeypatch):
    own, found = replace(ROBOT, effects={'wind': {'force': WIND},
                                         'thrust_coefficient': {'scale': 1.5}}), {}
    recordings = [prepare(read_recording(flight('windy_0')), own, P, False)]
    monkeypatch.setattr(engine, 'MOST_ROUNDS', 1)

    def then(weighed, *_):
        made, solution = weighed.engine, weighed.solution
        entry = next(k for k, e in enumerate(made.entries) if e.name == 'thrust_coefficient')
        for key, each in (('before', solution), ('after', made.again(solution, (entry,)))):
            found[key] = 1.5 * np.exp(each.theta[made.index['thrust_coefficient.scale']])
        return {}
    judged(recordings, [], own, P, then=then)
    assert abs(found['before'] - 1) > 0.05 and found['after'] == pytest.approx(1.0, abs=0.02)


def test_nothing_is_learned_without_a_held_out_flight_or_beside_a_formula():
    result = learned(None, ROBOT, {'held_out': False, 'findings': []})
    assert 'no flight is held out' in result['findings'][0]
    robot = replace(ROBOT, effects={'formula': {'expressions': ('force: velocity',),
                                                'coefficients': (0.1,)}})
    with pytest.raises(ParameterError, match='without the effect formula'):
        learned(None, robot, {'held_out': True})
