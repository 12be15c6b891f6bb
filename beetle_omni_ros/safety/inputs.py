"""What comes into the supervisor, and its sense of time."""

from __future__ import annotations

from math import isfinite

import numpy as np

from beetle_omni_ros.control.base import Command, State
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.safety.actuators import Actuators
from beetle_omni_ros.safety.events import EventLog, WARNING
from beetle_omni_ros.safety.parameters import SupervisorParameters
from beetle_omni_ros.safety.selection import Selection
from beetle_omni_ros.safety.vehicle import Vehicle


class Inputs:
    """
    The inputs half of the supervisor: every message is checked here and counted.

    Attributes:
        events: what happened, oldest first.
        vehicle: the latest of estimate, joints, sensors and battery.
        actuators: what the bridges to servos and motor board say.

    """

    def __init__(self, parameters: SupervisorParameters, robot: RobotParameters,
                 controllers: tuple[str, ...]):
        self._parameters, self._robot = parameters, robot
        self._selection = Selection(controllers, parameters.controller, parameters.commands, robot)
        self.vehicle = Vehicle(parameters, robot)
        self.actuators = Actuators()
        self.events = EventLog(parameters.quiet_time)
        self._now: float | None = None

    @property
    def active(self) -> str:
        """Name of the selected controller."""
        return self._selection.active

    def on_state(self, state: State, status: str = 'tracking') -> bool:
        """Take the estimator's state with its status; False when it is refused."""
        before = self.vehicle.status
        reason = self.vehicle.on_state(state, status, self._now)
        if reason:
            self._say(self._now, WARNING, f'ekf_node: estimate refused: {reason}', reason)
        elif status != before and status != 'tracking':
            self._say(self._now, WARNING, f"ekf_node reports '{status}'")
        return not reason

    def on_command(self, controller: str, command: Command, now: float) -> bool:
        """Check one command of one controller; False when it is refused (and counted)."""
        reason = self._selection.offer(controller, command, now)
        if reason:
            self._say(now, WARNING, f'{controller}_node: command refused: {reason}',
                      f'{controller}: {reason}')
        return not reason

    def on_joints(self, stamp: float, position: np.ndarray, velocity: np.ndarray) -> bool:
        """Take raw joint feedback (4,), nan where unknown, beside what comes with the state."""
        return not self._ahead(stamp) and self.vehicle.on_joints(stamp, position, velocity)

    def on_imu(self, stamp: float, specific_force: np.ndarray,
               angular_velocity: np.ndarray) -> bool:
        """Take a raw IMU sample (3,), (3,) in base_link, for the descent without estimator."""
        good = not self._ahead(stamp) and self.vehicle.backup.on_imu(stamp, specific_force,
                                                                     angular_velocity)
        if good:
            self.vehicle.imu.heard()
        return good

    def on_mocap(self, stamp: float, position: np.ndarray, quaternion: np.ndarray) -> bool:
        """Take a raw MoCap pose (3,), (4,) of base_link, for the descent without estimator."""
        good = not self._ahead(stamp) and self.vehicle.backup.on_mocap(stamp, position, quaternion)
        if good:
            self.vehicle.mocap.heard()
        return good

    def on_rotors(self, stamp: float, speed: np.ndarray) -> bool:
        """Take rotor speeds (4,) [rad/s] from the speed controllers."""
        return True

    def on_battery(self, voltage: float) -> bool:
        """Take the pack voltage under load [V]; not finite or negative is refused."""
        if not (isfinite(voltage) and voltage >= 0):
            return False
        self.vehicle.voltage = float(voltage)
        return True

    def on_actuators(self, name: str, text: str, now: float) -> bool:
        """
        Take what the bridge to an actuator says of itself; the next update acts on it.

        Args:
            name: 'joint' or 'rotor'.
            text: 'ready', 'waiting: WHY', 'silent: WHY' or 'lost: WHY'.
            now: time [s].

        Returns:
            whether there is such a bridge.

        """
        known = self.actuators.tell(name, text)
        self.vehicle.stuck = self.actuators.joints_lost
        if not known:
            self._say(now, WARNING, f"unknown bridge '{name}'", 'unknown bridge')
        return known

    def _tick(self, now):
        """Time since the last update, as far as it counts; follows a clock that was set back."""
        if not isfinite(now):
            return 0.0
        before, self._now = self._now, now
        if before is None:
            return 0.0
        if now < before:
            self._say(now, WARNING, f'the clock went back by {before - now:.3f} s')
            self.vehicle.clock_went_back(now, before - now)
            self._selection.clock_went_back(now)
            self._clock_went_back(now, before - now)
            return 0.0
        dt = min(now - before, self._parameters.tick_limit)
        self.vehicle.tick(dt)
        self._selection.tick(dt)
        return dt

    def _clock_went_back(self, now, by):
        """For the state machine to follow."""

    def _ahead(self, stamp):
        return self._now is not None and stamp - self._now > self._parameters.state.timeout

    def _say(self, now, severity, text, key=None):
        stamp = now if now is not None and isfinite(now) else self._now or 0.0
        self.events.say(stamp, severity, text, key)
