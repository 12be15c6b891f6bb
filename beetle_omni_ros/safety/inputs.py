"""Inputs of the supervisor, and its time."""

from __future__ import annotations

from math import isfinite
from operator import eq

import numpy as np

from beetle_omni_ros.control.base import Command, corrected, State
from beetle_omni_ros.robot.allocation import Allocator
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.robot.readings import SpikeFilter
from beetle_omni_ros.safety.actuators import Actuators
from beetle_omni_ros.safety.descent import checked_sample
from beetle_omni_ros.safety.events import EventLog, INFO, WARNING
from beetle_omni_ros.safety.limits import JUMP, MEANINGS
from beetle_omni_ros.safety.parameters import SupervisorParameters
from beetle_omni_ros.safety.selection import Selection
from beetle_omni_ros.safety.vehicle import numbers, Vehicle
from beetle_omni_ros.safety.watch.faults import FaultWatch

TILT_AGE = 0.05     # [s] older joint angles are not used for thrust directions
VOLTAGE_END = 1000.0    # [V] from which a reading is refused
LATEST = 0.1    # [s] between a MoCap pose and the estimate for its check
IMU_AXES = (*(f'specific force along {axis}' for axis in 'xyz'),
            *(f'angular rate about {axis}' for axis in 'xyz'))
NONE_SAME = [0] * len(IMU_AXES)


