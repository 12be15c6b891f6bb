"""State of the vehicle for the supervisor: estimate, joints, raw sensors, battery; checks."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from math import dist, isfinite, nan, sqrt

import numpy as np

from beetle_omni_ros.control.base import Command, State
from beetle_omni_ros.robot import rotations
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.safety.descent import BackupEstimator
from beetle_omni_ros.safety.events import Silence
from beetle_omni_ros.safety.limits import FROZEN, SAME
from beetle_omni_ros.safety.parameters import SupervisorParameters
from beetle_omni_ros.safety.ramp import inclination

TRACKING = ('tracking', 'dead_reckoning')   # statuses with a usable estimate
UNIT_TOLERANCE = 0.02                       # of a quaternion's squared length
JUMP = 'implausible jump'
ABSURD = 1e4                                # [m, m/s, rad/s] beyond any robot; no overflow


class Vehicle:
    """
    The latest data of all sources, and their timeouts.

    Attributes:
        state: the last valid estimate, or None.
        status: the estimator's status at that time.
        tilt, tilt_velocity, tilt_stamp: latest joint feedback.
        stuck: whether joints do not follow commands: then silent joints keep their last angles.
        voltage: of the pack [V], None before the first.
        refused: 'estimate: stale stamp' and the like -> count.
        last_refusal: reason of the last refused estimate, '' after a valid one.

    """

    def __init__(self, parameters: SupervisorParameters, robot: RobotParameters):
        self._parameters, self._cells = parameters, robot.battery.cells
        limits = parameters.state
        self.state: State | None = None
        # stamp, position and quaternion of the estimate before, accepted or not
        self._offered: tuple[float, list[float], list[float]] | None = None
        self._same = 0      # estimates in a row with equal position and attitude
        self.status = ''
        self.tilt, self.tilt_velocity, self.tilt_stamp = np.zeros(4), np.zeros(4), -np.inf
        self.modelled_tilt: np.ndarray | None = None    # (4,) of silent joints [rad]
        self.stuck = False
        self.voltage: float | None = None
        self.estimate = Silence(limits.timeout)
        self.joints = Silence(limits.joint_timeout)
        self.imu, self.mocap = Silence(limits.imu_timeout), Silence(limits.mocap_timeout)
        self.backup = BackupEstimator(parameters.backup, robot.gravity)
        self.refused: Counter = Counter()
        self.last_refusal = ''
        self._low, self._empty, self._lost, self._fast = 0.0, 0.0, 0.0, 0.0

    @property
    def known(self) -> State:
        """
        The last valid estimate, a condition for take-off.

        Raises:
            RuntimeError: there is none yet.

        """
        if self.state is None:
            raise RuntimeError('no estimate received yet')
        return self.state

    def tick(self, dt: float) -> None:
        """``dt`` seconds passed."""
        for source in (self.estimate, self.joints, self.imu, self.mocap):
            source.tick(dt)
        self.backup.imu_alive = not self.imu.silent
        battery = self._parameters.battery
        self._low = self._low + dt if self._below(battery.warn) else 0.0
        self._empty = self._empty + dt if self._below(battery.land) else 0.0
        self._lost = self._lost + dt if self.state is not None and self._tumbling() else 0.0
        self._fast = self._fast + dt if self.state is not None and self._speeding() else 0.0

    def clock_went_back(self, now: float, by: float) -> None:
        """Accept new stamps after the clock was set back by ``by`` [s]."""
        if self.state is not None and self.state.stamp > now:
            self.state = replace(self.state, stamp=now)
        self.tilt_stamp = min(self.tilt_stamp, now)
        self.backup.clock_went_back(by)

    def on_state(self, state: State, status: str, now: float | None,
                 airborne: bool = False) -> str:
        """Receive an estimate; '' when it is valid, else the reason of the refusal."""
        reason = self._check_state(state, status, now, airborne)
        if reason:
            self.refused[f'estimate: {reason}'] += 1
            self.last_refusal = reason
            return reason
        self.state, self.status, self.last_refusal = state, status, ''
        self.estimate.reset()
        self.on_joints(state.tilt_stamp, state.tilt, state.tilt_velocity)
        self.backup.learn(state)
        return ''

    def on_joints(self, stamp: float, position: np.ndarray, velocity: np.ndarray) -> bool:
        """
        Receive newer joint feedback; for a nan the last angle is kept.

        Only complete feedback resets the timeout of the joints.
        """
        if not (isfinite(stamp) and stamp > self.tilt_stamp):
            return False
        angles, rates = _numbers(position, 4) or [nan] * 4, _numbers(velocity, 4) or [nan] * 4
        complete = all(map(isfinite, angles))
        known = angles if complete else list(filter(isfinite, angles))
        if not known or max(map(abs, known)) >= ABSURD:
            return False
        if complete:
            self.joints.reset()
        else:
            rates = [rate if isfinite(angle) else nan for rate, angle in zip(rates, angles)]
            angles = [new if isfinite(new) else old
                      for new, old in zip(angles, self.tilt.tolist())]
        self.tilt, self.tilt_stamp = np.array(angles), float(stamp)
        self.tilt_velocity = np.array([rate if isfinite(rate) else 0.0 for rate in rates])
        return True

    def seen(self, in_force: Command | None, state: State | None = None) -> State:
        """A state for the hover controller; angles of silent, working joints are modelled."""
        state = self.known if state is None else state
        if self.joints.silent and in_force is not None and not self.stuck:
            tilt = in_force.tilt if self.modelled_tilt is None else self.modelled_tilt
            return replace(state, tilt=tilt, tilt_velocity=np.zeros(4), command=in_force)
        return State(state.stamp, state.position, state.velocity, state.quaternion,
                     state.angular_velocity, self.tilt, self.tilt_velocity, self.tilt_stamp,
                     in_force)

    def backup_state(self, now: float) -> State:
        """The backup estimate at ``now``."""
        return self.backup.state(self.tilt, self.tilt_velocity, self.tilt_stamp, now)

    def attitude(self, now: float) -> np.ndarray:
        """(4,) best known attitude."""
        return self.backup_state(now).quaternion if self.backup.running \
            else self.known.quaternion

    @property
    def _best(self) -> State:
        """The estimate, or the backup estimate while it is used."""
        return self.backup.latest(self.known) if self.backup.running else self.known

    @property
    def specific_force_up(self) -> float | None:
        """Latest specific force along world up by the estimator's attitude [m/s^2]."""
        force = self.backup.last_specific_force
        if force is None or self.state is None or self.imu.silent:
            return None
        return float(rotations.up(self.state.quaternion).dot(force))

    @property
    def mocap_lost(self) -> bool:
        """Whether MoCap has sent poses and is silent now."""
        return self.mocap.silent and isfinite(self.mocap.elapsed)

    @property
    def imu_lost(self) -> bool:
        """Whether the raw IMU was there and is silent."""
        return self.imu.silent and isfinite(self.imu.elapsed)

    def why_not_arm(self) -> str:
        """'' when the motors may start, else the missing condition."""
        limits, battery = self._parameters.arming, self._parameters.battery
        if self.state is None or self.estimate.silent:
            return f'no fresh state estimate (ekf_node {self.estimate.text})'
        if self.status != 'tracking':
            return f"the estimator reports '{self.status}', not 'tracking'"
        if self.joints.silent:
            return f'no fresh joint angles (joint_bridge_node {self.joints.text})'
        angle, state = inclination(self.state.quaternion), self.state
        if angle > limits.tilt:
            return f'inclined by {np.degrees(angle):.0f} deg, at most ' \
                   f'{np.degrees(limits.tilt):.0f} deg'
        speed, rate = np.linalg.norm(state.velocity), np.linalg.norm(state.angular_velocity)
        if speed > limits.speed:
            return f'moving at {speed:.2f} m/s, at most {limits.speed:g} m/s'
        if rate > limits.rate:
            return f'turning at {rate:.2f} rad/s, at most {limits.rate:g} rad/s'
        if self.outside_fence:
            return 'outside the fence'
        if self.voltage is not None and self.voltage < battery.arm * self._cells:
            return f'battery at {self.voltage:.1f} V, at least {battery.arm * self._cells:.1f} V'
        return ''

    @property
    def battery_low(self) -> bool:
        """Whether the pack has been below its warning voltage for long enough."""
        return self._low >= self._parameters.battery.time

    @property
    def battery_empty(self) -> bool:
        """Whether the pack has been below its landing voltage for long enough."""
        return self._empty >= self._parameters.battery.time

    @property
    def lost(self) -> bool:
        """Whether the robot has been tumbling or falling for long enough."""
        return self._lost >= self._parameters.envelope.lost_time

    @property
    def runs_away(self) -> bool:
        """Whether the speed has for long enough been one that no landing has."""
        return self._fast >= self._parameters.envelope.lost_time

    @property
    def outside_fence(self) -> bool:
        """Whether the estimate lies outside the fence."""
        return self._outside(0.0)

    @property
    def far_outside_fence(self) -> bool:
        """Whether the estimate lies beyond the margin around the fence."""
        return self._outside(self._parameters.envelope.fence_margin)

    def _outside(self, margin):
        fence = self._parameters.envelope
        x, y, z = map(abs, self._best.position.tolist())
        return max(x, y) > fence.half_width + margin or z > fence.height + margin

    def _below(self, threshold):
        return self.voltage is not None and self.voltage < threshold * self._cells

    def _tumbling(self):
        fence, state = self._parameters.envelope, self._best
        rate = state.angular_velocity
        return sqrt(rate.dot(rate)) > fence.rate or state.velocity[2] < -fence.fall_speed

    def _speeding(self):
        velocity = self._best.velocity
        return velocity.dot(velocity) > self._parameters.envelope.fall_speed**2

    def _check_state(self, state, status, now, airborne):
        limits = self._parameters.state
        position, quaternion = _numbers(state.position, 3), _numbers(state.quaternion, 4)
        velocity, rate = _numbers(state.velocity, 3), _numbers(state.angular_velocity, 3)
        if not (position and quaternion and velocity and rate and isfinite(state.stamp)
                and all(map(isfinite, position + velocity + rate + quaternion))):
            return 'not finite'
        if max(map(abs, position + velocity + rate)) > ABSURD:
            return 'absurdly large'
        x, y, z, w = quaternion
        if abs(x * x + y * y + z * z + w * w - 1) > UNIT_TOLERANCE:
            return 'no unit quaternion'
        if now is not None and now - state.stamp > limits.stale_after:
            return 'stale stamp'
        if now is not None and state.stamp - now > limits.timeout:
            return 'stamp in the future'
        if self.state is not None and state.stamp <= self.state.stamp:
            return 'repeated or older stamp'
        if status not in TRACKING:
            return f"status '{status}'"
        before, self._offered = self._offered, (state.stamp, position, quaternion)
        self._same = self._same + 1 if before is not None and before[1:] == self._offered[1:] \
            else 0
        if self._same >= SAME and airborne:
            return FROZEN
        if before is not None and 0 < state.stamp - before[0] <= limits.timeout and (
                dist(before[1], position) > limits.jump_position
                or rotations.geodesic_angle(before[2], quaternion) > limits.jump_attitude):
            return JUMP
        return ''


def numbers(value, size: int) -> np.ndarray | None:
    """``value`` as floats (size,), finite or not; None where it is something else."""
    try:
        array = np.asarray(value, dtype=float)
    except (TypeError, ValueError):
        return None
    return array if array.shape == (size,) else None


def _numbers(value, size):
    """List of :func:`numbers`, or None."""
    array = numbers(value, size)
    return None if array is None else array.tolist()
