"""Detection of rotors whose ESC speed differs from the commanded thrust."""

from collections import deque
from math import exp, expm1, inf, isfinite, nan
from operator import attrgetter

import numpy as np

from beetle_omni_ros.robot.allocation import ROTORS
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.robot.response import Responses

LEARNT = 1.0            # [s] time constant of the learnt factor between speed and thrust
DELAY = 0.01            # [s] from a command's stamp until it acts
KEPT = 64               # commands, 0.3 s at 200 Hz
LONGEST = 0.2           # [s] longest time between two reports of one sequence
STALLED, SHORTEST = 2.5, 0.05   # [intervals], [s]: a longer pause of the reports is a stall
SETTLED = 0.3           # [s] after a stall, three time constants of a rotor
SHARE = 0.5             # [-] missing share of the thrust of a lost rotor
NOTICED = 0.25          # [-] missing share that confirms a loss by the wrench
LEAST_THRUST = 1.5      # [N] smallest thrust for a decision: a fifth of the hover thrust
TIME = 0.06             # [s] until a lost rotor is named: three ESC reports of 50 Hz
WINDOW = 0.5            # [s] of the regression: five time constants of a rotor
VARIATION = 1.0         # [N] smallest standard deviation of the commanded thrust: 1 % of speed
                        # noise is 0.15 N, so the error of the slope is 0.1
SLOPE = 0.4             # [-] smallest: with 25 ms of unmodelled delay it is 0.8, with another lag
                        # of 0.2 s about 0.3
DEAF_TIME = 0.3         # [s] a sudden loss of thrust gives similar values while in the window
EXCESS = 3.0            # [N] over the command: a lag longer by a third leaves 1 N after a step


class SpeedWatch:
    """
    Thrust is proportional to the squared speed; the factor of each rotor is learnt in flight.

    The thrust is modelled with the shortest and with the longest lag that the robot file allows.
    Of the thrusts between both, the modelled one is the nearest to the measured one. The factor is
    the ratio of mean thrust and mean squared speed, which no lag changes.

    A rotor that does not follow commands is detected by the slope of the measured over the
    modelled thrust, a regression over the last half second. The slope is 1 for a healthy rotor,
    less for a weak rotor, and 0 for a rotor that holds its thrust. It is used if the modelled
    thrust has varied enough. A rotor that gives clearly more thrust than commanded is detected at
    once, because neither lag nor weakness causes this.

    If the reports of the motor board pause, its commands were probably late, too. For SETTLED
    seconds the thrusts then differ from the model, and no rotor is suspected.

    Args:
        robot: nominal robot.

    Attributes:
        lost: the rotor (0 to 3) that turns too slowly, or None.
        deaf: the rotor (0 to 3) whose speed does not follow its commands, or None.
        thrust: (4,) computed from the speeds [N], nan where unknown.
        slow: (4,) bool, rotors that turn noticeably too slowly at the last report.

    """

    def __init__(self, robot: RobotParameters):
        allowed = Responses.of(robot)
        self._responses = [(lag, DELAY + delay)
                           for lag, delay in zip(allowed.rotor_lag, allowed.rotor_delay)]
        self.reset()

    def reset(self) -> None:
        """Reset all learnt factors."""
        self._stamp, self._interval, self._settled_at = -inf, inf, -inf
        self._commands: deque = deque(maxlen=KEPT)
        self._rotors = [Rotor() for _ in range(ROTORS)]
        self.thrust = np.full(ROTORS, np.nan)
        self.forget()

    def suspects(self, rotor: int) -> bool:
        """Whether the last reports of a rotor do not follow its commands."""
        return self._rotors[rotor].deaf_for > 0

    def on_command(self, stamp: float, thrust: np.ndarray) -> None:
        """Receive the commanded thrusts (4,) [N] of the time ``stamp`` [s]."""
        self._commands.append((stamp, thrust.tolist()))

    def forget(self) -> None:
        """Suspect no rotor."""
        for rotor in self._rotors:
            rotor.forget()
        self.slow = np.zeros(ROTORS, dtype=bool)
        self.lost: int | None = None
        self.deaf: int | None = None

    def _follow(self, start, end):
        """Thrusts that the commands build up between two times [s]."""
        commands = self._commands
        while len(commands) > 1 and commands[1][0] + self._responses[-1][1] <= start:
            commands.popleft()
        for which, (lag, delay) in enumerate(self._responses):
            for k, (stamp, asked) in enumerate(commands):
                until = commands[k + 1][0] + delay if k + 1 < len(commands) else end
                span = min(until, end) - max(stamp + delay, start)
                if span > 0:
                    gain = -expm1(-span / lag)
                    for rotor, thrust in zip(self._rotors, asked):
                        rotor.modelled[which] += gain * (thrust - rotor.modelled[which])

    def on_speeds(self, stamp: float, speed: np.ndarray) -> None:
        """
        Receive a report.

        Args:
            stamp: [s].
            speed: (4,) [rad/s], nan where the ESC is offline.

        """
        dt, before = stamp - self._stamp, self._stamp
        if dt <= 0:
            return
        self._stamp = stamp
        if dt > max(SHORTEST, STALLED * self._interval):
            self._settled_at = stamp + SETTLED
        self._interval = dt
        rotors = self._rotors
        if dt > LONGEST:
            if self._commands:
                for rotor, thrust in zip(rotors, self._commands[-1][1]):
                    rotor.modelled = [thrust, thrust]
            return self.forget()
        self._follow(before, stamp)
        if stamp < self._settled_at:
            return self.forget()
        decay = exp(-dt / WINDOW)
        for rotor, value in zip(rotors, speed.tolist()):
            rotor.update(value * value, dt, decay)
        self.thrust = np.array([rotor.measured for rotor in rotors])
        self.slow = np.array([rotor.slow for rotor in rotors])
        longest = max(rotors, key=attrgetter('slow_for'))
        self.lost = rotors.index(longest) if longest.slow_for >= TIME else None
        self.deaf = next((i for i, rotor in enumerate(rotors) if rotor.deaf), None)


