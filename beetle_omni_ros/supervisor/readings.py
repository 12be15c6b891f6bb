"""Detection of encoders and MoCap poses that contradict the models, and of joints that stick."""

from collections import deque
from math import expm1, inf, sqrt

import numpy as np

from beetle_omni_ros.control.base import State
from beetle_omni_ros.model import rotations
from beetle_omni_ros.model.allocation import ROTORS
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.model.servo import Responses

KEPT = 64               # commands, 0.3 s at 200 Hz
LONGEST = 0.1           # [s] between two readings; after a longer gap no jump is detected
ERROR = 0.25            # [rad] beside both models, and the friction of the file
TIME = 0.12             # [s] until it is a fault
DELAY = 0.025           # [s] command 10 to 15 ms, feedback 5 to 10 ms
SPREAD = 0.03           # [s] uncertainty of the delay: another 0.3 rad at 10 rad/s
JUMP = 0.5              # [rad] between two readings, beyond the motion that is possible

AGE = 0.05              # [s] largest time between pose and estimate
FASTEST = 6.0           # [m/s] largest speed of a robot in a hall
ATTITUDE = 0.35         # [rad] from the estimate, or jump against the gyroscope
DISTANCE = 0.3          # [m] the same; larger than the error of dead reckoning after 1 s
LASTING = 10            # poses, 0.1 s, of a contradiction
AFTER_JUMP = 30         # poses after a jump; longer than a temporary confusion of markers
FROZEN = 5              # equal poses; noise of 1 mm never repeats exactly


class JointWatch:
    """
    Compares encoders with the fastest and the slowest servo that the robot file allows.

    Both follow the commands with a first-order lag, at a limited rate and after a delay. A joint
    between them, or within the noise and its friction beside them, follows its commands.

    Attributes:
        commands: stamps [s] and joint targets (4,) [rad], the newest last.
        astray: joints (4) that do not follow their command.
        jump: 4 jumps [rad] of the last reading relative to the motion before it, if larger than a
            joint can turn, else 0.
        suspects: whether a joint differed from its model at the last reading.

    """

    def __init__(self, robot: RobotParameters):
        allowed = Responses.of(robot)
        self._rate_limit = robot.joints.velocity_limit
        self._lags, (low, high) = allowed.servo_lag, allowed.servo_delay
        self._delays = max(0.0, DELAY - SPREAD + low), DELAY + SPREAD + high
        self._error = ERROR + allowed.friction
        self.commands: deque = deque(maxlen=KEPT)
        self._stamp, zero = -inf, [0.0] * ROTORS
        self._tilt, self._models, self._change, self._for = zero, [zero, zero], zero, zero
        self.astray, self.jump, self.suspects = [False] * ROTORS, zero, False

    def on_joints(self, stamp: float, tilt: np.ndarray) -> None:
        """Receive a complete reading (4,) [rad] of the time ``stamp`` [s]."""
        dt, before, angles = stamp - self._stamp, self._tilt, tilt.tolist()
        self._stamp, self._tilt, self.jump = stamp, angles, [0.0] * ROTORS
        if dt > LONGEST:
            self._models, self._change, self._for = [angles, angles], self.jump, self.jump
            return
        reach = self._rate_limit * dt
        for k, (delay, lag) in enumerate(zip(self._delays, self._lags)):
            target = next((asked for at, asked in reversed(self.commands) if at <= stamp - delay),
                          tilt)
            gain = -expm1(-dt / lag)
            self._models[k] = [model + min(max(gain * (goal - model), -reach), reach)
                               for model, goal in zip(self._models[k], target.tolist())]
        changes = [new - old for new, old in zip(angles, before)]
        for i, change in enumerate(changes):
            if abs(change) > reach + JUMP:
                self.jump[i], changes[i] = change - self._change[i], self._change[i]
                for model in self._models:
                    model[i] = angles[i]
        self._change = changes
        self._for = [
            0.0 if min(one, other) - self._error <= angle <= max(one, other) + self._error
            else time + dt for time, angle, one, other in zip(self._for, angles, *self._models)]
        self.astray, self.suspects = [time >= TIME for time in self._for], any(self._for)


class MocapWatch:
    """
    Detects impossible jumps, repeated values, and lasting contradictions.

    Attributes:
        good: whether the last pose may be used.
        frozen: whether equal poses repeat.
        jumped: whether the contradiction began with a jump of MoCap.
        contradicts: whether pose and estimate have contradicted each other for long enough.

    """

    def __init__(self):
        self._before: tuple[float, np.ndarray, np.ndarray] | None = None
        self.good = self.frozen = self.jumped = self.contradicts = False
        self._same = self._off = 0

    def on_pose(self, stamp: float, position: np.ndarray, quaternion: np.ndarray,
                state: State | None) -> None:
        """Receive a pose and the estimate of about that time, None: there is none."""
        before, self._before = self._before, (stamp, position, quaternion)
        turning = 0.0 if state is None else sqrt(state.angular_velocity.dot(
            state.angular_velocity))
        if before is not None:
            dt, moved = stamp - before[0], position - before[1]
            turn = rotations.geodesic_angle(before[2], quaternion)
            self._same = self._same + 1 if not any(moved.tolist()) \
                and quaternion.tolist() == before[2].tolist() else 0
            if dt < LONGEST:
                self.jumped |= turn > ATTITUDE + turning * dt \
                    or sqrt(moved.dot(moved)) > DISTANCE + FASTEST * dt
        self.frozen = self._same >= FROZEN
        off = False
        if state is not None:
            error = position - state.position
            speed = sqrt(state.velocity.dot(state.velocity))
            off = rotations.geodesic_angle(state.quaternion, quaternion) \
                > ATTITUDE + turning * AGE or sqrt(error.dot(error)) > DISTANCE + speed * AGE
        self.jumped &= off
        self._off = self._off + 1 if off else 0
        self.contradicts = self._off >= (AFTER_JUMP if self.jumped else LASTING)
        self.good = not off and not self.frozen