class Inputs:
    """
    The inputs of the supervisor: checks and counts all messages.

    Attributes:
        events: what happened, oldest first.
        vehicle: the latest of estimate, joints, sensors and battery.
        actuators: reported states of the bridges to servos and motor board.
        watch: the detectors, with the detected faults.

    """

    def __init__(self, parameters: SupervisorParameters, robot: RobotParameters,
                 controllers: tuple[str, ...]):
        self._parameters, self._robot = parameters, robot
        self._selection = Selection(controllers, parameters.controller, parameters.commands, robot)
        self.vehicle = Vehicle(parameters, robot)
        self.actuators = Actuators()
        self._allocator = Allocator(robot)
        self.watch = FaultWatch(parameters.detection, robot, self._allocator)
        self._in_force: Command | None = None
        imu = parameters.detection.imu
        self._spikes = SpikeFilter(imu.force_change, imu.rate_change)
        self._sample: list[float] = []
        self._same = NONE_SAME      # samples for which each axis has kept its value
        self._floor = 0.0       # height of base_link on the ground before the flight [m]
        self.events = EventLog(parameters.quiet_time)
        self._now: float | None = None

    @property
    def active(self) -> str:
        """Name of the selected controller."""
        return self._selection.active

    def on_state(self, state: State, status: str = 'tracking') -> bool:
        """Receive the estimator's state and status; False when it is refused."""
        before = self.vehicle.status
        reading = numbers(state.tilt, 4)
        true = state if reading is None else corrected(state, self.watch.health)
        reason = self.vehicle.on_state(true, status, self._now, self.airborne)
        if reason:
            self._say(self._now, WARNING, f'ekf_node: estimate refused: {reason}', reason)
        elif reading is not None:
            self._watch_joints(state.tilt_stamp, reading)
        if not reason and status != before and status != 'tracking':
            self._say(self._now, WARNING, f"ekf_node reports '{status}'")
        return not reason

    def on_command(self, controller: str, command: Command, now: float) -> bool:
        """Check one command of one controller; False when it is refused (and counted)."""
        reason = self._selection.offer(controller, command, now)
        if reason:
            # A step to a new target causes one jump; repeated jumps end in the controller's
            # timeout.
            self._say(now, INFO if reason == JUMP else WARNING,
                      f'{controller}_node: command refused: {reason}{MEANINGS.get(reason, "")}',
                      f'{controller}: {reason}')
        return not reason

    def on_joints(self, stamp: float, position: np.ndarray, velocity: np.ndarray) -> bool:
        """Receive raw joint feedback (4,), nan where unknown."""
        reading = numbers(position, 4)
        if reading is None or self._ahead(stamp):
            return False
        good = self.vehicle.on_joints(stamp, self.watch.health.true(reading), velocity)
        if good:
            self._watch_joints(stamp, reading)
        return good

    def _watch_joints(self, stamp, reading):
        """Pass a reading (4,) to the detectors; a changed zero also applies to this reading."""
        if stamp <= self.watch.joint_stamp or not (
                isfinite(stamp) and all(map(isfinite, reading.tolist()))):
            return
        before = self.watch.health
        self.watch.on_joints(stamp, reading, self.airborne)
        if self.watch.health is not before and self.watch.health.zeros != before.zeros:
            self.vehicle.tilt = self.watch.health.true(reading)

    def on_imu(self, stamp: float, specific_force: np.ndarray,
               angular_velocity: np.ndarray) -> bool:
        """Receive a raw IMU sample (3,), (3,) in base_link, for the descent without estimator."""
        sample = checked_sample(stamp, specific_force, angular_velocity)
        if sample is None or self._ahead(stamp):
            return False
        _, force, rate = sample
        airborne = self.airborne
        if not self._is_real(force, rate, airborne) or not self.vehicle.backup.add(sample):
            return False
        self.vehicle.imu.reset()
        if airborne:
            known = stamp - self.vehicle.tilt_stamp < TILT_AGE
            self.watch.on_imu(stamp, force, rate, self.vehicle.tilt if known else None,
                              self._in_force, self._height)
        return True

    def _is_real(self, force, rate, airborne):
        """Whether a sample is neither a single spike nor one of many equal samples."""
        values, before = force.tolist() + rate.tolist(), self._sample
        self._sample = values
        if any(map(eq, values, before)):
            self._same = [count + 1 if value == last else 0
                          for count, value, last in zip(self._same, values, before)]
            if airborne and self._is_frozen():
                return False
        else:
            self._same = NONE_SAME
        return self._spikes.passes(force, rate)

    def _is_frozen(self):
        """
        Whether an IMU that repeats itself may not be used; names that.

        With one frozen axis the estimator still has MoCap, but the descent on raw sensors is
        better off without the IMU.
        """
        limits, now = self._parameters.detection.imu, self._now or 0.0
        if min(self._same) >= limits.frozen:
            self.watch.name('imu_frozen', now, 'the IMU repeats the same sample')
            return True
        longest = max(self._same)
        if longest >= limits.axis_frozen:
            axis = IMU_AXES[self._same.index(longest)]
            self.watch.name('imu_axis_frozen', now, f'the IMU repeats the same {axis}')
            return self.vehicle.backup.running
        return False

    def on_rotors(self, stamp: float, speed: np.ndarray) -> bool:
        """Receive the rotor speeds (4,) reported by the ESCs [rad/s], nan where unknown."""
        speed = np.asarray(speed, dtype=float)
        if self._ahead(stamp) or not isfinite(stamp) or speed.shape != (4,):
            return False
        if self.airborne:
            self.watch.on_speeds(stamp, speed)
        return True

    @property
    def airborne(self) -> bool:
        """Whether the robot flies, as far as known."""
        return False

    @property
    def _height(self):
        """Height of base_link above its height on the ground [m]; None if unknown."""
        vehicle = self.vehicle
        blind = vehicle.mocap.silent if vehicle.backup.running else vehicle.mocap_lost
        if blind or self._now is None:
            return None
        state = vehicle.backup_state(self._now) if vehicle.backup.running else vehicle.state
        return None if state is None else float(state.position[2]) - self._floor

    def on_mocap(self, stamp: float, position: np.ndarray, quaternion: np.ndarray) -> bool:
        """Receive a raw MoCap pose (3,), (4,) of base_link, for the descent without estimator."""
        vehicle = self.vehicle
        pose = vehicle.backup.checked_pose(stamp, position, quaternion)
        if pose is None or self._ahead(stamp):
            return False
        vehicle.backup.remember(pose)
        airborne = self.airborne
        if airborne and not self._agrees(*pose):
            return False
        vehicle.backup.use(pose)
        if airborne and vehicle.imu.silent:
            self.watch.without_imu(stamp, pose[1], self._height)
        vehicle.mocap.reset()
        return True

    def _agrees(self, stamp, position, quaternion):
        """Whether a MoCap pose is consistent with estimate and gyroscope."""
        vehicle = self.vehicle
        state = vehicle.backup_state(self._now) \
            if vehicle.backup.running and self._now is not None else vehicle.state
        known: tuple[np.ndarray | None, ...] = (None,) * 4
        if state is not None and abs(state.stamp - stamp) < LATEST:
            known = state.quaternion, state.angular_velocity, state.position, state.velocity
        good = self.watch.on_mocap(stamp, position, quaternion, *known)
        if good or 'estimator_wrong' in self.watch.faults:
            return True
        return False

    def on_battery(self, voltage: float) -> bool:
        """Receive the pack voltage under load [V]; refused if not finite, negative or absurd."""
        if not 0 <= voltage < VOLTAGE_END:
            return False
        self.vehicle.voltage = float(voltage)
        if self._now is not None:
            self.watch.on_voltage(self._now, self.vehicle.voltage)
        return True

    def on_actuators(self, name: str, text: str, now: float) -> bool:
        """
        Receive the reported state of an actuator bridge; the next update acts on it.

        Args:
            name: 'joint' or 'rotor'.
            text: 'ready', 'waiting: WHY', 'silent: WHY' or 'lost: WHY'.
            now: time [s].

        Returns:
            whether there is such a bridge.

        """
        known = self.actuators.update(name, text)
        self.vehicle.stuck = self.actuators.joints_lost
        if not known:
            self._say(now, WARNING, f"unknown bridge '{name}'", 'unknown bridge')
        return known

    def _tick(self, now):
        """Counted time since the last update; also after the clock was set back."""
        if not isfinite(now):
            return 0.0
        before, self._now = self._now, now
        if before is None:
            return 0.0
        if now < before:
            self._say(now, WARNING, f'the clock went back by {before - now:.3f} s')
            self.vehicle.clock_went_back(now, before - now)
            self.watch.restart(now)
            self._selection.clock_went_back(now)
            self._clock_went_back(now, before - now)
            return 0.0
        dt = min(now - before, self._parameters.tick_limit)
        self.vehicle.tick(dt)
        self._selection.tick(dt)
        return dt

    def _clock_went_back(self, now, by):
        """Implemented by the state machine."""

    def _ahead(self, stamp):
        return self._now is not None and stamp - self._now > self._parameters.state.timeout

    def _say(self, now, severity, text, key=None):
        stamp = now if now is not None and isfinite(now) else self._now or 0.0
        self.events.say(stamp, severity, text, key)
