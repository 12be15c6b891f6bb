"""Response logs against a robot file: changes are named, and a corrected file shows no gap."""

from dataclasses import replace
import json
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from servo_logs import log_of, servo, sweep, write

from beetle_omni_ros import cli
from beetle_omni_ros.identify.gap.apply import effects_with
from beetle_omni_ros.identify.gap.joint_changes import changes, line
from beetle_omni_ros.identify.gap.joint_gap import analyse_joint_log, gap_of
from beetle_omni_ros.identify.gap.joint_search import Search
from beetle_omni_ros.identify.gap.keys import all_keys
from beetle_omni_ros.identify.gap.keys import friction as friction_of
from beetle_omni_ros.identify.inference.noise import Noise
from beetle_omni_ros.identify.servo.log import JointLog, read_joint_log
from beetle_omni_ros.identify.joint_servos import file_sets, Servos
from beetle_omni_ros.identify.servo_fit import Problems, ServoFitter
from beetle_omni_ros.identify.servo.model import INDEX, simulate
from beetle_omni_ros.robot import dynamics
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.robot.schema import ParameterError

REAL = Path(__file__).resolve().parents[3] / 'shared' / 'data' / 'joint_response_100Hz.csv'
SHIPPED = RobotParameters.load()
INERTIA = SHIPPED.joints.inertia
BANDS = (0.013, 0.035)      # [rad]
FREQUENCY, DAMPING, DELAY = 47.0, 0.63, 0.015
T, COMMAND = sweep(6.0, periods=(0.9, 1.4))


def stiffness(frequency=FREQUENCY):
    return INERTIA * frequency**2


def robot(**effects):
    """Robot file with the servos of ``made`` and further effects."""
    kp = stiffness()
    torque = tuple(kp * band for band in (*BANDS, 0.0, 0.0))
    own = {'joint_bandwidth': {'kp': kp, 'kd': 2 * DAMPING * FREQUENCY * INERTIA},
           'joint_friction': {'coulomb': torque, 'stiction': torque},
           'joint_command_latency': {'delay': DELAY}}
    return replace(SHIPPED, effects={**own, **effects})


def made(seed, *changed, **both):
    """Log of two joints by an independent simulation; ``changed``: of each, ``both``: of both."""
    changed = changed or ({}, {})
    return log_of(T, COMMAND, [{'frequency': FREQUENCY, 'damping': DAMPING, 'delay': DELAY,
                                'coulomb': band, **both, **own}
                               for band, own in zip(BANDS, changed, strict=True)], seed)


def judged(log, file_robot=None):
    return gap_of(Search(log, file_robot or robot()).run(), log)


def corrected(file_robot, result):
    effects = effects_with(file_robot, result['effects'])
    return replace(file_robot, effects={
        name: {key: tuple(v) if isinstance(v, list) else v for key, v in values.items()}
        for name, values in effects.items()})


def names(result):
    return [(effect['names'], effect.get('joint')) for effect in result['effects']]


@pytest.fixture(scope='module')
def against_shipped():
    """A log and its results against the shipped file."""
    log = made(1)
    return log, judged(log, SHIPPED)


def test_servos_of_the_robot_file_agree_with_a_plain_simulation():
    file_robot = robot(joint_offset={'offset': (0.02, -0.01, 0.0, 0.0)},
                       joint_backlash={'gap': 0.024}, joint_feedback_delay={'delay': 0.006})
    shown = np.array([servo(T, COMMAND, frequency=FREQUENCY, damping=DAMPING,
                            delay=DELAY + 0.006, coulomb=band, backlash=0.012, offset=-zero)
                      for band, zero in zip(BANDS, (0.02, -0.01), strict=True)])
    log = JointLog('made.csv', T, (1, 2), shown, np.tile(COMMAND, (2, 1)))
    error = simulate(log, np.arange(2), file_sets(file_robot, (1, 2))) - shown
    assert np.sqrt(np.mean(error[:, 25:]**2)) < 5e-4 and np.abs(error[:, 25:]).max() < 2e-3


def test_an_offset_servo_turns_its_thrust_to_the_commanded_tilt():
    zero, target = np.array([0.02, -0.03, 0.0, 0.05]), np.array([0.3, -0.2, 0.8, 0.0])
    file_robot = replace(SHIPPED, effects={'joint_offset': {'offset': tuple(zero)}})
    encoder = target + file_sets(file_robot, (1, 2, 3, 4))[:, INDEX['offset']]
    state = np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]), np.zeros(3)
    thrust = np.array([7.0, 8.0, 6.0, 9.0])
    seen, plain = ([np.array(part).ravel() for part in dynamics.body_acceleration(r)(
        *state, tilt, thrust)] for r, tilt in ((file_robot, encoder), (SHIPPED, target)))
    assert np.allclose(seen[0], plain[0], atol=1e-9) and np.allclose(seen[1], plain[1], atol=1e-9)


