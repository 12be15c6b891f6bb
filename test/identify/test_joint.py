"""Servos are recovered from artificial logs."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from servo_logs import COUNT, log_of, sweep, trapezoid

from beetle_omni_ros.identify.servo.fit import KINDS, Servos
from beetle_omni_ros.identify.servo.model import file_sets, INDEX
from beetle_omni_ros.identify.servo.results import (
    identify,
    interval,
    joint_results,
    left_out_rms,
)
from beetle_omni_ros.model.parameters import RobotParameters

ROBOT = RobotParameters.load()
PARTS = {'slow': {'duration': 6.0},
         'fast': {'duration': 4.0, 'periods': (0.3, 0.6), 'amplitudes': (0.3, 0.6)}}
SERVOS = ({'coulomb': 0.013, 'frequency': 47.0, 'delay': 0.015},
          {'backlash': 0.015, 'frequency': 44.0, 'delay': 0.015, 'coulomb': 0.013},
          {'coulomb': 0.030, 'frequency': 52.0, 'delay': 0.015, 'offset': 0.012})
TRUE = {'natural_frequency': 'frequency', 'delay': 'delay', 'coulomb_friction': 'coulomb',
        'backlash': 'backlash', 'offset': 'offset'}
WITHIN = {'natural_frequency': 4.0, 'delay': 0.003, 'coulomb_friction': 0.003,
          'backlash': 0.003, 'offset': 0.003}


@cache
def made(name, every=1):
    """Log of the three servos; ``every`` 4: rows at 200 Hz with readings at 50 Hz."""
    t, command = sweep(**PARTS[name], rate=100.0 if every == 1 else 200.0)
    return log_of(t, command, SERVOS, seed=1, name=name, every=every, late=0.05 * (every > 1))


@cache
def found(name, every=1):
    return identify([made(name, every)], ROBOT)


def known(one):
    """(unit, name of the term, true value, 95 % interval) of every known parameter."""
    for unit, (*_, number) in enumerate(one.servos.units):
        for term, key in TRUE.items():
            true = SERVOS[number - 1].get(key, 0.0)
            yield unit, term, true, interval(one, one.chosen, unit, term)


def ramp_lag(values):
    """Lag [s] behind a ramp, of parameter sets."""
    return values[:, INDEX['delay']] + 2 * values[:, INDEX['damping_ratio']] / values[:, 0]


@pytest.mark.parametrize('every', [1, 4])
def test_the_true_values_are_recovered_at_any_rate_of_the_readings(every):
    one, inside = found('fast', every), []
    for unit, term, true, (low, high) in known(one):
        assert one.values()[unit, INDEX[term]] == pytest.approx(true, abs=WITHIN[term]), term
        assert high - low < 2.5 * WITHIN[term]
        if term != 'offset':        # of which the slow error of these logs is a part
            inside.append(low <= true <= high)
    assert np.mean(inside) >= 0.75


def test_a_slow_log_determines_the_lag_and_the_friction():
    one = found('slow')
    lags = [servo['delay'] + 2 * 0.63 / servo['frequency'] for servo in SERVOS]
    assert ramp_lag(one.values()) == pytest.approx(lags, abs=1e-3)
    bands = [sum(servo.get(key, 0.0) for key in ('coulomb', 'backlash')) for servo in SERVOS]
    assert one.values()[:, [INDEX['coulomb_friction'], INDEX['backlash']]].sum(axis=1) \
        == pytest.approx(bands, abs=0.004)


def test_two_logs_may_show_different_kinds_of_motion():
    t, command = sweep(3.0, periods=(0.3, 0.6), amplitudes=(0.3, 0.6))
    slow = log_of(t, 0.2 * command, SERVOS[:1], seed=2)
    for logs in ([made('fast'), slow], [slow, made('fast')]):
        servos = Servos(logs, file_sets(ROBOT, flown=True))
        fit = servos.fit(('joint_offset',), starts=({},)).fit
        assert max(block.max() for block in servos.blocks) < len(fit.held) <= 2 * KINDS
        assert np.isfinite(fit.held).all()


def test_only_a_slow_log_confounds_delay_and_bandwidth():
    pair = ['delay', 'natural_frequency']
    slow, fast = (joint_results(found(name), [], ROBOT)['joints'] for name in PARTS)
    assert any(pair in joint['traded'] for joint in slow)
    assert not any(pair in joint['traded'] for joint in fast)
    for a, b in zip(slow, fast, strict=True):
        widths = [np.ptp(joint['terms']['delay']['interval']) for joint in (a, b)]
        assert widths[0] > 1.5 * widths[1]


def test_ramps_and_holds_show_no_error_of_the_encoder():
    """Friction changes with the angle; few angles and directions take it for an encoder's."""
    seed = 104      # of which a line predicts one joint better
    rng = np.random.default_rng(seed)
    t, command = trapezoid(rng.uniform(0, 3))
    log = log_of(t, command, [
        {'frequency': 57 * np.exp(0.08 * rng.normal()), 'damping': 0.55, 'delay': 0.023,
         'coulomb': band, 'rough': rng.uniform(-0.8, 0.8), 'offset': 0.006 * rng.normal()}
        for band in (0.014, 0.045, 0.011, 0.010)], seed, every=4, late=0.05)
    one = identify([log], ROBOT)
    assert 'joint_encoder_error' not in one.chosen.entries
    joints = joint_results(one, [], ROBOT)['joints']
    assert sum(joint['best'] == 'line' for joint in joints) == 1
    for unit, joint in enumerate(joints):
        servo, line = left_out_rms(one, unit)
        assert joint['best'] == ('line' if line < servo else 'servo')
        assert any('A line' in text for text in joint['text']) == (line < servo)
        assert joint['heldout_rms_rad'] == (joint['line'] if line < servo else {
            'heldout_rms_rad': joint['servo_heldout_rms_rad']})['heldout_rms_rad']
        assert joint['holds_for']['angle_rad'] == pytest.approx([-1.75, 1.75], abs=0.1)


def test_samples_of_the_validation_part_are_not_used_by_the_fit():
    log = log_of(*sweep(3.0, periods=(0.8, 1.0)), SERVOS[:1], seed=4)
    measured, end = log.measured.copy(), log.end
    measured[:, end:] += COUNT * np.round(50 * np.sin(40 * log.t[end:]))
    one, other = (identify([each], ROBOT) for each in (log, replace(log, measured=measured)))
    assert one.chosen.entries == other.chosen.entries
    assert one.values() == pytest.approx(other.values(), rel=1e-9)
