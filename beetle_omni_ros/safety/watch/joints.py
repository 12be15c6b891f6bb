"""Joints that do not follow their commands, and encoders that jump."""

from collections import deque
from math import expm1

import numpy as np

from beetle_omni_ros.robot.allocation import ROTORS
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.safety.watch.parameters import ServoLimits

KEPT = 64               # commands, 0.3 s at 200 Hz
LONGEST = 0.1           # [s] between two readings; after a longer gap the model is reset
NO_JUMP = np.zeros(ROTORS)
AT_REST = 0.05          # [rad] by which a jammed joint may move during the decision


class JointWatch:
    """
    Compares encoders with a first-order servo that follows the commands at its limited rate.

    Args:
        limits: thresholds.
        robot: nominal robot.

    Attributes:
        jammed: joints (4,) bool that stand still away from their command.
        astray: joints (4,) bool whose motion differs from the command.
        jump: (4,) [rad] jump of the last reading relative to the motion before it, if it is larger
            than a joint can turn, else 0.
        model: (4,) readings by the servo model [rad], None before the first.
        stamp: time of the last reading, or of the model without readings [s].

    """

    def __init__(self, limits: ServoLimits, robot: RobotParameters):
        joints = robot.joints
        self._p, self._rate_limit = limits, joints.velocity_limit
        self._lag = joints.time_constant
        self._delay = limits.delay + robot.command_delays[0] + robot.sensors.encoder_delay
        self.reset()

    def reset(self) -> None:
        """Reset; start again at the next reading."""
        self._commands: deque = deque(maxlen=KEPT)
        self.stamp, self._change = -np.inf, np.zeros(ROTORS)
        self.model: np.ndarray | None = None
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
        asked = self._asked(stamp - self._delay)
        if dt > LONGEST or asked is None or self.model is None:
            self.model, self._for = tilt.copy(), np.zeros(ROTORS)
            self._change, self.jump = np.zeros(ROTORS), NO_JUMP
            return True
        change = tilt - before
        step = self._step(asked - self.model, dt)
        furthest = self._rate_limit * dt + self._p.jump
        if max(map(abs, change.tolist())) > furthest:
            jumped = np.abs(change) > furthest
            self.jump = np.where(jumped, change - self._change, 0.0)
            self._change = np.where(jumped, self._change, change)
            self.model = np.where(jumped, tilt, self.model + step)
        else:
            self.jump, self._change, self.model = NO_JUMP, change, self.model + step
        self._judge(tilt, dt, step)
        return True

    def advance(self, stamp: float) -> None:
        """Continue with the model to ``stamp`` [s], without readings."""
        dt, asked = stamp - self.stamp, self._asked(stamp - self._delay)
        if self.model is None or asked is None or dt <= 0:
            return
        self.stamp = stamp
        self.model = self.model + self._step(asked - self.model, min(dt, LONGEST))

    def _step(self, error, dt):
        """Motion (4,) [rad] of servos of first order with a limited rate in ``dt`` [s]."""
        reach, share = self._rate_limit * dt, -expm1(-dt / self._lag)
        return np.array([min(max(each * share, -reach), reach) for each in error.tolist()])

    def _judge(self, tilt, dt, step):
        p = self._p
        each = [abs(error) > p.error + p.spread * (abs(motion) / dt) for error, motion in zip(
            (tilt - self.model).tolist(), step.tolist())]
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
