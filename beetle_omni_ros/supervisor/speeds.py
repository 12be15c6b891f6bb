"""Detection of rotors whose ESC speed differs from the commanded thrust."""

from collections import deque
from math import expm1, inf, isfinite, nan

import numpy as np

from beetle_omni_ros.model.allocation import ROTORS
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.model.servo import Responses

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
        thrust: 4 numbers computed from the speeds [N], nan where unknown.
        slow: 4 bool, rotors that turn noticeably too slowly at the last report.

    """

    def __init__(self, robot: RobotParameters):
        allowed = Responses.of(robot)
        self._responses = [(lag, DELAY + delay)
                           for lag, delay in zip(allowed.rotor_lag, allowed.rotor_delay)]
        self._stamp, self._interval, self._settled_at = -inf, 0.0, -inf
        self.commands: deque = deque(maxlen=KEPT)
        self._modelled = np.zeros((2, ROTORS))      # with the shortest and with the longest lag
        self._learnt_for, self._mean_thrust, self._mean_square = (
            [0.0] * ROTORS for _ in range(3))
        self.thrust = [nan] * ROTORS
        self.forget()

    def forget(self) -> None:
        """Suspect no rotor."""
        self.slow = [False] * ROTORS
        self._slow_for, self._more_for = [0.0] * ROTORS, [0.0] * ROTORS
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
        for k, (one, low, high) in enumerate(zip(speed.tolist(), *self._modelled.tolist())):
            self._compare(k, one * one, (low, high), dt)
        slow, more = max(self._slow_for), max(self._more_for)
        self.lost = self._slow_for.index(slow) if slow >= TIME else None
        self.deaf = self._more_for.index(more) if more >= TIME else None

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

    def _compare(self, k, square, modelled, dt):
        """Judge the squared speed [rad^2/s^2] of a rotor, nan if unknown, which is no suspect."""
        learnt, slowest = self._learnt_for[k] >= LEARNT, modelled[1]
        y = self._mean_thrust[k] / self._mean_square[k] * square if learnt else nan
        known, x = isfinite(y), slowest
        if known:   # of the lags between, the one nearest to the measurement
            x = min(max(y, min(modelled)), max(modelled))
        judged = isfinite(square) and x > LEAST_THRUST
        known = known and judged
        too_slow = known and y < (1 - SHARE) * x
        more = known and y > (1 + SHARE) * x and y - x > EXCESS
        self.thrust[k] = y if known else nan
        self.slow[k] = known and y < (1 - NOTICED) * x
        if judged and not too_slow and not more and square > 0:
            gain = dt / min(max(self._learnt_for[k], dt), LEARNT)
            self._mean_thrust[k] += gain * (slowest - self._mean_thrust[k])
            self._mean_square[k] += gain * (square - self._mean_square[k])
            self._learnt_for[k] += dt
        self._slow_for[k] = self._slow_for[k] + dt if too_slow else 0.0
        self._more_for[k] = self._more_for[k] + dt if more else 0.0