def test_batched_points_and_derivatives_agree_with_single_simulations():
    servos, log = Servos(robot(), (1, 2)), made(2)
    fitter = ServoFitter(log, Noise.white(2), servos)
    free = servos.mask('joint_bandwidth') | servos.mask('joint_offset', 1)
    point, weight, joints = servos.file_point, np.ones((1, len(T))), np.array([[0, 1]])
    base = fitter.residuals(point[None], joints, weight)
    slopes = fitter.jacobian(Problems(joints, point[None], free[None], weight), base)[0]
    for k in range(len(point)):
        moved = point.copy()
        moved[k] += 0.05
        expected = (fitter.residuals(moved[None], joints, weight) - base)[0] / 0.05 \
            if free[k] else 0.0
        assert np.allclose(slopes[k], expected, atol=1e-9)


def test_a_log_of_the_servos_of_the_robot_file_has_no_gap():
    result = judged(made(3))
    assert result['verdict'] == 'no_gap' and result['effects'] == []
    assert result['gap_before'] == pytest.approx(1.0, abs=0.3)


def test_limits_that_a_log_does_not_reach_are_listed_as_undetectable():
    hidden = judged(made(3))['hidden']
    assert 'joint_torque_limit' in hidden
    assert not {'joint_offset', 'joint_friction', 'joint_bandwidth'} & set(hidden)


@pytest.mark.parametrize('zeros', [(0.015, 0.0), (0.0, -0.015), (-0.012, 0.018)])
def test_zeros_that_moved_are_named_with_joint_and_sign(zeros):
    # the reading exceeds the command by the offset, so that the true tilt is less than the reading
    result = judged(made(4, *({'offset': -zero} for zero in zeros)))
    moved = [(j + 1, zero) for j, zero in enumerate(zeros) if zero]
    assert sorted(names(result)) == [(['joint_offset'], joint) for joint, _ in moved]
    for effect in result['effects']:
        entry = effect['parameters']['offset']
        assert entry['value'] == pytest.approx(dict(moved)[effect['joint']], abs=0.003)
        assert entry['interval'][0] < entry['value'] < entry['interval'][1]


@pytest.mark.parametrize(('change', 'name'), [
    ({'delay': DELAY + 0.015}, 'joint_command_latency'),
    ({'frequency': 0.84 * FREQUENCY, 'damping': 0.84 * DAMPING}, 'joint_bandwidth')])
def test_a_change_of_timing_is_named_alone(change, name):
    (found, _), = names(judged(made(5, **change)))
    assert name in found


@pytest.mark.parametrize('change', [{'delay': DELAY + 0.015},
                                    {'frequency': 0.7 * FREQUENCY}])
def test_one_different_servo_is_not_explained_by_a_shared_effect(change, tmp_path):
    result, page = analyse_joint_log([write(tmp_path / 'log.csv', made(31, {}, change))], [],
                                     robot(), None)
    assert result['verdict'] == 'unknown' and result['effects'] == []
    assert 'joint 2 has an error of' in result['reason'] and 'joint 2' in result['summary']
    assert result['where'][0]['channel'] == 'joint_2' and result['where'][0]['excess_after'] > 2
    assert page.index('class="verdict"') < page.index('<img') < page.index('<table')


def test_friction_of_one_joint_is_named_with_its_joint():
    effect, = judged(made(6, {'coulomb': 0.030}, {}))['effects']
    assert effect['names'] == ['joint_friction'] and 1 in effect['joints']
    each = effect['parameters']['coulomb']['each']
    assert each['1'] == pytest.approx(0.030 * stiffness(), rel=0.15)
    assert each['2'] == pytest.approx(BANDS[1] * stiffness(), rel=0.1)


def test_the_fitted_values_are_written(against_shipped):
    log, result = against_shipped
    found = Search(log, SHIPPED).run()
    written = file_sets(corrected(SHIPPED, result), log.joints)
    fitted = found.servos.sets(found.point[None])[0]
    a, b = (simulate(log, np.arange(2), sets) for sets in (written, fitted))
    assert np.abs(a - b).max() < 2e-4


def test_a_corrected_log_has_no_gap(against_shipped):
    log, result = against_shipped
    assert result['verdict'] in ('named', 'named_set') and result['gap_before'] > 10
    again = judged(log, corrected(SHIPPED, result))
    assert again['verdict'] == 'no_gap' and again['gap_before'] < 1.3


def test_each_accepted_effect_and_set_member_has_its_own_evidence(against_shipped):
    _, result = against_shipped
    members = [*result['effects'], *(r for e in result['effects']
                                     for r in e.get('rivals', []))]
    members += [row for row in result['candidates'] if row['accepted']]
    named = {name for effect in result['effects'] for name in effect['names']}
    assert {'joint_friction', 'joint_bandwidth'} <= named
    assert {row['name'] for row in result['candidates'] if row['accepted']} == named
    for member in members:
        assert member['evidence']['delta_bic'] > 0 and member['evidence']['cv_gain'] > 0


