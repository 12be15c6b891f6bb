"""Thrust, torque and lag are recovered from artificial and real logs; bad logs are refused."""

from pathlib import Path

import numpy as np
import pytest
from rotor_logs import bench, HEADER, PACKS, RATIO, SERIES, series, stand, SURFACE, write

from beetle_omni_ros.identify.inference.noise import interval
from beetle_omni_ros.identify.robot_file import write_measured
from beetle_omni_ros.identify.rotor.log import chosen, read_rotor_log
from beetle_omni_ros.identify.rotor.results import identify_rotor, measured, rotor_results
from beetle_omni_ros.model.files import LogError
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.model.parts import ThrustMap

DATA = Path(__file__).resolve().parents[3] / 'shared' / 'data'
STAND = (*HEADER, 'temperature', 'file_voltage')
real = pytest.mark.skipif(not DATA.is_dir(), reason='no measured logs')


def identified(tmp_path, rows, header=HEADER, **options):
    path = write(tmp_path / 'bench.csv', rows, header)
    return identify_rotor([read_rotor_log(path, **options)])


def thrust_of(model, duty, voltage):
    return model.surfaces['thrust'].at(duty, voltage)[..., 0]


def written(folder, results):
    write_measured(folder / 'robot.yaml', RobotParameters.load(), None, [], measured(results))


def only_lag(model):
    [(_, lag)] = model.lags
    assert not lag['reason']
    return lag


def within(result, truth):
    low, high = result['interval']
    return low <= truth <= high


def test_intervals_hold_the_true_surface_ratio_and_drift(tmp_path):
    duty, voltage = np.array([0.2, 0.45, 0.75]), 23.0
    true = np.polyval([*SURFACE[::-1], 0], duty * voltage)
    inside = {'thrust': [], 'ratio': [], 'drift': []}
    for seed in range(20):
        rng = np.random.default_rng(seed)
        model = identified(tmp_path, stand(rng, tare=0.03, drift=0.002), STAND)
        results = rotor_results(model)
        assert results['surface']['left_out_rms_N'] < 0.45
        inside['drift'].append(within(results['temperature'], 0.002))
        inside['ratio'].append(within(results['torque_to_thrust_ratio'], RATIO))
        model = identified(tmp_path, stand(rng), STAND)
        limits = np.array([interval(one) for one in model.surfaces['thrust'].at(duty, voltage)])
        inside['thrust'] += list((limits[:, 0] < true) & (true < limits[:, 1]))
        assert np.ptp(limits, axis=1).max() < 0.7
    assert all(np.mean(hits) > 0.8 for hits in inside.values()), inside


def test_other_columns_signs_and_units_give_the_same_result(tmp_path):
    rows = bench(np.random.default_rng(1))
    first = identified(tmp_path, rows)
    for header, factor, options in (
            (('duty_percent', 'thrust_N', 'torque_Nm', 'voltage'), [1 / 20, 1, -1, 1], ()),
            (('pwm_us', 'fz', 'tz', 'voltage_V'), [1, -1, 1, 1], ()),
            (('pwm_us', 'load', 'tz', 'mV'), [1, -100, 1, 1000],
             ('thrust=-load*0.01', 'voltage=mV*0.001'))):
        other = identified(tmp_path, rows * factor, header, columns=chosen(options))
        for name, surface in first.surfaces.items():
            assert np.allclose(other.surfaces[name].every[0], surface.every[0], rtol=0.02,
                               atol=1e-3)


def test_the_lag_and_its_directions_are_recovered(tmp_path):
    inside = []
    for seed in range(4):
        model = identified(tmp_path, series(np.random.default_rng(seed)), SERIES)
        lag = only_lag(model)
        assert lag['up']['value'] == pytest.approx(0.07, rel=0.15)
        assert lag['down']['value'] == pytest.approx(0.045, rel=0.15)
        assert lag['up']['interval'][0] > lag['down']['interval'][1]
        inside += [within(lag['up'], 0.07), within(lag['down'], 0.045),
                   within(lag['dead_time'], 0.0)]
    assert np.mean(inside) > 0.8


@pytest.mark.parametrize('seed', range(2))
def test_a_gain_that_jumps_is_bad_data_with_the_lag_that_remains(tmp_path, seed):
    rng = np.random.default_rng(seed)
    gains = rng.permutation([0.2, 0.25, 0.3, 0.35, 0.4, 0.45, 0.5, 0.55, 0.2, 0.3, 0.4, 0.5])
    results = rotor_results(identified(tmp_path, series(rng, gains=gains), SERIES))
    assert results['verdict'] == 'bad_data'
    assert 'do not belong together' in results['reason']
    assert results['lag']['value'] == pytest.approx(0.055, rel=0.3)
    with pytest.raises(LogError, match='bad_data'):
        written(tmp_path, results)
    steady = rotor_results(identified(tmp_path, series(rng, noise=1.0), SERIES))
    assert steady['verdict'] == 'identified'


