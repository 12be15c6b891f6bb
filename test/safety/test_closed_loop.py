"""Takeoff, fallback and descents on the simulated robot with its sensors, delays and ground."""

from dataclasses import replace

import numpy as np
import pytest

from beetle_omni_ros.control.base import PoseTarget, State
from beetle_omni_ros.control.hover import HoverController
from beetle_omni_ros.robot import rotations
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.safety.parameters import SupervisorParameters
from beetle_omni_ros.safety.supervisor import Supervisor

simulator = pytest.importorskip('beetle_omni_ros.sim.simulator')
ROBOT = RobotParameters.load()
LEVEL = np.array([0.0, 0.0, 0.0, 1.0])
ARM_AT = 0.6


class Flight:
    """Simulator and supervisor; a hover controller plays the NMPC, the truth the estimator."""

    def __init__(self, attitude=LEVEL, conditions='nominal', seed=0):
        self.sim = simulator.Simulator(ROBOT, conditions=conditions, seed=seed)
        self.supervisor = Supervisor(SupervisorParameters.load(), ROBOT, HoverController(ROBOT))
        self.nmpc = HoverController(ROBOT)
        self.target = PoseTarget(np.array([0, 0, 1.0]), attitude)
        self.alive = {'ekf', 'nmpc', 'imu', 'mocap', 'joints'}
        self.in_force, self.joints = None, None
        self.height, self.touchdown_speed, self.armed = [], None, False

    def run(self, until):
        while self.sim.time < until - 1e-9:
            frame = self.sim.step()
            self._publish(frame)
            before = self.supervisor.state
            if not self.armed and self.sim.time >= ARM_AT:
                assert self.supervisor.arm(self.sim.time)
                self.armed = True
            command = self.supervisor.update(self.sim.time)
            if command is not None:
                self.sim.command(command)
                self.in_force = command
            self._look(frame.truth, before)
        return self

    def off(self):
        return self.supervisor.state in ('disarmed', 'emergency_stop')

    def _publish(self, frame):
        supervisor, truth, self.joints = self.supervisor, frame.truth, frame.joints or self.joints
        if frame.imu and 'imu' in self.alive:
            supervisor.on_imu(frame.imu.stamp, frame.imu.specific_force,
                              frame.imu.angular_velocity)
        if frame.mocap and 'mocap' in self.alive:
            supervisor.on_mocap(frame.mocap.stamp, frame.mocap.position, frame.mocap.quaternion)
        if self.joints is None:
            return
        if 'joints' in self.alive:
            supervisor.on_joints(self.joints.stamp, self.joints.position, self.joints.velocity)
        known = self.joints.stamp if 'joints' in self.alive else float('nan')
        state = State(frame.time, truth.position, truth.velocity, truth.quaternion,
                      truth.angular_velocity, self.joints.position, self.joints.velocity, known,
                      self.in_force)
        if 'ekf' in self.alive:
            supervisor.on_state(state)
            if 'nmpc' in self.alive:
                supervisor.on_command('nmpc', self.nmpc.step(state, self.target), frame.time)

    def _look(self, truth, before):
        self.height.append(truth.position[2])
        if before == 'landing' and truth.contact and self.touchdown_speed is None:
            self.touchdown_speed = self._sinking
        self._sinking = -truth.velocity[2]


def test_takes_off_and_survives_a_silent_controller():
    flight = Flight().run(5.0)
    assert flight.supervisor.state == 'flying'
    assert abs(flight.sim.truth.position[2] - 1.0) < 0.05
    held = flight.sim.truth.position.copy()
    flight.alive.discard('nmpc')
    flight.run(7.0)
    assert flight.supervisor.state == 'fallback'
    assert np.linalg.norm(flight.sim.truth.position - held) < 0.05
    assert np.linalg.norm(flight.sim.truth.velocity) < 0.05
    flight.alive.add('nmpc')
    flight.run(7.7)
    assert flight.supervisor.state == 'flying'


def test_lands_on_request():
    flight = Flight().run(4.0)
    assert flight.supervisor.land(flight.sim.time)
    flight.run(9.0)
    assert flight.supervisor.state == 'disarmed'
    assert flight.touchdown_speed < 0.4
    assert flight.sim.truth.contact and flight.sim.truth.thrust.max() < 0.1
    assert max(flight.height[-100:]) - min(flight.height[-100:]) < 0.01   # no bounce, no crash


@pytest.mark.parametrize('dead, conditions', [
    ({'ekf'}, 'nominal'), ({'ekf'}, 'published'), ({'ekf', 'mocap'}, 'nominal'),
    ({'ekf', 'imu'}, 'nominal'), ({'joints'}, 'nominal')])
def test_descends_on_remaining_sensors_and_stops_the_motors_at_the_ground(dead, conditions):
    flight = Flight(conditions=conditions).run(5.0)
    assert flight.supervisor.state == 'flying'
    flight.alive -= dead
    flight.run(14.0)
    assert flight.supervisor.state == 'disarmed', flight.supervisor.events
    assert flight.sim.truth.contact and flight.sim.truth.thrust.max() < 0.1
    assert flight.touchdown_speed < 0.5
    assert np.linalg.norm(flight.sim.truth.position[:2]) < 0.5


def test_descent_from_inverted_attitude_levels_first():
    flight = Flight(attitude=rotations.from_rpy(np.pi - 0.2, 0.1, 0.5)).run(8.0)
    assert rotations.geodesic_angle(flight.sim.truth.quaternion, LEVEL) > 2.5
    flight.alive.discard('ekf')
    flight.run(17.0)
    assert flight.supervisor.state == 'disarmed'
    assert flight.touchdown_speed < 0.5
    assert rotations.matrix(flight.sim.truth.quaternion)[2, 2] > 0.99


def test_emergency_stop_cuts_the_thrust_at_once():
    flight = Flight().run(4.0)
    flight.supervisor.emergency_stop(flight.sim.time)
    flight.run(4.5)
    assert flight.off() and flight.sim.truth.thrust.max() < 0.2
    assert not flight.supervisor.arm(flight.sim.time)


@pytest.mark.parametrize('signs', [(1, 1, 1, 1), (-1, 1, -1, 1)])
def test_lands_softly_from_inverted_attitude_with_all_joints_wound_adversely(signs):
    flight = Flight().run(5.0)
    flight.target = PoseTarget(np.array([0.0, 0.0, 1.5]), rotations.from_rpy(np.pi, 0.0, 0.0))
    flight.run(11.0)
    plant, supervisor, link = flight.sim._plant, flight.supervisor, flight.sim._actuate
    plant._tilt += np.where(np.sign(plant._tilt) != signs, 2 * np.pi * np.array(signs), 0)

    def nearest(tilt):
        return tilt + 2 * np.pi * np.round((plant._tilt - tilt) / (2 * np.pi))

    # Readings, commands and targets turn, too.
    flight.sim._actuate = lambda tilt, *rest: link(
        nearest(np.array(tilt)) if flight.sim.time < 11.15 else tilt, *rest)
    while flight.sim.time < 11.12:
        supervisor.watch.restart(flight.sim.time)
        supervisor._in_force = flight.in_force = replace(
            supervisor._in_force, tilt=nearest(supervisor._in_force.tilt))
        flight.run(flight.sim.time + 0.01)
    assert supervisor.land(flight.sim.time)
    flight.run(36.0)
    assert flight.off() and not flight.sim.truth.broken
    assert flight.touchdown_speed < 0.6
