"""Coupled devices and simulator: timing as without devices, effects of faults."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from sim_robots import HIGH, ROBOT, WORLD

from beetle_omni_ros.control.base import Command
from beetle_omni_ros.robot.schema import ParameterError
from beetle_omni_ros.sim.emulated import (
    BoardFaults,
    ServoFaults,
    switched_on,
)
from beetle_omni_ros.sim.emulated.motor_board import EmulatedMotorBoard
from beetle_omni_ros.sim.emulated.servo_bus import EmulatedServoBus
from beetle_omni_ros.sim.emulated_actuators import EmulatedActuators
from beetle_omni_ros.sim.simulator import Simulator

HOVER = ROBOT.hover_thrust


class Bus:
    """Servos that take their goals without delay, and store their sensor values."""

    def __init__(self):
        self.goals, self.powered, self.stopped = [0.0] * 4, [True] * 4, [False] * 4
        self.shown = []

    def drive(self):
        return list(self.goals), list(self.powered), list(self.stopped)

    def set_state(self, position, velocity, effort):
        self.shown.append((position.copy(), velocity.copy(), effort.copy()))


class Board:
    """A board with prescribed thrusts."""

    def __init__(self):
        self.thrust_targets = np.zeros(4)

    def set_rotors(self, thrust):
        self.rotors = thrust

    def set_battery(self, voltage, current, error=(0.0, 0.0)):
        self.pack, self.error = (voltage, current), error


def coupled(conditions='nominal', seed=0):
    """A flying simulator with those devices."""
    simulator = Simulator(ROBOT, WORLD, conditions, seed)
    simulator.reset(HIGH)
    return EmulatedActuators(simulator, Bus(), Board()), simulator


def wave(k):
    """Tilts and thrusts of command ``k``."""
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


def test_a_stopped_servo_holds_its_true_angle_despite_encoder_faults():
    actuators, simulator = coupled('published', seed=2)
    actuators.bus.goals = [1.0] * 4
    for _ in range(7):
        actuators.step()
    actuators.bus.stopped = [True] * 4
    actuators.bus.goals = [-2.0] * 4
    where = simulator.truth.tilt
    assert np.all(simulator.truth.tilt_velocity > 1.0)      # in the middle of its way
    for _ in range(100):
        actuators.step()
    np.testing.assert_allclose(simulator.truth.tilt, where, atol=0.02)
    actuators.bus.stopped = [False] * 4
    for _ in range(150):
        actuators.step()
    np.testing.assert_allclose(simulator.truth.tilt, -2.0, atol=0.1)


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


def test_the_board_receives_pack_and_rotor_states():
    actuators, simulator = coupled()
    actuators.board.thrust_targets = np.full(4, HOVER)
    errors = []
    for _ in range(400):
        actuators.step()
        errors.append(actuators.board.error)
    battery = simulator.battery
    assert actuators.board.pack == (battery.voltage, battery.current)
    assert battery.current > 10 and battery.voltage < ROBOT.battery.full_voltage
    np.testing.assert_array_equal(actuators.board.rotors, simulator.truth.thrust)
    deviation = np.std(errors, axis=0)
    expected = [WORLD.battery.voltage_noise, WORLD.battery.current_noise]
    np.testing.assert_allclose(deviation, expected, rtol=0.15)


# --- fault switches ---------------------------------------------------------------------------


@pytest.fixture
def devices():
    """Emulated devices on a simulated robot."""
    with EmulatedActuators(Simulator(ROBOT, WORLD), EmulatedServoBus(reboot_time=0.05),
                           EmulatedMotorBoard(ROBOT)) as made:
        yield made


@pytest.mark.real_time
def test_every_fault_level_reaches_its_device_and_can_be_reset(devices):
    servo = ServoFaults(
        bad_crc=0.1, dropped=0.2, delayed=0.3, delay=0.04, silent=np.array([2.0]),
        overload=np.array([1.0, 3.0]), overheated=np.array([4.0]), supply_voltage=5.0)
    board = BoardFaults(
        corrupt_out=0.1, corrupt_in=0.2, drop_out=0.3, drop_in=0.4, delay_out=0.5, delay_in=0.6,
        mute=True, voltage_sag=2.0, failed_escs=np.array([1.0, 4.0]))
    devices.set_faults(servo, board)
    assert devices.bus.faults is servo and devices.board.faults is board
    assert {'servo silent [2]', 'board mute', 'board voltage_sag 2'} <= set(devices.faults)
    assert len(devices.faults) == 7 + 9         # all but how late
    devices.set_faults(ServoFaults(), BoardFaults())
    assert switched_on(devices.bus.faults) == switched_on(devices.board.faults) == []
    assert devices.faults == []


@pytest.mark.real_time
def test_events_happen_each_time_they_are_set(devices):
    servo = devices.bus.servos[2]
    servo['Torque Enable'] = 1
    devices.set_faults(ServoFaults(expire_watchdog=3), BoardFaults())
    assert servo.expired and not devices.bus.servos[0].expired
    devices.set_faults(ServoFaults(reboot=3), BoardFaults(reboot=True))
    assert not servo.torque and not servo.expired
    assert devices.faults == []
    servo['Torque Enable'] = 1
    devices.set_faults(ServoFaults(), BoardFaults())
    assert servo.torque


@pytest.mark.real_time
@pytest.mark.parametrize(('servo', 'board', 'text'), [
    ({'silent': np.array([7.0])}, {}, r'servo_faults.silent: no servo has the id 7; ids are'),
    ({'overload': np.array([1.5])}, {}, r'servo_faults.overload: no servo has the id 1.5'),
    ({'reboot': 9}, {}, 'servo_faults.reboot: no servo has the id 9'),
    ({}, {'failed_escs': np.array([1.5])}, 'board_faults.failed_escs: expected rotors 1 to 4')])
def test_an_unknown_fault_is_refused_without_effect(devices, servo, board, text):
    with pytest.raises(ParameterError, match=text):
        devices.set_faults(replace(ServoFaults(), dropped=0.5, **servo),
                           replace(BoardFaults(), mute=True, **board))
    assert devices.faults == [] and devices.bus.faults.dropped == 0
    assert not devices.board.faults.mute


@pytest.mark.real_time
def test_unplugging_removes_the_ports_and_plugging_restores_them(devices):
    ports = [Path(devices.bus.port), Path(devices.board.port)]
    there = [port.exists() for port in ports]
    devices.set_faults(ServoFaults(unplugged=True), BoardFaults(unplugged=True))
    away = [port.exists() for port in ports]
    assert devices.faults == ['servo unplugged', 'board unplugged']
    devices.set_faults(ServoFaults(), BoardFaults())
    back = [port.exists() for port in ports]
    assert (there, away, back) == ([True] * 2, [False] * 2, [True] * 2)
    assert switched_on(ServoFaults(delay=0.5, reboot=2)) == []