def test_held_and_impossible_telemetry_is_masked_and_stated(tmp_path):
    rows = stand(np.random.default_rng(3))
    clean = identified(tmp_path, rows, STAND)
    bad = rows.copy()
    bad[1::10, 3], bad[3::20, 3] = 97.0, 0.46
    model = identified(tmp_path, bad, STAND)
    assert np.abs(model.rows['voltage'] - rows[:, 3]).max() < 3
    assert thrust_of(model, 0.6, 23.0) == pytest.approx(thrust_of(clean, 0.6, 23.0), abs=0.1)
    assert f'{np.sum(bad[:, 3] != rows[:, 3])} of {len(rows)} rows' in model.logs[0].notes[0]


def test_the_written_robot_file_gives_the_surface(tmp_path):
    model = identified(tmp_path, stand(np.random.default_rng(0)), STAND)
    path = tmp_path / 'robot.yaml'
    results = rotor_results(model)
    written(tmp_path, results)
    robot, shipped = RobotParameters.load(path), RobotParameters.load()
    assert robot.joints == shipped.joints
    assert robot.rotors.torque_to_thrust_ratio == pytest.approx(
        results['torque_to_thrust_ratio']['value'], rel=1e-4)
    low, high = robot.interval('rotors.torque_to_thrust_ratio')
    assert low < RATIO < high
    found = ThrustMap(robot.rotors)
    for voltage in np.linspace(model.rows['voltage'].min(), model.rows['voltage'].max(), 7):
        thrust = np.linspace(2, found.thrust_limit(voltage), 20)
        duty = found.duty(thrust, voltage)
        assert np.abs(thrust_of(model, duty / 50 - 1, voltage) - thrust).max() < 0.5


def test_a_written_map_holds_for_a_pack_below_those_of_the_stand(tmp_path):
    rows = stand(np.random.default_rng(0))
    lowest = rows[:, 5] == PACKS[0]
    written(tmp_path, rotor_results(identified(tmp_path, rows[~lowest], STAND)))
    found = ThrustMap(RobotParameters.load(tmp_path / 'robot.yaml').rotors)
    for pulse, voltage in rows[lowest & (rows[:, 0] > 1200)][:, [0, 3]]:
        true = np.polyval([*SURFACE[::-1], 0], (pulse / 1000 - 1) * voltage)
        assert found.thrust(pulse / 20, voltage) == pytest.approx(true, abs=0.5)


@real
def test_the_measured_stand_predicts_a_voltage_left_out():
    results = rotor_results(identify_rotor([read_rotor_log(DATA / 'thrust_stand.csv')]))
    assert results['verdict'] == 'identified'
    assert results['surface']['left_out_rms_N'] < 0.4
    ratio = results['torque_to_thrust_ratio']
    assert within(ratio, 0.0165) and within(ratio, 0.0167)
    assert np.ptp(ratio['interval']) < 0.0012


@real
def test_the_measured_rotor_log_is_bad_data_with_a_lag():
    results = rotor_results(identify_rotor([read_rotor_log(DATA / 'rotor_log_100Hz.csv')]))
    assert results['verdict'] == 'bad_data'
    lag = results['lag']
    assert 0.04 < lag['value'] < 0.07
    assert within(lag['up'], 0.065) and within(lag['down'], 0.0475)
    assert '22%' in results['warnings'][0]


@real
def test_the_measured_start_has_the_lag_of_a_rising_thrust():
    path = DATA / 'thrust_stand_start_24V.csv'
    with pytest.raises(LogError, match='--rate'):
        read_rotor_log(path)
    lag = only_lag(identify_rotor([read_rotor_log(path, rate=90)]))
    assert lag['from_rest'] and lag['down'] is None
    assert within(lag['up'], 0.064) and lag['dead_time']['interval'][0] > 0.1


def scaled(column, factor):
    return lambda rows: rows * np.where(np.arange(4) == column, factor, 1.0)


CASES = {
    'no torque': (lambda r: r[:, [0, 1, 3]], ('pwm_us', 'force_N', 'voltage_V'),
                  "column 'torque_N_m' is missing"),
    'grams in the header': (lambda r: r, ('pwm_us', 'force_g', 'torque_N_m', 'voltage_V'),
                            "'force_g' has another unit"),
    'grams': (scaled(1, 102.0), HEADER, 'expected newtons'),
    'thrust of the other sign': (scaled(1, -1.0), HEADER, 'expected newtons'),
    'millivolts': (scaled(3, 1000.0), HEADER, 'millivolts'),
    'pulse as duty': (lambda r: r, ('duty_percent', *HEADER[1:]), 'expected duty of 2000 us'),
    'few rows': (lambda r: r[:10], HEADER, '10 rows are too few'),
    'thrust falls': (lambda r: np.stack([3000 - r[:, 0], *r.T[1:]], axis=1)[r[:, 0] > 1100],
                     HEADER, 'thrust does not rise with the command'),
    'torque of noise': (lambda r: np.stack([r[:, 0], r[:, 1], np.random.default_rng(0).normal(
        size=len(r)), r[:, 3]], axis=1), HEADER, 'torque does not follow thrust')}


@pytest.mark.parametrize('case', CASES)
def test_unusable_logs_are_refused(tmp_path, case):
    change, header, words = CASES[case]
    path = write(tmp_path / 'bad.csv', change(bench(np.random.default_rng(0))), header)
    with pytest.raises(LogError) as caught:
        identify_rotor([read_rotor_log(path)])
    assert words in str(caught.value) and 'bad.csv' in str(caught.value)
    assert '\n' not in str(caught.value)
