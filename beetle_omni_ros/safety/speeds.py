"""Detection of rotors whose ESC speed differs from the commanded thrust."""

from collections import deque
from math import expm1, inf

import numpy as np

from beetle_omni_ros.robot.allocation import clipped, ROTORS
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.robot.servo import Responses

LEARNT = 1.0            # [s] time constant of the learnt factor between speed and thrust
DELAY = 0.01            # [s] from a command's stamp until it acts
KEPT = 64               # commands, 0.3 s at 200 Hz
STALLED, SHORTEST = 2.5, 0.05   # [intervals], [s]: a longer pause of the reports is a stall
SETTLED = 0.3           # [s] after a stall, three time constants of a rotor
SHARE = 0.5             # [-] missing share of the thrust of a lost rotor
NOTICED = 0.25          # [-] missing share that confirms a loss by the wrench
LEAST_THRUST = 1.5      # [N] smallest thrust for a decision: a fifth of the hover thrust
TIME = 0.06             # [s] until a lost rotor is named: three ESC reports of 50 Hz
EXCESS = 3.0            # [N] over the command: a lag longer by a third leaves 1 N after a step


class SpeedWatch:
    """
    Thrust is proportional to the squared speed; the factor of each rotor is learnt in flight.

    The thrust is modelled with the shortest and with the longest lag that the robot file allows.
    Of the thrusts between both, the modelled one is the nearest to the measured one. The factor is
    the ratio of mean thrust and mean squared speed, which no lag changes.

    A rotor that gives clearly more thrust than commanded does not follow its commands, because
    neither lag nor weakness causes this.

    If the reports of the motor board pause, its commands were probably late, too. For SETTLED
    seconds the thrusts then differ from the model, and no rotor is suspected.

    Attributes:
        commands: stamps [s] and commanded thrusts (4,) [N], the newest last.
        lost: the rotor (0 to 3) that turns too slowly, or None.
        deaf: the rotor (0 to 3) that gives more than commanded, or None.
        thrust: (4,) computed from the speeds [N], nan where unknown.
        slow: (4,) bool, rotors that turn noticeably too slowly at the last report.

    """

    def __init__(self, robot: RobotParameters):
        allowed = Responses.of(robot)
        self._responses = [(lag, DELAY + delay)
                           for lag, delay in zip(allowed.rotor_lag, allowed.rotor_delay)]
        self._stamp, self._interval, self._settled_at = -inf, 0.0, -inf
        self.commands: deque = deque(maxlen=KEPT)
        self._modelled = np.zeros((2, ROTORS))      # with the shortest and with the longest lag
        self._learnt_for, self._mean_thrust, self._mean_square = np.zeros((3, ROTORS))
        self.thrust = np.full(ROTORS, np.nan)
        self.forget()

    def forget(self) -> None:
        """Suspect no rotor."""
        self.slow = np.zeros(ROTORS, dtype=bool)
        self._slow_for, self._more_for = np.zeros((2, ROTORS))
        self.lost: int | None = None
        self.deaf: int | None = None

    def on_speeds(self, stamp: float, speed: np.ndarray) -> None:
        """Receive a report of the time ``stamp`` [s]: (4,) [rad/s], nan where offline."""
        dt, before = stamp - self._stamp, self._stamp
        if dt <= 0:
            return
        self._stamp = stamp
        if dt > max(SHORTEST, STALLED * self._interval):
            self._settled_at = stamp + SETTLED
        self._interval = dt
        self._follow(before, stamp)
        if stamp < self._settled_at:
            return self.forget()
        self._compare(speed * speed, dt)

    def _follow(self, start, end):
        """Thrusts that the commands build up between two times [s]."""
        commands = self.commands
        while len(commands) > 1 and commands[1][0] + self._responses[-1][1] <= start:
            commands.popleft()
        for modelled, (lag, delay) in zip(self._modelled, self._responses):
            for k, (stamp, asked) in enumerate(commands):
                until = commands[k + 1][0] + delay if k + 1 < len(commands) else end
                span = min(until, end) - max(stamp + delay, start)
                if span > 0:
                    modelled -= expm1(-span / lag) * (asked - modelled)

    def _compare(self, square, dt):
        """Judge squared speeds (4,) [rad^2/s^2], nan where unknown; nan is never suspect."""
        modelled, slowest = self._modelled, self._modelled[1]
        learnt = self._learnt_for >= LEARNT
        y = np.where(learnt, self._mean_thrust / np.where(learnt, self._mean_square, 1.0) * square,
                     np.nan)
        # Of the lags between, the one nearest to the measurement; with nan the longest.
        x = np.where(np.isfinite(y), clipped(y, modelled.min(axis=0), modelled.max(axis=0)),
                     slowest)
        judged = np.isfinite(square) & (x > LEAST_THRUST)
        known = judged & learnt
        too_slow = known & (y < (1 - SHARE) * x)
        more = known & (y > (1 + SHARE) * x) & (y - x > EXCESS)
        self.thrust = np.where(known, y, np.nan)
        self.slow = known & (y < (1 - NOTICED) * x)
        good = judged & ~too_slow & ~more & (square > 0)
        gain = np.where(good, dt / np.minimum(np.maximum(self._learnt_for, dt), LEARNT), 0.0)
        self._mean_thrust += gain * (slowest - self._mean_thrust)
        self._mean_square += gain * (np.nan_to_num(square) - self._mean_square)
        self._learnt_for += np.where(good, dt, 0.0)
        self._slow_for = np.where(too_slow, self._slow_for + dt, 0.0)
        self._more_for = np.where(more, self._more_for + dt, 0.0)
        self.lost = int(self._slow_for.argmax()) if self._slow_for.max() >= TIME else None
        self.deaf = int(self._more_for.argmax()) if self._more_for.max() >= TIME else None
