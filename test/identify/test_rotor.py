"""The rotor map is recovered from artificial bench logs, and bad logs are refused."""

import numpy as np
import pytest
from rotor_logs import bench, HEADER, RATIO, ROWS, write

from beetle_omni_ros.identify.rotor import crossings, fit_row, identify_rotor
from beetle_omni_ros.identify.rotor_log import Plateau, read_rotor_log
from beetle_omni_ros.identify.rotor_results import rotor_results, write_rotor_file
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.runs.csv_table import LogError


def identified(tmp_path, rows, header=HEADER):
    log = read_rotor_log(write(tmp_path / 'bench.csv', rows, header))
    return log, *identify_rotor(log)


def relative_error(row, true, lowest=2.0):
    """
    Largest error of the thrust at a duty, relative to thrust.

    Below ``lowest`` [N] it is relative to that, the resolution of 200 rows with 0.03 N of noise.
    """
    thrust = np.linspace(0.3, min(row.thrust_max, true.thrust_max), 200)
    error = row.thrust(np.polyval(true.coefficients[::-1], thrust / 10)) - thrust
    return np.abs(error / np.maximum(thrust, lowest)).max()


@pytest.mark.parametrize('seed', range(4))
def test_the_five_published_rows_are_recovered(tmp_path, seed):
    _, rows, ratio = identified(tmp_path, bench(np.random.default_rng(seed)))
    assert len(rows) == 5
    for row, true in zip(rows, ROWS, strict=True):
        assert row.voltage == pytest.approx(true.voltage, abs=0.02)
        assert row.thrust_max == pytest.approx(true.thrust_max, rel=0.02)
        assert relative_error(row, true) < 0.01
    assert ratio.interval[0] < RATIO < ratio.interval[1]
    assert np.ptp(ratio.interval) < 0.02 * RATIO
    assert crossings(rows) == []


def test_the_map_and_its_inverse_agree(tmp_path):
    _, rows, _ = identified(tmp_path, bench(np.random.default_rng(0)))
    for row in rows:
        thrust = np.linspace(0.5, row.thrust_max, 300)
        assert np.allclose(row.thrust(row.duty(thrust)), thrust, rtol=1e-6)
        assert row.inverse_error < 1e-3
        assert (np.diff(row.duty(thrust)) > 0).all()


def test_intervals_cover_the_truth():
    inside = []
    for seed in range(15):
        rng = np.random.default_rng(seed)
        true = ROWS[seed % 5]
        thrust = rng.uniform(0, true.thrust_max, 150)
        duty = np.polyval(true.coefficients[::-1], thrust / 10)
        row = fit_row('made', Plateau(true.voltage, duty, thrust + rng.normal(size=150) * 0.08,
                                      RATIO * thrust))
        inside += list((row.intervals[:, 0] < true.coefficients)
                       & (true.coefficients < row.intervals[:, 1]))
    assert np.mean(inside) > 0.85


def test_the_fit_is_robust_to_growing_noise_and_outliers(tmp_path):
    rng = np.random.default_rng(5)
    rows = bench(rng, force_noise=0.0)
    rows[:, 1] *= 1 + 0.01 * rng.normal(size=len(rows))
    rows[::60, 1] += 3.0
    _, fitted, _ = identified(tmp_path, rows)
    assert max(relative_error(row, true) for row, true in zip(fitted, ROWS, strict=True)) < 0.01


def test_a_sagging_supply_still_gives_five_plateaus(tmp_path):
    log, rows, _ = identified(tmp_path, bench(np.random.default_rng(2), sag=0.3))
    assert [len(plateau.duty) for plateau in log.plateaus] == [208] * 5
    assert len(rows) == 5


def test_other_columns_and_signs_give_the_same_result(tmp_path):
    rows = bench(np.random.default_rng(1))
    _, first, _ = identified(tmp_path, rows)
    other = rows * [1 / 20, 1, -1, 1]
    _, second, ratio = identified(tmp_path, other, ('duty_percent', 'thrust_N', 'torque_Nm',
                                                    'voltage_V'))
    assert ratio.value > 0
    for a, b in zip(first, second, strict=True):
        assert np.allclose(a.coefficients, b.coefficients, rtol=1e-3, atol=1e-2)


