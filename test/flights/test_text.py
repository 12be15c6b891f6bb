"""Verdicts as sentences, tables and a page."""

from beetle_omni_ros.identify.flights.page import grids, headline, seen
from beetle_omni_ros.identify.flights.picture import gap_page
from beetle_omni_ros.identify.flights.results import result_of

SIZE = {'value': 0.4, 'interval': [0.36, 0.44], 'unit': 'N s/m', 'file': 0.0, 'typical': 0.4}
DRAG = {'names': ['rotor_drag'], 'parameters': {'coefficient': SIZE},
        'evidence': {'ln_bayes_factor': 40.0}}
EITHER = {'names': ['mass', 'thrust_coefficient'], 'evidence': DRAG['evidence'], 'parameters': {
    'mass': {'value': 3.3, 'interval': [3.2, 3.5], 'unit': 'kg', 'file': 3.0, 'typical': 0.3}},
    'rivals': [{'name': 'thrust_coefficient', 'parameters': {'scale': {
        'value': 0.91, 'interval': [0.9, 0.92], 'unit': '1', 'file': 1.0, 'typical': 0.05}}}]}
GROUPS = {'force': {'used': True, 'channels': ['force_x', 'force_z']},
          'joint': {'used': False, 'channels': [], 'reason': 'the rotors do not tilt'}}
WHERE = [{'channel': 'force_x', 'regime': 'flight', 'excess': 3.0, 'excess_after': 1.1,
          'rms': 0.3, 'rms_after': 0.1, 'discrepancy_rms': 0.01, 'unit': 'm/s^2'}]


def candidate(name):
    return {'name': name, 'accepted': False, 'reason': '', 'evidence': {'ln_bayes_factor': -2.0},
            'seen_from': {'value': 0.2, 'typical': 0.1, 'unit': 'N'}}


def page(result):
    result['meta'] |= {'runs': ['a'], 'holdout': [], 'robot': 'params/robot.yaml', 'alpha': 0.05}
    return gap_page(result)


def test_a_named_effect_is_told_with_size_file_closure_and_false_alarm():
    result = result_of('named', GROUPS, effects=[DRAG], where=WHERE, gap_before=3.0,
                       gap_after=1.1, closure=0.97, held_out=True, false_alarm_probability=0.002)
    assert headline(result) == 'named: rotor_drag'
    assert result['summary'] == (
        'Rotor drag of 0.4 +- 0.04 N s/m (robot file: none) explains the disagreement. Adding it '
        'closes 97% of the gap on the held-out flights. The probability of a false alarm is '
        '0.002.')
    text = page(result)
    for word in (result['summary'], 'the rotors do not tilt', 'force_x', '<img'):
        assert word in text


def test_members_of_a_set_have_sizes_and_an_experiment_separates_them():
    result = result_of('named_set', GROUPS, effects=[EITHER], false_alarm_probability=1e-9)
    assert 'below 1e-06' in result['summary'] and 'weigh the robot' in result['next_experiment']
    cells = [cell for grid in grids(result) for row in grid.rows for cell in row]
    assert 'or thrust_coefficient' in cells and '0.91' in cells


def test_members_are_told_with_the_numbers_of_their_rotors():
    scale = {'value': 0.7, 'interval': [0.63, 0.77], 'unit': '1', 'file': 1.0, 'typical': 0.05}
    members = ['rotor_thrust_coefficient[3]', 'rotor_thrust_coefficient[1]']
    result = result_of('named_set', GROUPS, effects=[{
        'names': ['rotor_thrust_coefficient'], 'members': members, 'rotor': 3,
        'parameters': {'scale': scale}, 'evidence': {'ln_bayes_factor': 10.0}}])
    assert headline(result) == f'one of a set: {members[0]} or {members[1]}'
    assert result['summary'].startswith(
        'Rotor thrust coefficient[3] or rotor thrust coefficient[1] of 0.7 +- 0.07')


def test_flights_that_show_less_than_half_of_the_catalogue_decide_nothing():
    some = [candidate(name) for name in ('mass', 'wind', 'rotor_drag')]
    shown = result_of('no_gap', GROUPS, candidates=some, hidden=['mass'])
    assert shown['verdict'] == 'no_gap' and 'would be: mass below 0.2 N.' in shown['summary']
    unseen = result_of('no_gap', GROUPS, candidates=some, hidden=['mass', 'wind'])
    assert unseen['verdict'] == 'not_decidable' and unseen['next_experiment']
    assert 'cannot decide: most known effects' in unseen['summary']


def test_the_least_visible_effects_come_first_with_the_size_from_which_they_are_seen():
    rows = [{'name': name, 'seen_from': {'value': value, 'typical': typical, 'unit': unit}}
            for name, value, typical, unit in (
                ('joint_velocity_limit', 9.3, None, 'rad/s'), ('mass', 4.0, 5.0, '%'),
                ('joint_torque_limit', None, None, 'N m'), ('joint_offset', 0.3, 0.1, 'rad'),
                ('joint_offset', 0.05, 0.1, 'rad'), ('tilt_thrust_loss', 0.12, 0.06, '1'))]
    assert seen(rows).rows == [
        ['joint torque limit', 'not by these flights', ''], ['tilt thrust loss', '0.12', '0.06'],
        ['mass', '4 %', '5 %'], ['joint offset', '0.05 rad', '0.1 rad'],
        ['joint velocity limit', '9.3 rad/s', '']]


def test_partial_effects_of_an_undecided_verdict_are_listed_and_not_named():
    result = result_of('not_decidable', GROUPS, 'they do not separate mass or thrust',
                       partial=[EITHER])
    assert headline(result) == 'not decidable'
    assert result['summary'] == 'These data cannot decide: they do not separate mass or thrust.'
    assert any(grid.title.startswith('Partial') for grid in grids(result))
    unknown = result_of('unknown', GROUPS, 'force_x has a rhythm', partial=[DRAG])
    assert 'Rotor drag would explain a part' in unknown['summary'] and 'unknown' in page(unknown)
