"""The slow balance of torques against dense densities, and on flights with a weak rotor."""

from math import exp, log

import numpy as np
import pytest
from scipy.stats import multivariate_normal
from test_engine import BESIDE, gap_of, motor_volts, ROBOT

from beetle_omni_ros.identify.flights.balance import Balance, SCALES, SCATTER, SESSION, SLOW
from beetle_omni_ros.identify.flights.keys import keys_of, prior_of
from beetle_omni_ros.model.parameters import RobotParameters

HEADER = ('t,ekf_px,ekf_py,ekf_pz,ekf_vx,ekf_vy,ekf_vz,ekf_ax,ekf_ay,ekf_az,ekf_roll,ekf_yaw,'
          'pwm1,pwm2,pwm3,pwm4,vbat')
ARM, WEIGHT = 0.03253, 0.0319 * 9.81


def write_flight(path, seed, scale=(1, 1, 1, 1), hub=5e-4, load=(0.0, 0.0), moved=0.0):
    """
    A flight forwards and back in the columns of CrazyPAD, from equations of its own.

    The rotors carry the weight, balance a centre of mass at ``load`` [m] and the moment of the
    hubs (``hub`` [N s] times speed), and have ``scale`` times the thrust of the map. The commands
    also have random torques of ``moved`` times weight and arm.
    """
    rng = np.random.default_rng(seed)
    t = np.arange(0, 24, 0.00992)
    speed = np.interp(t, [0, 4, 5, 10, 11, 12, 13, 18, 19], [0, 0, .5, .5, 0, 0, -.5, -.5, 0])
    slope = np.gradient(speed, t)
    height = np.interp(t, [0, 1, 2.5], [0, 0, 0.5])
    # rotors: sum, torque about x (left up), about y (nose down), none about z
    need = np.column_stack([np.full(len(t), WEIGHT), np.full(len(t), load[1] * WEIGHT),
                            -load[0] * WEIGHT + hub * speed, np.zeros(len(t))])
    need[:, 1:3] += moved * WEIGHT * ARM * rng.normal(size=(len(t), 2))
    arms = np.array([[1, 1, 1, 1], [-ARM, -ARM, ARM, ARM], [-ARM, ARM, ARM, -ARM], [1, -1, 1, -1]])
    thrust = np.linalg.solve(arms, need.T).T / scale
    place = np.cumsum(speed) * 0.00992
    up = rng.normal(size=(len(t), 3)) * 0.05
    up[:, 0] += slope
    np.savetxt(path, np.column_stack([
        t, place, 0 * t, height, speed, 0 * t, np.gradient(height, t), up, 0 * t, 0 * t,
        motor_volts(thrust) / 3.8 * 65535, np.full(len(t), 3.8)]), delimiter=',', header=HEADER,
        comments='', fmt='%.7g')
    return path


def members(result):
    return {label for effect in result['effects'] for label in effect['members']}


def judged(paths, robot=ROBOT):
    return gap_of(paths, 'crazypad_motor', robot)


def test_evidence_and_estimate_agree_with_dense_densities():
    robot, rng = RobotParameters.load(ROBOT), np.random.default_rng(1)
    keys = keys_of(robot, SLOW)
    # rotors turn the body by 100 rad/s^2, a metre by 2e4, the free hub moment by 3e4 per N s
    size = [{'rotor_thrust_coefficient': 100.0, 'centre_of_mass': 2e4}.get(key.effect, 3e4)
            for key in keys.values()]
    parts = [(3 * rng.normal(size=(5, 2)) + 15, rng.normal(size=(5, 2, len(keys))) * size)
             for _ in range(2)]
    found = Balance(parts, robot)
    a = np.concatenate([slopes.reshape(10, -1) for _, slopes in parts])
    y = np.concatenate([part.ravel() for part, _ in parts])
    priors = [prior_of(robot, key, 0.0, 0.0) for key in keys.values()]
    narrow, typical, flight = np.array([[s.narrow, s.typical, s.flight] for s in priors]).T
    hub = found.index['rotor_hub_moment.coefficient']
    narrow[hub] += 9 * typical[hub]
    same = np.kron(np.eye(2), np.ones((10, 10)))
    bases = dict(zip(keys, np.eye(len(keys)), strict=True))
    half = np.sqrt(0.5)
    offset = [typical[found.index[f'centre_of_mass.offset[{k}]']]
              * bases[f'centre_of_mass.offset[{k}]'] for k in range(3)]
    corners = [x * offset[0] + y * offset[1] for x in (half, -half) for y in (half, -half)]
    rotors = np.array([key.effect == 'rotor_thrust_coefficient' for key in keys.values()])

    def density(*shapes):
        terms = []
        for scatter in SCATTER:
            prior = np.diag(narrow**2 + (scatter * rotors)**2)
            for shape in shapes or [0 * prior]:
                for scale in SCALES:
                    total = a @ (prior + scale**2 * shape) @ a.T + found.noise * np.eye(20) \
                        + (a * flight**2 @ a.T) * same
                    terms.append(multivariate_normal.logpdf(y, np.zeros(20), total))
        return np.logaddexp.reduce(terms) - log(len(SCATTER) * len(SCALES))
    # nine equally likely causes: four rotors, a load anywhere, a load below each rotor
    third = np.diag((typical * bases['rotor_thrust_coefficient.scale[2]'])**2)
    load = [sum(np.outer(x, x) for x in offset), *(np.outer(x, x) for x in corners)]
    for label, shapes in (('rotor_thrust_coefficient[3]', [third]), ('centre_of_mass', load)):
        k = [entry.label for entry in found.entries].index(label)
        assert found.gains[k,] == pytest.approx(
            density(*shapes) - density() - log(9), abs=1e-5)
    null = a @ np.diag(narrow**2 + (SESSION * rotors)**2) @ a.T \
        + (a * flight**2 @ a.T) * same + found.noise * np.eye(20)
    wide = null + a @ third @ a.T
    own = [found.index['rotor_thrust_coefficient.scale[2]']]
    scatter = null + found.least(own, 3.0)**2 * a @ third @ a.T
    mean = (np.trace(np.linalg.solve(null, scatter)) - np.trace(np.linalg.solve(wide, scatter))
            + np.linalg.slogdet(null)[1] - np.linalg.slogdet(wide)[1]) / 2
    assert mean == pytest.approx(3.0)


