"""The servo model agrees with closed forms and with an independent simulation."""

import numpy as np
import pytest
from scipy.signal import cont2discrete, lfilter
from servo_logs import servo, sweep

from beetle_omni_ros.identify.servo import model as servo_model
from beetle_omni_ros.identify.servo.log import JointLog
from beetle_omni_ros.identify.servo.model import INDEX, OFF, simulate


def log_for(t, command, start=None):
    measured = np.full((1, len(t)), command[0]) if start is None else start[None]
    return JointLog('made.csv', t, (1,), measured, command[None])


def parameter_set(**values):
    made = OFF.copy()
    made[INDEX['natural_frequency']], made[INDEX['damping_ratio']] = 50.0, 0.7
    for name, value in values.items():
        made[INDEX[name]] = value
    return made[None]


def step_command(size=0.3, at=0.2, duration=1.0):
    t = np.arange(0, duration, 0.005)
    return t, np.where(t >= at - 1e-9, size, 0.0)


def test_the_step_response_is_that_of_a_second_order_system():
    t, command = step_command()
    wn, zeta = 50.0, 0.7
    fine = np.arange(0, t[-1] + 1e-4, 1e-4)
    wanted = np.interp(fine, t, command)      # a smooth curve through the samples
    numerator, denominator, _ = cont2discrete(
        ([wn**2], [1, 2 * zeta * wn, wn**2]), 1e-4, method='foh')
    exact = np.interp(t, fine, lfilter(numerator.ravel(), denominator, wanted))
    assert np.abs(simulate(log_for(t, command), 0, parameter_set(), held=False)[0]
                  - exact).max() < 1e-3 * 0.3


@pytest.mark.parametrize('values', [
    {'delay': 0.0173}, {'coulomb': 0.013, 'delay': 0.01}, {'backlash': 0.02},
    {'stiction': 0.01, 'coulomb': 0.01}, {'velocity_limit': 3.0},
    {'torque_limit': 0.12}, {'offset': -0.03}, {'gain': 0.04}])
def test_every_term_agrees_with_a_plain_simulation(values):
    t, command = sweep(duration=4.0)
    positions = servo(t, command, frequency=50.0, damping=0.7, **{'delay': 0.0, **values})
    names = {'coulomb': 'coulomb_friction', 'gain': 'encoder_gain'}
    model = parameter_set(**{names.get(name, name): value for name, value in values.items()})
    error = simulate(log_for(t, command, positions), 0, model)[0] - positions
    assert np.sqrt(np.mean(error[25:]**2)) < 3e-4 and np.abs(error[25:]).max() < 1e-3


def test_parameter_sets_in_a_batch_are_independent():
    t, command = sweep(duration=3.0)
    log = log_for(t, command)
    sets = np.concatenate([parameter_set(), parameter_set(delay=0.02, coulomb_friction=0.02),
                           parameter_set(backlash=0.05, velocity_limit=2.0)])
    together = simulate(log, 0, sets)
    for k, alone in enumerate(sets):
        assert np.allclose(together[k], simulate(log, 0, alone[None])[0], atol=1e-12)


@pytest.mark.parametrize('values', [
    {}, {'coulomb_friction': 0.013, 'stiction': 0.01}, {'velocity_limit': 3.0},
    {'torque_limit': 0.12, 'load_sine': 0.05, 'load_cosine': -0.02}, {'backlash': 0.02}])
def test_without_a_compiler_the_numbers_are_the_same(values, monkeypatch):
    log = log_for(*sweep(duration=1.0))
    compiled = simulate(log, 0, parameter_set(delay=0.0137, **values))
    monkeypatch.setattr(servo_model, '_compiled', lambda: None)
    assert np.allclose(simulate(log, 0, parameter_set(delay=0.0137, **values)), compiled,
                       rtol=0, atol=1e-9)
