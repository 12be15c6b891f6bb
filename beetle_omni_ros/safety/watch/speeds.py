"""Detection of rotors whose ESC speed differs from the commanded thrust."""

from collections import deque
from math import exp, expm1

import numpy as np

from beetle_omni_ros.robot.allocation import ROTORS
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.safety.watch.parameters import RotorLimits

LEARNT = 1.0            # [s] time constant of the learnt factor between speed and thrust
DELAY = 0.01            # [s] from a command's stamp until it acts
KEPT = 64               # commands, 0.3 s at 200 Hz
LONGEST = 0.2           # [s] longest time between two reports of one sequence
STALLED, SHORTEST = 2.5, 0.05   # [intervals], [s]: a longer pause of the reports is a stall
SETTLED = 0.3           # [s] after a stall, three time constants of a rotor


class SpeedWatch:
    """
    Thrust is proportional to the squared speed; the factor of each rotor is learnt in flight.

    A rotor that does not follow commands is detected by the slope of the measured over the
    modelled thrust, a regression over the last half second. The slope is 1 for a healthy rotor,
    less for a weak rotor, and 0 for a rotor that holds its thrust. It is used if the modelled
    thrust has varied enough. A rotor that gives clearly more thrust than commanded is detected at
    once, because neither lag nor weakness causes this.

    If the reports of the motor board pause, its commands were probably late, too. For SETTLED
    seconds the thrusts then differ from the model, and no rotor is suspected.

    Args:
        limits: thresholds.
        robot: nominal robot.

    Attributes:
        lost: the rotor (0 to 3) that turns too slowly, or None.
        deaf: the rotor (0 to 3) whose speed does not follow its commands, or None.
        thrust: (4,) computed from the speeds [N], nan where unknown.
        slow: (4,) bool, rotors that turn noticeably too slowly at the last report.

    """

    def __init__(self, limits: RotorLimits, robot: RobotParameters):
        self._p, self._lag = limits, robot.rotors.time_constant
        self.reset()

    def reset(self) -> None:
        """Reset all learnt factors."""
        self._stamp, self._interval, self._settled_at = -np.inf, np.inf, -np.inf
        self._commands: deque = deque(maxlen=KEPT)
        self._thrust = np.zeros(ROTORS)
        self._factor = np.zeros(ROTORS)     # [N s^2/rad^2]
        self._learnt_for = np.zeros(ROTORS)
        self._for, self._deaf_for, self._more_for = np.zeros((3, ROTORS))
        self._sums = np.zeros((5, ROTORS))      # moments of modelled and measured thrust
        self.lost: int | None = None
        self.deaf: int | None = None
        self.thrust = np.full(ROTORS, np.nan)
        self.slow = np.zeros(ROTORS, dtype=bool)

    def on_command(self, stamp: float, thrust: np.ndarray) -> None:
        """Receive the commanded thrusts (4,) [N] of the time ``stamp`` [s]."""
        self._commands.append((stamp + DELAY, thrust))

    def forget(self) -> None:
        """Suspect no rotor."""
        self._for, self._deaf_for, self._more_for = np.zeros((3, ROTORS))
        self._sums[:] = 0.0
        self.slow = np.zeros(ROTORS, dtype=bool)
        self.lost = self.deaf = None

    def _follow(self, start, end):
        """Thrusts that the commands build up between two times [s]."""
        commands = self._commands
        while len(commands) > 1 and commands[1][0] <= start:
            commands.popleft()
        for k, (stamp, thrust) in enumerate(commands):
            until = commands[k + 1][0] if k + 1 < len(commands) else end
            span = min(until, end) - max(stamp, start)
            if span > 0:
                self._thrust = self._thrust - expm1(-span / self._lag) * (thrust - self._thrust)

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
        if dt > LONGEST:
            if self._commands:
                self._thrust = np.array(self._commands[-1][1], dtype=float)
            return self.forget()
        self._follow(before, stamp)
        if stamp < self._settled_at:
            return self.forget()
        square = np.asarray(speed, dtype=float)**2
        judged = np.isfinite(square) & (self._thrust > self._p.least_thrust)
        known = judged & (self._learnt_for >= LEARNT)
        slow = known & (self._factor * square < (1 - self._p.share) * self._thrust)
        self.slow = known & (self._factor * square < (1 - self._p.noticed) * self._thrust)
        self._for = np.where(slow, self._for + dt, 0.0)
        self.lost = int(np.argmax(self._for)) if self._for.max() >= self._p.speed_time else None
        self.thrust = np.where(known, self._factor * square, np.nan)
        self._judge(known, dt)
        learn = judged & ~slow & (square > 0)
        ratio = np.divide(self._thrust, square, out=np.zeros(ROTORS), where=learn)
        gain = np.minimum(1.0, dt / np.maximum(self._learnt_for, dt))
        gain = np.maximum(gain, min(1.0, dt / LEARNT))
        self._factor = np.where(learn, self._factor + gain * (ratio - self._factor), self._factor)
        self._learnt_for = np.where(learn, self._learnt_for + dt, self._learnt_for)

    def _judge(self, known, dt):
        """Rotor whose measured thrust does not follow the modelled thrust, or None."""
        x, y = np.where(known, [self._thrust, self.thrust], 0.0)
        self._sums *= known * exp(-dt / self._p.slope_window)
        self._sums += dt * np.array([known, x, y, x * x, x * y])
        weight, sum_x, sum_y, sum_xx, sum_xy = self._sums
        full = weight > 0.5 * self._p.slope_window
        count = np.where(full, weight, 1.0)
        variance = sum_xx / count - (sum_x / count) ** 2
        slope_times = sum_xy / count - sum_x * sum_y / count**2
        more = known & (y > (1 + self._p.share) * x) & (y - x > self._p.excess)
        self._more_for = np.where(more, self._more_for + dt, 0.0)
        deaf = full & (variance > self._p.least_variation**2) \
            & (slope_times < self._p.least_slope * variance)
        self._deaf_for = np.where(deaf, self._deaf_for + dt, 0.0)
        found = (self._deaf_for >= self._p.deaf_time) | (self._more_for >= self._p.speed_time)
        self.deaf = int(np.argmax(found)) if found.any() else None
