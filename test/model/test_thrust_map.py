"""The thrust map: the cubics, their inverse, between voltages, beyond the rows."""

from dataclasses import replace

from hypothesis import given, settings, strategies
import numpy as np
import pytest

from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.model.parts import duty_of_command, FULL_DUTY, RotorMapRow, ThrustMap
from beetle_omni_ros.model.schema import ParameterError

ROTORS = RobotParameters.load().rotors
MAP = ThrustMap(ROTORS)
VOLTAGES = strategies.floats(21.4, 25.1)


def cubic_thrust(row, duty):
    """Solve a row's cubic for the thrust [N]: an oracle without a table."""
    coefficients = row.coefficients.copy()
    coefficients[0] -= duty
    roots = 10 * np.polynomial.polynomial.polyroots(coefficients)
    real = roots[np.abs(roots.imag) < 1e-9].real
    return real[(real >= -1e-9) & (real <= row.thrust_max + 1e-6)]


@pytest.mark.parametrize('row', ROTORS.map, ids=lambda row: f'{row.voltage} V')
def test_at_a_measured_voltage_the_map_equals_the_cubic(row):
    for thrust in np.linspace(0.01, row.thrust_max, 57):
        oracle = cubic_thrust(row, float(MAP.duty(thrust, row.voltage)))
        assert len(oracle) == 1
        assert oracle[0] == pytest.approx(thrust, rel=1e-4)


@settings(max_examples=300, deadline=None)
@given(strategies.floats(0, 1), VOLTAGES)
def test_round_trip_through_a_float32_command_is_exact(share, voltage):
    thrust = 0.5 + share * (MAP.thrust_limit(voltage) - 0.5)
    sent = np.float32(MAP.command(thrust, voltage))
    back = MAP.thrust(duty_of_command(float(sent)), voltage)
    assert back == pytest.approx(thrust, rel=2e-6)


def test_interpolation_between_voltages_predicts_an_omitted_row():
    """Within 0.15 N, 0.7 % of the range; interpolation at equal thrust misses by 0.22 N."""
    for k in (1, 2, 3):
        rows = sorted(ROTORS.map, key=lambda row: row.voltage)
        left_out = rows.pop(k)
        others = ThrustMap(replace(ROTORS, map=tuple(rows)))
        thrust = np.linspace(0.5, left_out.thrust_max - 0.3, 100)
        assert np.abs(others.thrust(MAP.duty(thrust, left_out.voltage), left_out.voltage)
                      - thrust).max() < 0.15


def test_saturation_is_reported_and_limited():
    thrust = np.array([0.0, 5.0, 21.0, 30.0])
    assert MAP.saturated(thrust, 21.4).tolist() == [False, False, True, True]
    assert MAP.saturated(thrust, 25.09).tolist() == [False, False, False, True]
    assert MAP.duty(30.0, 21.4) == MAP.duty(MAP.thrust_limit(21.4), 21.4) < FULL_DUTY
    assert MAP.thrust(FULL_DUTY, 21.4) == MAP.thrust_limit(21.4)


@pytest.mark.parametrize('coefficients', [[52, 30, -32, 10], [52, 20, -20, 0]])
def test_a_map_with_a_falling_part_is_refused(coefficients):
    row = RotorMapRow(voltage=23.0, thrust_max=16.0, coefficients=np.array(coefficients, float))
    with pytest.raises(ParameterError, match='at 23 V: duty .* expected a rise'):
        ThrustMap(replace(ROTORS, map=(row,)))


def test_the_limit_falls_below_the_lowest_row_and_is_constant_with_one_row():
    lowest, *rest = sorted(ROTORS.map, key=lambda row: row.voltage)
    slope = (rest[0].thrust_max - lowest.thrust_max) / (rest[0].voltage - lowest.voltage)
    assert MAP.thrust_limit_below(lowest.voltage - 1) == pytest.approx(lowest.thrust_max - slope)
    one = ThrustMap(replace(ROTORS, map=(lowest,)))
    assert one.thrust_limit_below(lowest.voltage - 1) == lowest.thrust_max
