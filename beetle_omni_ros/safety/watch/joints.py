"""Joints that do not follow their commands, and encoders that jump."""

from collections import deque
from math import expm1

import numpy as np

from beetle_omni_ros.robot.allocation import ROTORS
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.robot.servo import Responses
from beetle_omni_ros.safety.watch.parameters import ServoLimits

KEPT = 64               # commands, 0.3 s at 200 Hz
LONGEST = 0.1           # [s] between two readings; after a longer gap the model is reset
NO_JUMP = np.zeros(ROTORS)
AT_REST = 0.05          # [rad] by which a jammed joint may move during the decision


class JointWatch:
    """
    Compares encoders with the fastest and the slowest servo that the robot file allows.

    Both follow the commands with a first-order lag, at a limited rate and after a delay. A joint
    between them, or within the noise and its friction beside them, follows its commands.

    Args:
        limits: thresholds.
        robot: nominal robot.

    Attributes:
        jammed: joints (4,) bool that stand still away from their command.
        astray: joints (4,) bool whose motion differs from the command.
        jump: (4,) [rad] jump of the last reading relative to the motion before it, if it is larger
            than a joint can turn, else 0.
        stamp: time of the last reading, or of the models without readings [s].

    """

    def __init__(self, limits: ServoLimits, robot: RobotParameters):
        allowed = Responses.of(robot)
        self._p, self._rate_limit = limits, robot.joints.velocity_limit
        self._lags, (low, high) = allowed.servo_lag, allowed.servo_delay
        self._delays = (max(0.0, limits.delay - limits.spread + low),
                        limits.delay + limits.spread + high)
        self._error = limits.error + allowed.friction
        self.reset()

    def reset(self) -> None:
        """Reset; start again at the next reading."""
        self._commands: deque = deque(maxlen=KEPT)
        self.stamp, self._change = -np.inf, np.zeros(ROTORS)
        self._models: np.ndarray | None = None      # (2, 4) fastest and slowest [rad]
        self._for = np.zeros(ROTORS)
        self._low = self._high = np.zeros(ROTORS)
        self.jammed = np.zeros(ROTORS, dtype=bool)
        self.astray = np.zeros(ROTORS, dtype=bool)
        self.jump = NO_JUMP
        self._suspects = False      # whether a joint differed from its model at the last reading

    @property
    def well(self) -> bool:
        """Whether no joint jumped or differed from its model at the last reading."""
        return self.jump is NO_JUMP and not self._suspects

    @property
    def model(self) -> np.ndarray | None:
        """Readings (4,) midway between the models [rad], None before the first."""
        return None if self._models is None else 0.5 * (self._models[0] + self._models[1])

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
        furthest = self._rate_limit * dt + self._p.jump
        if max(map(abs, change.tolist())) > furthest:
            jumped = np.abs(change) > furthest
            self.jump = np.where(jumped, change - self._change, 0.0)
            self._change = np.where(jumped, self._change, change)
            self._models = np.where(jumped, tilt, self._models)
        else:
            self.jump, self._change = NO_JUMP, change
        self._judge(tilt, self._models, dt)
        return True

    def advance(self, stamp: float) -> None:
        """Continue with the model to ``stamp`` [s], without readings."""
        dt = stamp - self.stamp
        if dt > 0 and self._follow(stamp, min(dt, LONGEST)):
            self.stamp = stamp

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
        p, error = self._p, self._error
        each = [reading < min(pair) - error or reading > max(pair) + error
                for reading, pair in zip(tilt.tolist(), models.T.tolist())]
        if not self._suspects and not any(each):
            return
        off = np.array(each)
        began = off & (self._for == 0)
        self._low = np.where(began, tilt, np.minimum(self._low, tilt))
        self._high = np.where(began, tilt, np.maximum(self._high, tilt))
        self._for = np.where(off, self._for + dt, 0.0)
        self._suspects = bool(off.any())
        named = self._for >= p.time
        still = self._high - self._low < AT_REST
        self.jammed, self.astray = named & still, named & ~still

    def _asked(self, time):
        """The newest command given at ``time`` or before, or None."""
        for stamp, tilt in reversed(self._commands):
            if stamp <= time:
                return tilt
        return None
