"""Coupled devices and simulator: timing as without devices, effects of faults."""

import numpy as np
import pytest
from sim_robots import HIGH, ROBOT, WORLD

from beetle_omni_ros.control.base import Command
from beetle_omni_ros.sim.emulated.device import EmulatedActuators
from beetle_omni_ros.sim.simulator import Simulator

HOVER = ROBOT.hover_thrust


class Bus:
    """Servos that take their goals without delay, and store their sensor values."""

    def __init__(self):
        self.goals, self.powered = [0.0] * 4, [True] * 4
        self.shown = []

    def drive(self):
        return list(self.goals), list(self.powered)

    def set_state(self, position, velocity, effort):
        self.shown.append((position.copy(), velocity.copy(), effort.copy()))


class Board:
    """A board with prescribed thrusts."""

    def __init__(self):
        self.thrust_targets = np.zeros(4)

    def set_rotors(self, thrust):
        self.rotors = thrust

    def set_battery(self, voltage, current):
        self.pack = voltage, current


def coupled(conditions='nominal', seed=0):
    simulator = Simulator(ROBOT, WORLD, conditions, seed)
    simulator.reset(HIGH)
    return EmulatedActuators(simulator, Bus(), Board()), simulator


def wave(k):
    return 0.4 * np.sin(0.05 * k + np.arange(4)), HOVER + np.cos(0.1 * k + np.arange(4))


@pytest.mark.parametrize(('conditions', 'seed'), [('nominal', 0), ('published', 1),
                                                  ('published', 5)])
def test_a_command_acts_at_the_time_of_the_direct_path(conditions, seed):
    direct = Simulator(ROBOT, WORLD, conditions, seed)
    direct.reset(HIGH)
    actuators, simulator = coupled(conditions, seed)
    for k in range(200):
        tilt, thrust = wave(k)
        direct.command(Command(direct.time, tilt, thrust))
        expected = direct.step()
        actuators.bus.goals, actuators.board.thrust_targets = tilt, thrust
        frame = actuators.step()
        if k < 10:
            continue        # without a command yet, servos have torque on one path only
        np.testing.assert_allclose(frame.truth.thrust, expected.truth.thrust, atol=1e-6)
        np.testing.assert_allclose(frame.truth.tilt, expected.truth.tilt, atol=0.02)
    assert simulator.time == direct.time
    np.testing.assert_allclose(frame.truth.tilt, expected.truth.tilt, atol=2e-3)
    np.testing.assert_allclose(frame.truth.position, expected.truth.position, atol=5e-3)


def test_a_servo_without_torque_does_not_drive_and_shows_no_current():
    actuators, simulator = coupled()
    actuators.bus.powered = [True, False, True, True]
    actuators.bus.goals = [0.5] * 4
    for _ in range(60):
        frame = actuators.step()
    assert abs(frame.truth.tilt[1]) < 0.2 and np.all(frame.truth.tilt[[0, 2, 3]] > 0.4)
    efforts = np.array([effort for _, _, effort in actuators.bus.shown])
    assert np.all(efforts[:, 1] == 0) and np.all(np.abs(efforts).max(axis=0)[[0, 2, 3]] > 0.01)


def test_devices_receive_angles_of_their_encoders():
    actuators, simulator = coupled('published', seed=3)
    errors = []
    for _ in range(400):
        actuators.step()
        position, velocity, _ = actuators.bus.shown[-1]
        errors.append(position - simulator.truth.tilt)
        np.testing.assert_array_equal(velocity, simulator.truth.tilt_velocity)
    bias = simulator.conditions.tilt_bias
    np.testing.assert_allclose(np.mean(errors, axis=0), bias, atol=5e-3)
    width = simulator.conditions.tilt_uniform_noise
    assert np.all(np.abs(errors - bias) <= width + 1e-12) and np.ptp(errors - bias) > 1.8 * width
    actuators, simulator = coupled()
    actuators.step()
    np.testing.assert_array_equal(actuators.bus.shown[-1][0], simulator.truth.tilt)