def test_changes_between_two_logs_are_reported_with_valid_intervals():
    before, after = made(7), made(8, {'offset': 0.018}, {}, coulomb=0.024)
    rows = changes(before, replace(after, name='after.csv'), SHIPPED)
    true = {(1, 'offset'): -0.018, (1, 'dead_band'): 0.024 - BANDS[0],
            (2, 'dead_band'): 0.024 - BANDS[1]}
    assert {(row['joint'], row['parameter']) for row in rows if row['significant']} >= set(true)
    for row in rows:
        low, high = row['interval']
        assert low < row['difference'] < high
        assert row['difference'] == pytest.approx(row['after'] - row['before'])
        wide = 1.6 * (high - low) / 2       # 99.8 %, because fourteen rows are tested
        if row['parameter'] not in ('coulomb',):
            assert abs(row['difference'] - true.get((row['joint'], row['parameter']), 0.0)) < wide
        if row['parameter'] in ('kp', 'kd', 'delay', 'ramp_lag'):
            assert not row['significant'], line(row)


def test_two_logs_of_the_same_servos_show_no_change():
    assert not any(row['significant'] for row in changes(made(9), made(10), SHIPPED))


def test_friction_may_be_given_for_each_joint():
    file_robot = replace(SHIPPED, effects={'joint_friction': {
        'coulomb': (0.001, 0.002, 0.003, 0.004), 'stiction': 0.002}})
    for joint in range(4):
        slow = dynamics.servo_acceleration(file_robot, 0.0, 2.0, 0.0, joint=joint)
        free = dynamics.servo_acceleration(SHIPPED, 0.0, 2.0, 0.0, joint=joint)
        torque = float(ca.DM(free - slow)) * INERTIA
        assert torque == pytest.approx(0.001 * (joint + 1), rel=0.01)
    coulomb, stiction = friction_of(file_robot)
    assert np.allclose(coulomb, [0.001, 0.002, 0.003, 0.004])
    assert np.allclose(stiction, [0.002, 0.002, 0.003, 0.004])
    assert all_keys(file_robot)['joint_friction.coulomb'].base == pytest.approx(0.0025)


def test_a_list_of_the_wrong_length_is_refused():
    with pytest.raises(ParameterError, match=r'joint_friction.coulomb.*\(4,\).*\(3,\)'):
        replace(SHIPPED, effects={'joint_friction': {'coulomb': (0.1,) * 3, 'stiction': 0.1}})


def test_a_flight_keeps_the_differences_between_joints():
    file_robot = replace(SHIPPED, effects={'joint_friction': {
        'coulomb': (0.001, 0.002, 0.003, 0.004), 'stiction': 0.004}})
    named = [{'names': ['joint_friction'], 'parameters': {
        'coulomb': {'value': 0.0045, 'unit': 'N m'}, 'stiction': {'value': 0.006, 'unit': 'N m'}}}]
    written = effects_with(file_robot, named)['joint_friction']
    assert np.allclose(written['coulomb'], [0.003, 0.004, 0.005, 0.006])
    assert written['stiction'] == 0.006


def test_the_command_line_writes_a_file_that_explains_the_log(tmp_path, capsys):
    log, later = (write(tmp_path / name, made(seed, **more)) for name, seed, more in (
        ('log.csv', 11, {}), ('later.csv', 12, {'offset': 0.02})))
    new, first, second = (tmp_path / name for name in ('new.yaml', 'a.json', 'b.json'))
    assert cli.main([str(a) for a in ('gap', log, later, '--apply', new, '--json', first)]) == 0
    shown = capsys.readouterr().out
    assert 'Changes to later.csv' in shown and 'joint 2: joint_offset' in shown
    result = json.loads(first.read_text())
    assert result['verdict'] in ('named', 'named_set')
    assert {'joint', 'name', 'parameter', 'before', 'after', 'difference', 'interval',
            'significant'} <= set(result['changes'][0])
    assert [j['joint'] for j in result['joints']] == [1, 2]
    assert len(RobotParameters.load(new).effects['joint_friction']['coulomb']) == 4
    assert cli.main([str(a) for a in ('gap', log, '--robot', new, '--json', second)]) == 0
    again = json.loads(second.read_text())
    assert again['verdict'] == 'no_gap' and again['effects'] == []
    for joint in again['joints']:       # effects of the file apply, and so does its held command
        assert joint['published_heldout_rms_rad'] == pytest.approx(joint['file_heldout_rms_rad'])


@pytest.mark.skipif(not REAL.is_file(), reason='the measured log is not here')
def test_the_real_log_is_named_and_its_correction_closes_it():
    log = read_joint_log(REAL)
    found = Search(log, SHIPPED).run()
    result = gap_of(found, log)
    assert result['verdict'] == 'named_set'
    named = [frozenset(effect['names']) for effect in result['effects']]
    assert set(named) == {frozenset({'joint_friction'}),
                          frozenset({'joint_command_latency', 'joint_bandwidth'})}
    assert (found.errors['corrected'] < (0.005, 0.012, 0.003, 0.003)).all()
    assert judged(log, corrected(SHIPPED, result))['verdict'] == 'no_gap'
