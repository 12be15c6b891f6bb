"""Inputs of the supervisor, and its time."""

from __future__ import annotations

from math import isfinite

import numpy as np

from beetle_omni_ros.control.base import Command, corrected, State
from beetle_omni_ros.robot.allocation import Allocator
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.robot.readings import SpikeFilter
from beetle_omni_ros.safety.actuators import Actuators
from beetle_omni_ros.safety.events import EventLog, INFO, WARNING
from beetle_omni_ros.safety.limits import JUMP
from beetle_omni_ros.safety.parameters import SupervisorParameters
from beetle_omni_ros.safety.selection import Selection
from beetle_omni_ros.safety.vehicle import Vehicle
from beetle_omni_ros.safety.watch.faults import FaultWatch

TILT_AGE = 0.05     # [s] older joint angles are not used for thrust directions
VOLTAGE_END = 1000.0    # [V] from which a reading is refused
LATEST = 0.1    # [s] between a MoCap pose and the estimate for its check
IMU_AXES = (*(f'specific force along {axis}' for axis in 'xyz'),
            *(f'angular rate about {axis}' for axis in 'xyz'))


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
        self._sample: tuple[float, ...] = ()
        self._same = [0] * len(IMU_AXES)    # samples for which an axis has kept its value
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
        true = corrected(state, self.watch.health)
        reason = self.vehicle.on_state(true, status, self._now)
        if reason:
            self._say(self._now, WARNING, f'ekf_node: estimate refused: {reason}', reason)
        else:
            self._watch_joints(state.tilt_stamp, state.tilt)
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
                      f'{controller}_node: command refused: {reason}', f'{controller}: {reason}')
        return not reason

    def on_joints(self, stamp: float, position: np.ndarray, velocity: np.ndarray) -> bool:
        """Receive raw joint feedback (4,), nan where unknown."""
        good = np.shape(position) == (4,) and not self._ahead(stamp) \
            and self.vehicle.on_joints(stamp, self.watch.health.true(position), velocity)
        if good:
            self._watch_joints(stamp, np.asarray(position, dtype=float))
        return good

    def _watch_joints(self, stamp, reading):
        """Pass a reading (4,) to the detectors; a changed zero also applies to this reading."""
        if not (isfinite(stamp) and all(map(isfinite, reading.tolist()))):
            return
        zeros = self.watch.health.zeros
        self.watch.on_joints(stamp, reading, self.airborne)
        if self.watch.health.zeros != zeros:
            self.vehicle.tilt = self.watch.health.true(reading)

    def on_imu(self, stamp: float, specific_force: np.ndarray,
               angular_velocity: np.ndarray) -> bool:
        """Receive a raw IMU sample (3,), (3,) in base_link, for the descent without estimator."""
        good = not self._ahead(stamp) and self._is_real(specific_force, angular_velocity) \
            and self.vehicle.backup.on_imu(stamp, specific_force, angular_velocity)
        if good:
            self.vehicle.imu.reset()
            if self.airborne:
                known = stamp - self.vehicle.tilt_stamp < TILT_AGE
                self.watch.on_imu(stamp, np.asarray(specific_force, dtype=float),
                                  np.asarray(angular_velocity, dtype=float),
                                  self.vehicle.tilt if known else None, self._in_force,
                                  self._height)
        return good

    def _is_real(self, specific_force, angular_velocity):
        """Whether a sample is neither a single spike nor one of many equal samples."""
        try:
            force, rate = (np.asarray(vector, dtype=float).reshape(3)
                           for vector in (specific_force, angular_velocity))
        except (TypeError, ValueError):
            return False
        values = (*force.tolist(), *rate.tolist())
        if not all(map(isfinite, values)):
            return False
        self._same = [count + 1 if value == before else 0 for count, value, before in zip(
            self._same, values, self._sample or (None,) * len(values))]
        self._sample = values
        return not (self.airborne and self._is_frozen()) and self._spikes.passes(force, rate)

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
        if self._ahead(stamp) or not vehicle.backup.is_pose(stamp, position, quaternion):
            return False
        vehicle.backup.remember(stamp, position, quaternion)
        if self.airborne and not self._agrees(stamp, position, quaternion):
            return False
        good = vehicle.backup.on_mocap(stamp, position, quaternion)
        if good and self.airborne and vehicle.imu.silent:
            self.watch.without_imu(stamp, position, self._height)
        if good:
            vehicle.mocap.reset()
        return good

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
