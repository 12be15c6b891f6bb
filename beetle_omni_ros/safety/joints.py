"""Joints that do not follow their commands, and encoders that jump."""

from collections import deque
from math import expm1

import numpy as np

from beetle_omni_ros.robot.allocation import ROTORS
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.robot.response import Responses

KEPT = 64               # commands, 0.3 s at 200 Hz
LONGEST = 0.1           # [s] between two readings; after a longer gap the model is reset
NO_JUMP = np.zeros(ROTORS)
ERROR = 0.25            # [rad] beside both models, and the friction of the file
TIME = 0.12             # [s] until it is a fault
DELAY = 0.025           # [s] command 10 to 15 ms, feedback 5 to 10 ms
SPREAD = 0.03           # [s] uncertainty of the delay: another 0.3 rad at 10 rad/s
JUMP = 0.5              # [rad] between two readings, beyond the motion that is possible


class JointWatch:
    """
    Compares encoders with the fastest and the slowest servo that the robot file allows.

    Both follow the commands with a first-order lag, at a limited rate and after a delay. A joint
    between them, or within the noise and its friction beside them, follows its commands.

    Args:
        robot: nominal robot.

    Attributes:
        astray: joints (4,) bool that do not follow their command.
        jump: (4,) [rad] jump of the last reading relative to the motion before it, if it is larger
            than a joint can turn, else 0.
        stamp: time of the last reading [s].
        suspects: whether a joint differed from its model at the last reading.

    """

    def __init__(self, robot: RobotParameters):
        allowed = Responses.of(robot)
        self._rate_limit = robot.joints.velocity_limit
        self._lags, (low, high) = allowed.servo_lag, allowed.servo_delay
        self._delays = max(0.0, DELAY - SPREAD + low), DELAY + SPREAD + high
        self._error = ERROR + allowed.friction
        self.reset()

    def reset(self) -> None:
        """Reset; start again at the next reading."""
        self._commands: deque = deque(maxlen=KEPT)
        self.stamp, self._change = -np.inf, np.zeros(ROTORS)
        self._models: np.ndarray | None = None      # (2, 4) fastest and slowest [rad]
        self._for = np.zeros(ROTORS)
        self.astray = np.zeros(ROTORS, dtype=bool)
        self.jump = NO_JUMP
        self.suspects = False

    def on_command(self, stamp: float, tilt: np.ndarray) -> None:
        """Receive the joint targets (4,) [rad] of the time ``stamp`` [s]."""
        self._commands.append((stamp, tilt))

    def on_joints(self, stamp: float, tilt: np.ndarray) -> bool:
        """Receive a complete reading (4,) [rad] of the time ``stamp`` [s]; False if it is old."""
        dt = stamp - self.stamp
        if dt <= 0:
            self.jump = NO_JUMP
            return False
        before, self.stamp = getattr(self, '_tilt', tilt), stamp
        self._tilt = tilt
        if self._models is None or dt > LONGEST or not self._follow(stamp, dt):
            self._models, self._for = np.array([tilt, tilt]), np.zeros(ROTORS)
            self._change, self.jump = np.zeros(ROTORS), NO_JUMP
            return True
        change = tilt - before
        furthest = self._rate_limit * dt + JUMP
        if max(map(abs, change.tolist())) > furthest:
            jumped = np.abs(change) > furthest
            self.jump = np.where(jumped, change - self._change, 0.0)
            self._change = np.where(jumped, self._change, change)
            self._models = np.where(jumped, tilt, self._models)
        else:
            self.jump, self._change = NO_JUMP, change
        self._judge(tilt, self._models, dt)
        return True

    def _follow(self, stamp, dt):
        """Move both models by ``dt`` [s] to ``stamp``; False if they or commands are missing."""
        asked = [self._asked(stamp - delay) for delay in self._delays]
        if self._models is None or asked[1] is None:
            return False
        reach = self._rate_limit * dt
        for model, target, lag in zip(self._models, asked, self._lags):
            share = -expm1(-dt / lag)
            model += [min(max(error * share, -reach), reach)
                      for error in (target - model).tolist()]
        return True

    def _judge(self, tilt, models, dt):
        error = self._error
        each = [reading < min(pair) - error or reading > max(pair) + error
                for reading, pair in zip(tilt.tolist(), models.T.tolist())]
        if not self.suspects and not any(each):
            return
        off = np.array(each)
        self._for = np.where(off, self._for + dt, 0.0)
        self.suspects = bool(off.any())
        self.astray = self._for >= TIME

    def _asked(self, time):
        """The newest command given at ``time`` or before, or None."""
        for stamp, tilt in reversed(self._commands):
            if stamp <= time:
                return tilt
        return None
