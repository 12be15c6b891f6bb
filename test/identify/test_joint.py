"""Servos are recovered from artificial logs, and real ones are predicted."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from servo_logs import log_of, sweep

from beetle_omni_ros.identify.joint import error_rms, identify_joints
from beetle_omni_ros.identify.servo.log import read_joint_log
from beetle_omni_ros.identify.joint_results import joint_results
from beetle_omni_ros.identify.parameters import shipped
from beetle_omni_ros.identify.servo.model import INDEX, published_set
from beetle_omni_ros.robot.parameters import RobotParameters

PUBLISHED = RobotParameters.load().joints
REAL = Path(__file__).resolve().parents[3] / 'shared' / 'data' / 'joint_response_100Hz.csv'
SLOW, FAST = sweep(duration=9.0), sweep(4.5, periods=(0.3, 0.6), amplitudes=(0.3, 0.6))
SERVOS = ({'coulomb': 0.013, 'frequency': 47.0, 'delay': 0.015},
          {'backlash': 0.015, 'frequency': 44.0, 'delay': 0.018},
          {'coulomb': 0.030, 'frequency': 52.0, 'delay': 0.013, 'offset': 0.012})
TRUE = {'natural_frequency': 'frequency', 'delay': 'delay', 'coulomb_friction': 'coulomb',
        'backlash': 'backlash', 'offset': 'offset'}


@pytest.fixture(scope='module')
def logs():
    """Slow and fast logs of the same three servos."""
    return {'slow': log_of(*SLOW, SERVOS, seed=1), 'fast': log_of(*FAST, SERVOS, seed=2)}


@pytest.fixture(scope='module')
def models(logs):
    """Models identified from each log."""
    return {name: identify_joints(log, PUBLISHED) for name, log in logs.items()}


def judged(models):
    """(model, true value, name of the term) of every known parameter."""
    for model, servo in zip(models, SERVOS, strict=True):
        for term, key in TRUE.items():
            if key in servo:
                yield model, servo[key], term


@pytest.mark.parametrize('name', ['slow', 'fast'])
def test_the_true_terms_are_kept_and_no_others(models, name):
    for model, servo in zip(models[name], SERVOS, strict=True):
        friction = 'backlash' if 'backlash' in servo else 'coulomb_friction'
        expected = {'delay', friction} | ({'offset'} if 'offset' in servo else set())
        assert set(model.kept) == expected, f'joint {model.joint}'


@pytest.mark.parametrize(('name', 'tolerance'), [
    ('slow', {'natural_frequency': 8.0, 'delay': 0.005}),
    ('fast', {'natural_frequency': 3.0, 'delay': 0.002})])
def test_the_true_values_are_recovered(models, name, tolerance):
    for model, true, term in judged(models[name]):
        assert model.values[INDEX[term]] == pytest.approx(true, abs=tolerance.get(term, 0.002))


@pytest.mark.parametrize('name', ['slow', 'fast'])
def test_intervals_cover_the_truth_and_are_narrow(models, name):
    inside = [low <= true <= high for model, true, term in judged(models[name])
              for low, high in [model.uncertainty.intervals[INDEX[term]]]]
    assert np.mean(inside) > 0.8
    for model, true, term in judged(models[name]):
        if term in ('coulomb_friction', 'backlash', 'offset'):
            assert np.ptp(model.uncertainty.intervals[INDEX[term]]) < max(0.3 * true, 0.004)


def test_only_a_slow_log_confounds_delay_and_bandwidth(models):
    pair = ['delay', 'natural_frequency']
    assert any(pair in model.inseparable for model in models['slow'])
    assert not any(pair in model.inseparable for model in models['fast'])
    for slow, fast in zip(models['slow'], models['fast'], strict=True):
        widths = [np.ptp(model.uncertainty.intervals[INDEX['delay']]) for model in (slow, fast)]
        assert widths[0] > 2 * widths[1]


def test_fits_of_the_slow_log_predict_the_fast_one(logs, models):
    for k, model in enumerate(models['slow']):
        assert error_rms(logs['fast'], k, model.values) < 0.006
        assert error_rms(logs['fast'], k, published_set(PUBLISHED), held=False) > 0.03


def test_a_speed_limit_is_found_if_the_command_exceeds_it():
    t, command = sweep(4.0, periods=(0.8, 1.2), amplitudes=(1.2, 1.6))
    log = log_of(t, command, [{'velocity_limit': 5.5, 'coulomb': 0.012}], seed=3)
    model, = identify_joints(log, PUBLISHED)
    assert 'velocity_limit' in model.kept
    assert model.values[INDEX['velocity_limit']] == pytest.approx(5.5, rel=0.02)


def test_a_limit_that_is_never_reached_stays_with_an_open_interval(logs, models):
    results = joint_results(logs['slow'], [logs['fast']], models['slow'], PUBLISHED)
    for joint in results['joints']:
        limit = joint['terms']['velocity_limit']
        assert not limit['kept']
        assert limit['value'] == PUBLISHED.velocity_limit
        assert limit['interval'][0] > 2 and limit['interval'][1] is None


def test_samples_of_the_validation_part_are_not_used_by_the_fit():
    log = log_of(*sweep(3.0, periods=(0.8, 1.0)), SERVOS[:1], seed=4)
    one, other = (identify_joints(each, PUBLISHED)[0] for each in (log, replace_end(log)))
    assert one.kept == other.kept and len(one.kept) > 1
    assert np.array_equal(one.values, other.values)
    assert np.array_equal(one.uncertainty.intervals, other.uncertainty.intervals)


def replace_end(log):
    """The log with invalid readings in its last part."""
    measured = log.measured.copy()
    measured[:, log.end_of(shipped().servo.fitted):] = 0.3
    return replace(log, measured=measured)


@pytest.mark.skipif(not REAL.is_file(), reason='the measured log is not here')
def test_the_real_servos_are_predicted():
    log = read_joint_log(REAL)
    results = joint_results(log, [log], identify_joints(log, PUBLISHED), PUBLISHED)
    limits = zip(results['joints'], (0.072, 0.097, 0.069, 0.068), (0.005, 0.013, 0.004, 0.004),
                 strict=True)
    for joint, published, heldout in limits:
        assert joint['published_rms_rad'] == pytest.approx(published, rel=0.03)
        assert joint['heldout_rms_rad'] < heldout
        assert joint['terms']['coulomb_friction']['kept']
        assert joint['terms']['coulomb_friction']['interval'][0] > 0.005
        assert ['delay', 'natural_frequency'] in joint['traded']
        assert any('To separate delay and bandwidth' in text for text in joint['text'])
        low, high = joint['terms']['delay']['interval']
        assert high - low > 0.008
