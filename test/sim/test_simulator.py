"""The interface of the simulator."""

from dataclasses import replace

import numpy as np
import pytest
from sim_robots import HIGH, ROBOT, WORLD

from beetle_omni_ros.control.base import Command
from beetle_omni_ros.sim.simulator import Simulator

HOVER = np.full(4, ROBOT.hover_thrust)


def numbers(simulator, ticks=300):
    values = []
    for k in range(ticks):
        if k % 2 == 0:
            simulator.command(Command(simulator.time, 0.3 * np.sin(0.1 * k + np.arange(4)), HOVER))
        frame = simulator.step()
        values += [frame.imu.specific_force, frame.imu.angular_velocity, frame.truth.position,
                   frame.joints.position, frame.truth.thrust]
        if frame.mocap is not None:
            values += [frame.mocap.position, frame.mocap.quaternion]
        if frame.battery is not None:
            values.append([frame.battery.voltage, frame.battery.current])
    return np.concatenate(values)


@pytest.mark.parametrize('conditions', ['nominal', 'published'])
def test_same_seed_same_numbers_other_seed_others(conditions):
    first = Simulator(ROBOT, WORLD, conditions, seed=7)
    expected = numbers(first)
    np.testing.assert_array_equal(numbers(Simulator(ROBOT, WORLD, conditions, seed=7)), expected)
    first.wrench[0], first.payload = 1.0, 0.5
    first.reset()
    np.testing.assert_array_equal(numbers(first), expected)
    assert np.any(numbers(Simulator(ROBOT, WORLD, conditions, seed=8)) != expected)


@pytest.mark.parametrize(('charge', 'low', 'high'), [(1.0, 13.9, 14.1), (0.05, 1.0, 13.0)])
def test_weak_battery_caps_the_thrust(charge, low, high):
    simulator = Simulator(ROBOT, replace(WORLD, battery_charge=charge))
    simulator.reset(HIGH)
    for _ in range(100):
        simulator.command(Command(simulator.time, np.zeros(4), np.full(4, 14.0)))
        frame = simulator.step()
    assert low < frame.truth.thrust[0] < high


def test_broken_state_is_an_error_and_not_a_silent_restart():
    simulator = Simulator(ROBOT, WORLD)
    simulator.reset(HIGH)
    simulator.wrench[[0, 4]] = 1e200
    with pytest.raises(RuntimeError, match='the simulated plant diverged'):
        for _ in range(5):
            simulator.step()
    simulator.reset(HIGH)
    assert np.isfinite(simulator.step().truth.position).all()
