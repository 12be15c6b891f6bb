"""The battery: sag under load, voltage by charge, thrust limit."""

import numpy as np
import pytest
from sim_robots import ROBOT, WORLD

from beetle_omni_ros.sim.simulator import Battery

HOVER = np.full(4, ROBOT.hover_thrust)


def test_ohms_law_and_the_power_balance_hold():
    battery = Battery(ROBOT, WORLD)
    rest = battery.rest_voltage
    battery.step(HOVER, 1e-6)
    power = WORLD.idle_power + WORLD.rotor_power * (HOVER ** 1.5).sum()
    assert rest == pytest.approx(ROBOT.battery.full_voltage)
    assert battery.voltage == pytest.approx(rest - ROBOT.battery.resistance * battery.current)
    assert battery.voltage * battery.current == pytest.approx(power)


def test_rest_voltage_falls_with_the_charge_drawn():
    battery = Battery(ROBOT, WORLD)
    voltages, drawn = [battery.rest_voltage], 0.0
    for _ in range(30):
        battery.step(HOVER, 60.0)
        drawn += battery.current * 60 / 3600
        voltages.append(battery.rest_voltage)
    assert np.all(np.diff(voltages) < 0)
    assert battery.charge == pytest.approx(1 - drawn / WORLD.battery_capacity)
    assert battery.drawn == pytest.approx(drawn)
    battery.reset()
    assert battery.drawn == 0


def test_the_thrust_limit_equals_that_of_the_map_and_falls_below_it():
    battery = Battery(ROBOT, WORLD)
    for row in ROBOT.rotors.map:
        battery.voltage = row.voltage
        assert battery.thrust_limit == pytest.approx(min(row.thrust_max, ROBOT.rotors.thrust_max))
    battery.voltage = 20.0
    below = battery.thrust_limit
    battery.voltage = 21.40
    assert 0 < below < battery.thrust_limit