def test_a_rotor_that_is_much_weaker_than_the_scatter_is_held_with_its_thrust(tmp_path):
    result = judged([write_flight(tmp_path / 'a.csv', 0, (0.65, 1, 1, 1), moved=0.1)])
    beside = {f'rotor_thrust_coefficient[{k}]' for k in (2, 4)}     # turn about the other diagonal
    assert len(result['effects']) == 1 and not beside & members(result)
    assert result['effects'][0]['members'][0] == 'rotor_thrust_coefficient[1]'
    low, high = result['effects'][0]['parameters']['scale']['interval']
    assert low < 0.65 < high < 0.8
    assert result['groups']['torque']['channels'] == ['torque_x', 'torque_y']
    slow = ('rotor_thrust_coefficient', 'centre_of_mass')
    evidence = sum(exp(row['evidence']['ln_bayes_factor']) for row in result['candidates']
                   if row['name'] in slow)
    # The forces have an e-value between zero and this, and share alpha by the mean of both.
    assert 1 < evidence * result['false_alarm_probability'] <= 2


def test_less_than_the_scatter_names_nothing(tmp_path):
    weak = [write_flight(tmp_path / f'{k}.csv', k, (1, 1, 0.94, 1.03), moved=0.1)
            for k in range(2)]
    assert not judged(weak[:1])['effects'] and not judged(weak)['effects']


@pytest.mark.parametrize('place, rotor', [((0.0, 0.006), 0), ((0.0045, 0.0045), 4)])
def test_a_load_is_never_told_as_rotors_alone(tmp_path, place, rotor):
    result = judged([write_flight(tmp_path / 'a.csv', 3, load=place, hub=1e-3, moved=0.3)])
    assert 'centre_of_mass' in members(result) and len(result['effects']) == 1
    # below a rotor it turns the body as if this rotor were weak
    assert not rotor or f'rotor_thrust_coefficient[{rotor}]' in members(result)


def test_neither_inertia_nor_torque_ratio_counts(tmp_path):
    path = write_flight(tmp_path / 'a.csv', 5, (1, 1, 0.65, 1), moved=0.1)
    other = tmp_path / 'other.yaml'
    other.write_text(f'extends: {ROBOT}\ninertia: [5.0e-5, 5.0e-5, 9.0e-5]\n'
                     'rotors: {torque_to_thrust_ratio: 0.012}\n')
    one, two = judged([path]), judged([path], other)
    assert members(one) == members(two)
    assert [e['parameters']['scale']['value'] for e in one['effects']] == pytest.approx(
        [e['parameters']['scale']['value'] for e in two['effects']], rel=2e-3)


@pytest.mark.skipif(not BESIDE.is_dir(), reason='further flights are not beside the repository')
def test_a_real_cut_propeller_is_held_and_normal_flights_name_nothing():
    cut = judged(sorted(BESIDE.glob('pad_motor_cut_propeller_M3_3.5mm*')))
    assert 'rotor_thrust_coefficient[3]' in members(cut) and len(cut['effects']) == 1
    for number in (0, 3):
        paths = list(BESIDE.glob(f'pad_motor_normal_flight_E8_log0{number}*'))
        assert not judged(paths)['effects']