def test_rows_before_the_rotor_settles_are_omitted(tmp_path):
    rng = np.random.default_rng(3)
    levels = np.repeat(np.linspace(55, 90, 15), 60)
    t = 0.05 * np.arange(len(levels))
    true = ROWS[0]
    grid = np.linspace(0, 2.5, 4000)
    steady = 10 * np.interp(levels, np.polyval(true.coefficients[::-1], grid), grid)
    force = steady.copy()
    for k in range(1, len(force)):
        force[k] = force[k - 1] + (steady[k] - force[k - 1]) * 0.3
    rows = np.stack([levels * 20, force + 0.02 * rng.normal(size=len(t)), RATIO * force,
                     np.full(len(t), true.voltage), t], axis=1)
    log, fitted, _ = identified(tmp_path, rows, (*HEADER, 't_s'))
    assert len(log.plateaus[0].duty) < 0.9 * len(t)
    assert relative_error(fitted[0], true, lowest=3.0) < 0.01


def test_the_written_robot_file_contains_the_map(tmp_path):
    log, rows, ratio = identified(tmp_path, bench(np.random.default_rng(0)))
    path = tmp_path / 'robot.yaml'
    write_rotor_file(path, rotor_results(log, rows, ratio), None)
    robot, shipped = RobotParameters.load(path), RobotParameters.load()
    assert robot.joints == shipped.joints
    assert robot.rotors.torque_to_thrust_ratio == pytest.approx(ratio.value, abs=1e-6)
    for written, row in zip(robot.rotors.map, rows, strict=True):
        assert np.allclose(written.coefficients, row.coefficients, atol=1e-7)


def scaled(rows, column, factor):
    changed = rows.copy()
    changed[:, column] *= factor
    return changed


def with_value(rows, row, column, value):
    changed = rows.copy()
    changed[row, column] = value
    return changed


CASES = {
    'no torque': (lambda r: r[:, [0, 1, 3]], ('pwm_us', 'force_N', 'voltage_V'),
                  "column 'torque_N_m' is missing"),
    'grams in the header': (lambda r: r, ('pwm_us', 'force_g', 'torque_N_m', 'voltage_V'),
                            "'force_g' has another unit"),
    'grams': (lambda r: scaled(r, 1, 102.0), HEADER, 'expected newtons'),
    'millivolts': (lambda r: scaled(r, 3, 1000.0), HEADER, 'millivolts'),
    'pulse as duty': (lambda r: r, ('duty_percent', *HEADER[1:]), 'expected percent of 2000 us'),
    'duty as pulse': (lambda r: scaled(r, 0, 0.05), HEADER, 'expected microseconds'),
    'one duty': (lambda r: scaled(r, 0, 0.0) + [1500, 0, 0, 0], HEADER, 'expected a sweep'),
    'NaN': (lambda r: with_value(r, 3, 1, np.nan), HEADER, 'row 5, column force_N'),
    'few rows': (lambda r: r[:10], HEADER, '10 rows are too few'),
    'thrust falls': (lambda r: np.stack([3000 - r[:, 0], *r.T[1:]], axis=1)[r[:, 0] > 1100],
                     HEADER, 'thrust does not rise with duty'),
    'torque of noise': (lambda r: np.stack([r[:, 0], r[:, 1], np.random.default_rng(0).normal(
        size=len(r)), r[:, 3]], axis=1), HEADER, 'torque does not follow thrust'),
    'no plateau': (lambda r: np.stack([*r[:90:5].T[:3], np.linspace(15, 25, 18)], axis=1).repeat(
        2, axis=0), HEADER, 'no voltage plateau'),
    'both': (lambda r: np.concatenate([r, r[:, :1]], axis=1), (*HEADER, 'duty_percent'),
             'mean the same'),
}


@pytest.mark.parametrize('case', CASES)
def test_unusable_logs_are_refused(tmp_path, case):
    change, header, words = CASES[case]
    path = write(tmp_path / 'bad.csv', change(bench(np.random.default_rng(0))), header)
    with pytest.raises(LogError) as caught:
        identify_rotor(read_rotor_log(path))
    assert words in str(caught.value) and 'bad.csv' in str(caught.value)
    assert '\n' not in str(caught.value)
