"""The interface of the simulator, its battery and its command link."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from sim_robots import HIGH, ROBOT, WORLD

from beetle_omni_ros.control.base import Command
from beetle_omni_ros.sim.simulator import Battery, CommandLink, Simulator

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


# Battery --------------------------------------------------------------------------------------

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
    battery.reset()
    assert battery.charge == WORLD.battery_charge


def test_the_thrust_limit_equals_that_of_the_map_and_falls_below_it():
    battery = Battery(ROBOT, WORLD)
    for row in ROBOT.rotors.map:
        battery.voltage = row.voltage
        assert battery.thrust_limit == pytest.approx(min(row.thrust_max, ROBOT.rotors.thrust_max))
    battery.voltage = 20.0
    below = battery.thrust_limit
    battery.voltage = 21.40
    assert 0 < below < battery.thrust_limit


# Command link ---------------------------------------------------------------------------------

def link():
    """A link under nominal conditions: 10 ms delay, 100 ms timeout."""
    return CommandLink(ROBOT, WORLD.command_timeout, (0.01, 0.01))


def command(stamp, tilt=0.1, thrust=5.0):
    return SimpleNamespace(stamp=stamp, tilt=np.full(4, tilt), thrust=np.full(4, thrust))


def test_command_acts_at_stamp_plus_delay():
    made = link()
    assert made.push(command(0.0), 0.0)
    made.update(0.0099)
    assert made.thrust[0] == 0
    made.update(0.010)
    assert made.thrust[0] == 5 and made.tilt[0] == 0.1


def test_late_command_acts_at_once_but_never_overtakes_a_newer_one():
    made = link()
    made.push(command(1.000, thrust=5), 1.020)
    made.update(1.020)
    assert made.thrust[0] == 5
    assert made.push(command(1.015, thrust=7), 1.020)
    assert not made.push(command(1.010, thrust=6), 1.021)
    made.update(1.025)
    assert made.thrust[0] == 7


@pytest.mark.parametrize('field, value', [
    ('tilt', np.array([0, np.nan, 0, 0])), ('stamp', 1e9)], ids=['not finite', 'future'])
def test_unusable_command_is_refused(field, value):
    made, bad = link(), command(0.0)
    setattr(bad, field, value)
    assert not made.push(bad, 0.0)
    assert made.push(command(0.0), 0.0)


def test_targets_are_clipped_to_the_limits():
    made = link()
    made.push(command(0.0, tilt=9.0, thrust=50.0), 0.0)
    made.update(0.01)
    np.testing.assert_array_equal(made.tilt, ROBOT.joints.position_limit)
    np.testing.assert_array_equal(made.thrust, ROBOT.rotors.thrust_max)
    made.push(command(0.005, tilt=-9.0, thrust=-5.0), 0.01)
    made.update(0.02)
    np.testing.assert_array_equal(made.tilt, -ROBOT.joints.position_limit)
    np.testing.assert_array_equal(made.thrust, ROBOT.rotors.thrust_min)


def test_rotors_stop_when_commands_cease_and_tilts_hold():
    made = link()
    made.push(command(0.0), 0.0)
    made.update(0.095)
    assert made.thrust[0] == 5
    made.update(0.100)
    assert made.thrust[0] == 0 and made.tilt[0] == 0.1
    made.push(command(0.2), 0.2)
    made.update(0.21)
    assert made.thrust[0] == 5


def test_a_command_acts_in_the_same_tick_whatever_the_epoch_of_the_stamps():
    tilts = []
    for epoch in (0.0, 1.8e9):
        simulator, acted = Simulator(ROBOT, epoch=epoch), []
        for k in range(60):
            frame = simulator.step()
            simulator.command(Command(frame.imu.stamp - epoch, np.full(4, 0.01 * k),
                                      np.full(4, 7.0)))
            acted.append(simulator.link.tilt[0])
        tilts.append(acted)
    assert tilts[0] == tilts[1] and tilts[0][-1] > 0