class Rotor:
    """
    One rotor of :class:`SpeedWatch`; plain floats, because numpy is slower for single numbers.

    Attributes:
        modelled: thrust by the commands with the shortest and with the longest lag [N].
        measured: thrust by the speed [N], nan if unknown.
        slow: whether it turns noticeably too slowly at the last report.
        slow_for: time for which it has turned too slowly [s].
        deaf: whether its speed does not follow its commands; deaf_for: time of that [s].

    """

    def __init__(self):
        self.modelled = [0.0, 0.0]
        self._learnt_for = self._mean_thrust = self._mean_square = 0.0
        self.forget()

    def forget(self) -> None:
        """Remove every suspicion."""
        self.measured, self.slow, self.slow_for, self.deaf = nan, False, 0.0, False
        self.deaf_for = self._more_for = 0.0
        # Moments of modelled (x) and measured (y) thrust, with fading memory.
        self._weight = self._x = self._y = self._xx = self._xy = 0.0

    def update(self, square: float, dt: float, decay: float) -> None:
        """
        Process one report.

        Args:
            square: squared speed [rad^2/s^2], nan if unknown.
            dt: time since the report before [s].
            decay: factor of the moments in this time.

        """
        y, slowest = nan, self.modelled[1]
        if self._learnt_for >= LEARNT:
            y = self._mean_thrust / self._mean_square * square
        # Of the lags between, the one nearest to the measurement; with nan the longest.
        x = min(max(y, min(self.modelled)), max(self.modelled)) if isfinite(y) else slowest
        judged = isfinite(square) and x > LEAST_THRUST
        too_slow = judged and y < (1 - SHARE) * x       # nan is not
        if judged and isfinite(y):
            self.measured, self.slow = y, y < (1 - NOTICED) * x
            self.slow_for = self.slow_for + dt if too_slow else 0.0
            self._regress(x, y, dt, decay)
        else:
            self.forget()
        if judged and not too_slow and square > 0:
            gain = max(min(1.0, dt / max(self._learnt_for, dt)), min(1.0, dt / LEARNT))
            self._mean_thrust += gain * (slowest - self._mean_thrust)
            self._mean_square += gain * (square - self._mean_square)
            self._learnt_for += dt

    def _regress(self, x, y, dt, decay):
        """Whether the measured thrust ``y`` does not follow the modelled thrust ``x``."""
        self._weight = self._weight * decay + dt
        self._x, self._y = self._x * decay + dt * x, self._y * decay + dt * y
        self._xx, self._xy = self._xx * decay + dt * (x * x), self._xy * decay + dt * (x * y)
        w = self._weight
        variance = self._xx / w - (self._x / w) ** 2
        covariance = self._xy / w - self._x * self._y / w**2
        deaf = w > 0.5 * WINDOW and variance > VARIATION**2 and covariance < SLOPE * variance
        self.deaf_for = self.deaf_for + dt if deaf else 0.0
        more = y > (1 + SHARE) * x and y - x > EXCESS
        self._more_for = self._more_for + dt if more else 0.0
        self.deaf = self.deaf_for >= DEAF_TIME or self._more_for >= TIME
