"""What the supervisor receives: checks, the latest data of each source, its silence and time."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from itertools import chain
from math import dist, hypot, isfinite

import numpy as np

from beetle_omni_ros.control.base import Command, corrected, State
from beetle_omni_ros.estimation.inputs import SpikeFilter
from beetle_omni_ros.model import rotations
from beetle_omni_ros.model.allocation import ActuatorHealth, Allocator
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.supervisor import commands
from beetle_omni_ros.supervisor.backup import BackupEstimator
from beetle_omni_ros.supervisor.detectors import FaultWatch
from beetle_omni_ros.supervisor.interface import Event, INFO, SupervisorParameters, WARNING
from beetle_omni_ros.supervisor.way import inclination

TICK_LIMIT = 0.02       # [s] a longer pause of the supervisor counts as this for the sources
ESTIMATE_TIMEOUT = 0.05     # [s] 10 periods of 200 Hz
STALE_AFTER = 0.05      # [s] older estimates are refused
TOO_SLOW = 'the computer is too slow'   # end of a refusal to arm
JOINT_TIMEOUT = ROTORS_TIMEOUT = 0.2    # [s]
IMU_TIMEOUT = 0.05      # [s]
MOCAP_TIMEOUT = 0.2     # [s]
ABSURD = 1e4            # [m, m/s, m/s^2, rad/s] length beyond any robot and sensor; no overflow
VOLTAGES = 1.0, 1000.0  # [V] plausible readings; that of a disconnected sensor is smaller
UNIT_TOLERANCE = 0.02   # of a quaternion's squared length
JUMP_POSITION, JUMP_ATTITUDE = 1.0, 1.0     # [m], [rad] a single larger jump of the estimate is
                        # refused, a lasting one is accepted with the next. 20 m/s and 20 rad/s
TILT_AGE = 0.05         # [s] older joint angles are not used for thrust directions
POSE_AGE = 0.1          # [s] between a MoCap pose and the estimate for its check
IMU_FROZEN = 10         # equal samples; noise never repeats exactly
ARM_TILT, ARM_SPEED, ARM_RATE = 0.35, 0.3, 0.5  # [rad] 20 deg, on its side it cannot lift off;
                        # [m/s] and [rad/s], a faster robot is being carried
LOW_TIME = 2.0          # [s] of a low voltage, longer than the sag of one manoeuvre
TUMBLING, FALLING = 15.0, 6.0   # [rad/s]; [m/s] after 1.8 m of free fall
LOST_TIME = 0.3         # [s] of either
QUIET_TIME = 1.0        # [s] in which the same message is logged once


def plausible(*arrays: np.ndarray) -> bool:
    """Whether all numbers are finite, as one vector shorter than ABSURD."""
    return hypot(*chain(*map(np.ndarray.tolist, arrays))) < ABSURD


class Inputs:
    """
    Checks and counts all messages, and keeps the latest data of each source.

    Attributes:
        events: what happened, oldest first.
        faults: of this flight: name -> time of detection [s].
        estimate: the last valid one; before the first at the origin, of an infinite age.
        bridges: bridge 'joint' or 'rotor' -> its reported state: 'ready', 'waiting: WHY',
            'silent: WHY' or 'lost: WHY', set by the caller; a bridge that never reported has no
            influence, because without bridges the simulator gets the commands directly.
        battery_low, battery_empty, lost: pack below its voltages, robot tumbling or falling, for
            long enough.
        ages: of the estimates, also of refused ones.
        refused: 'estimate: stale stamp' and the like -> count.
        floor: height of base_link on the ground before the flight [m].
        airborne: whether the robot is in the air. The supervisor sets this and the floor.

    """

    def __init__(self, parameters: SupervisorParameters, robot: RobotParameters,
                 controllers: tuple[str, ...]):
        self._parameters, self.robot = parameters, robot
        self.allocator = Allocator(robot)
        self.events: list[Event] = []
        self._said: dict[str, float] = {}   # when the events with a key were last added [s]
        self.watch = FaultWatch(robot, self.allocator)
        self.faults = self.watch.faults
        self.ages = commands.Lateness(parameters.age_limit)
        self.streams = {name: commands.CommandStream(robot, parameters.age_limit)
                        for name in controllers}
        self.backup = BackupEstimator(robot.gravity)
        self.estimate = State(-np.inf, np.zeros(3), np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]),
                              np.zeros(3), np.zeros(4), np.zeros(4), -np.inf)
        self._offered = self.estimate       # the one before, accepted or not
        self._doubted = -np.inf     # stamp of the last refused estimate that controllers also have
        self.refused = Counter[str]()
        self.ekf, self.joints = commands.Silence(ESTIMATE_TIMEOUT), commands.Silence(JOINT_TIMEOUT)
        self.imu, self.mocap = commands.Silence(IMU_TIMEOUT), commands.Silence(MOCAP_TIMEOUT)
        self.rotors = commands.Silence(ROTORS_TIMEOUT)
        self.tilt, self.tilt_velocity, self.tilt_stamp = np.zeros(4), np.zeros(4), -np.inf
        self.voltage: float | None = None
        self.bridges: dict[str, str] = {}
        self.battery_low = self.battery_empty = self.lost = False
        self._low_for = self._empty_for = self._lost_for = 0.0
        self._same = self._same_samples = 0     # equal estimates and IMU samples in a row
        self._sample: list[float] = []
        self._spikes = SpikeFilter()
        self.floor, self.airborne = 0.0, False
        self._now: float | None = None

    # Messages ---------------------------------------------------------------------------------

    def on_state(self, state: State, now: float | None = None) -> bool:
        """Receive the estimator's state, None: at the last update; False when it is refused."""
        true = corrected(state, self.watch.health)
        self.ages.add((now or self._now or state.stamp) - state.stamp)
        reason = self._why_not(true)
        if reason:
            self.refused[f'estimate: {reason}'] += 1
            if state.stamp > self.estimate.stamp:
                self._doubted = state.stamp
            self.say(WARNING, f'ekf_node: estimate refused: {reason}', reason)
            return False
        self.estimate = true
        self.ekf.reset()
        self.on_joints(state.tilt_stamp, state.tilt, state.tilt_velocity)
        return True

    def _why_not(self, state):
        now = self._now
        if not (isfinite(state.stamp) and plausible(
                state.position, state.velocity, state.quaternion, state.angular_velocity)):
            return 'not finite'
        if abs(state.quaternion.dot(state.quaternion) - 1) > UNIT_TOLERANCE:
            return 'no unit quaternion'
        if now is not None and now - state.stamp > STALE_AFTER:
            return 'stale stamp'
        if self._ahead(state.stamp):
            return 'stamp in the future'
        if state.stamp <= self.estimate.stamp:
            return 'repeated or older stamp'
        before, self._offered = self._offered, state
        was, at = before.position.tolist(), state.position.tolist()
        self._same = self._same + 1 if was == at else 0
        if self._same >= commands.SAME and self.airborne:
            return commands.FROZEN
        jumped = 0 < state.stamp - before.stamp <= ESTIMATE_TIMEOUT and (
            dist(was, at) > JUMP_POSITION
            or rotations.geodesic_angle(before.quaternion, state.quaternion) > JUMP_ATTITUDE)
        return commands.JUMP if jumped else ''

    def on_command(self, controller: str, command: Command, now: float) -> bool:
        """Check one command of one controller; False when it is refused (and counted)."""
        reason = self.streams[controller].offer(command, now, self._doubted)
        if reason:
            self.say(INFO if reason == commands.JUMP else WARNING,
                     f'{controller}_node: command refused: {reason}', f'{controller}: {reason}')
        return not reason

    def on_joints(self, stamp: float, position: np.ndarray,
                  velocity: np.ndarray | None) -> None:
        """
        Receive raw joint feedback (4,), nan where unknown: there the last angle is kept.

        Only complete feedback resets the timeout of the joints.
        """
        if not stamp > self.tilt_stamp or self._ahead(stamp):
            return
        known = [abs(angle) < ABSURD for angle in position.tolist()]
        if not any(known):
            return
        true = self.watch.health.true(position)
        self.tilt = true if all(known) else np.where(known, true, self.tilt)
        self.tilt_velocity = np.zeros(4) if velocity is None else np.array([
            rate if there and isfinite(rate) else 0.0
            for there, rate in zip(known, velocity.tolist())])
        self.tilt_stamp = float(stamp)
        if all(known):
            self.joints.reset()
            zeros = self.watch.health.zeros
            self.watch.on_joints(stamp, position, self.airborne)
            if self.watch.health.zeros != zeros:    # also of this reading
                self.tilt = self.watch.health.true(position)

    def on_imu(self, stamp: float, specific_force: np.ndarray,
               angular_velocity: np.ndarray) -> None:
        """Receive a raw IMU sample (3,), (3,) in base_link."""
        if not plausible(specific_force, angular_velocity) or self._ahead(stamp):
            return
        values = specific_force.tolist() + angular_velocity.tolist()
        self._same_samples = self._same_samples + 1 if values == self._sample else 0
        self._sample = values
        if self._same_samples >= IMU_FROZEN and self.airborne:
            self.watch.name('imu_frozen', stamp, 'the IMU repeats the same sample')
            return
        if not self._spikes.passes(specific_force, angular_velocity) \
                or not self.backup.add(stamp, specific_force, angular_velocity):
            return
        self.imu.reset()
        if self.airborne:
            known = stamp - self.tilt_stamp < TILT_AGE
            self.watch.on_imu(stamp, specific_force, angular_velocity,
                              self.tilt if known else None, self.height)

    def on_rotors(self, stamp: float, speed: np.ndarray) -> None:
        """Receive the rotor speeds (4,) reported by the ESCs [rad/s], nan where unknown."""
        self.rotors.reset()
        if self.airborne and not self._ahead(stamp):
            self.watch.on_speeds(stamp, speed)

    def on_mocap(self, stamp: float, position: np.ndarray, quaternion: np.ndarray) -> None:
        """Receive a raw MoCap pose (3,), (4,) of base_link."""
        poses = self.backup.poses
        if not plausible(position, quaternion) or self._ahead(stamp) \
                or abs(quaternion.dot(quaternion) - 1) > UNIT_TOLERANCE \
                or poses and not stamp > poses[-1][0]:
            return
        quaternion = rotations.normalized(quaternion)
        poses.append((stamp, position, quaternion))
        if self.airborne:
            state = self.best
            near = abs(state.stamp - stamp) < POSE_AGE
            good = self.watch.on_mocap(stamp, position, quaternion, state if near else None)
            if not good and 'estimator_wrong' not in self.watch.faults:
                return
        self.backup.correct(stamp, position, quaternion)
        if self.airborne and self.imu.silent:
            self.watch.contact.on_pose(quaternion, self.height)
        self.mocap.reset()

    def on_battery(self, voltage: float) -> None:
        """Receive the pack voltage under load [V]; ignored if not finite or not plausible."""
        if self._now is not None and VOLTAGES[0] <= voltage < VOLTAGES[1]:
            self.voltage = float(voltage)
            self.watch.on_voltage(self._now, self.voltage)

    # What is known ----------------------------------------------------------------------------

    @property
    def health(self) -> ActuatorHealth:
        """Health of the actuators by the detectors."""
        return self.watch.health

    def late(self, controller: str) -> tuple[str, str] | None:
        """Name of the fault and its text while estimates or commands stay too old."""
        for name, node, ages in (('estimates_late', 'ekf', self.ages), (
                'commands_late', controller, self.streams[controller].ages)):
            if ages.late:
                return name, f'{node}_node {ages.text}'
        return None

    def unready(self, bridge: str) -> str:
        """'' while 'joint' or 'rotor' is ready or never reported, else its node and state."""
        text = self.bridges.get(bridge, 'ready')
        return '' if text == 'ready' else f'{bridge}_bridge_node {text}'

    @property
    def best(self) -> State:
        """The estimate, or the backup estimate while it is used."""
        return self.estimate if not self.backup.running or self._now is None else \
            self.backup.state(self._now, self.estimate)

    @property
    def blind(self) -> bool:
        """Whether position and velocity are dead reckoning."""
        return self.mocap.silent if self.backup.running else self.mocap.lost

    @property
    def height(self) -> float | None:
        """Height of base_link above its height on the ground [m]; None if unknown."""
        return None if self.blind else float(self.best.position[2]) - self.floor

    def seen(self, in_force: Command | None) -> State:
        """The best state, for the hover controller; silent joints are where they were asked to."""
        tilt, velocity = self.tilt, self.tilt_velocity
        # Without their bridge the servos stop at their angles.
        if self.joints.silent and in_force is not None and 'joint' not in self.bridges:
            tilt, velocity = in_force.tilt, np.zeros(4)
        best = self.best
        return State(best.stamp, best.position, best.velocity, best.quaternion,
                     best.angular_velocity, tilt, velocity, self.tilt_stamp, in_force)

    @property
    def specific_force_up(self) -> float | None:
        """Latest specific force along world up [m/s^2], None without IMU."""
        if self.backup.sample is None or self.imu.silent:
            return None
        return float(rotations.matrix(self.best.quaternion)[2].dot(self.backup.sample[1]))

    def why_not_arm(self, controller: str) -> str:
        """'' when the motors may start, else the missing condition."""
        state = self.estimate
        if unready := '; '.join(filter(None, map(self.unready, ('joint', 'rotor')))):
            return unready
        if self.ekf.silent:
            return f'no fresh state estimate (ekf_node {self.ekf.text})'
        if self.mocap.silent:
            return f'no fresh pose (MoCap {self.mocap.text})'
        if self.joints.silent:
            return f'no fresh joint angles (joint_bridge_node {self.joints.text})'
        if late := self.late(controller):
            return f'{late[1]}: {TOO_SLOW}'
        angle = np.degrees(inclination(state.quaternion))
        speed, rate = np.linalg.norm(state.velocity), np.linalg.norm(state.angular_velocity)
        if angle > np.degrees(ARM_TILT):
            return f'inclined by {angle:.0f} deg, at most {np.degrees(ARM_TILT):.0f} deg'
        if speed > ARM_SPEED:
            return f'moving at {speed:.2f} m/s, at most {ARM_SPEED:g} m/s'
        if rate > ARM_RATE:
            return f'turning at {rate:.2f} rad/s, at most {ARM_RATE:g} rad/s'
        if self.outside(0.0):
            return 'outside the fence'
        least = self._parameters.battery_arm * self.robot.battery.cells
        if self.voltage is not None and self.voltage < least:
            return f'battery at {self.voltage:.1f} V, at least {least:.1f} V'
        moved = [f'gimbal{k + 1}' for k, zero in enumerate(self.health.zeros) if zero]
        return f"the encoder of {' and '.join(moved)} jumped in the last flight: check it, then " \
               'restart supervisor_node' if moved else ''

    def outside(self, margin: float) -> bool:
        """Whether the robot is more than ``margin`` [m] outside the fence."""
        limits = self._parameters
        x, y, z = map(abs, self.best.position.tolist())
        return max(x, y) > limits.fence_half_width + margin or z > limits.fence_height + margin

    def diagnostics(self) -> dict[str, float | int | str]:
        """Faults, sources and refusals, flat, for operators and logs."""
        values: dict[str, float | int | str] = {'on_backup_estimator': int(self.backup.running)}
        # [s]: the six digits of a diagnostic number are too few for a stamp
        values.update({f'fault.{name}': f'{at:.3f}' for name, at in self.faults.items()})
        values.update({f'{name}_bridge_node': state for name, state in self.bridges.items()})
        for name, stream in self.streams.items():
            values[f'{name}.good'] = int(stream.good)
            values[f'{name}.silent_ms'] = 1000 * stream.silence.elapsed
            values.update({f'{name}.refused.{reason}': count
                           for reason, count in stream.refused.items()})
        values.update({f'refused.{reason}': count for reason, count in self.refused.items()})
        if self.voltage is not None:
            values['battery_V'] = self.voltage
        return values

    # Time -------------------------------------------------------------------------------------

    def tick(self, now: float) -> float:
        """Counted time since the last update; also after the clock was set back."""
        before, self._now = self._now, now
        if before is None:
            return 0.0
        if now < before:
            self.say(WARNING, f'the clock went back by {before - now:.3f} s')
            # accept new stamps
            self.estimate = replace(self.estimate, stamp=min(self.estimate.stamp, now))
            self.tilt_stamp = min(self.tilt_stamp, now)
            self.backup.forget(before - now)
            self.watch.restart()
            for stream in self.streams.values():
                stream.forget()
            return 0.0
        dt = min(now - before, TICK_LIMIT)
        for source in (self.ekf, self.joints, self.imu, self.mocap, self.rotors):
            source.tick(dt)
        for stream in self.streams.values():
            stream.tick(dt)
        self.backup.imu_alive = not self.imu.silent
        limits, cells = self._parameters, self.robot.battery.cells
        cell = np.inf if self.voltage is None else self.voltage / cells
        self._low_for = self._low_for + dt if cell < limits.battery_warn else 0.0
        self._empty_for = self._empty_for + dt if cell < limits.battery_land else 0.0
        self.battery_low, self.battery_empty = self._low_for >= LOW_TIME, \
            self._empty_for >= LOW_TIME
        state = self.best
        lost = state.angular_velocity.dot(state.angular_velocity) > TUMBLING**2 \
            or state.velocity[2] < -FALLING
        self._lost_for = self._lost_for + dt if lost else 0.0
        self.lost = self._lost_for >= LOST_TIME
        return dt

    def _ahead(self, stamp: float) -> bool:
        return self._now is not None and stamp - self._now > ESTIMATE_TIMEOUT

    def say(self, severity: str, text: str, key: str = '') -> None:
        """Add one event; with a ``key``, not again within the quiet time."""
        now = self._now or 0.0
        if key and abs(now - self._said.get(key, -np.inf)) < QUIET_TIME:
            return
        self._said[key] = now
        self.events.append(Event(now, severity, text))
