"""Link of the commands to the actuators: checks, delay, timeout."""

from collections import Counter, deque
from math import isfinite

import numpy as np

from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.sim.conditions import Conditions
from beetle_omni_ros.sim.parameters import ActuatorTimingParameters

ROUNDING = 1e-9                 # [s] bound of the rounding error of sums of ticks


class CommandLink:
    """
    Delays commands.

    Attributes:
        tilt: (4,) present targets [rad].
        thrust: (4,) present targets [N].
        accepted: number of accepted commands.
        rejected: reason -> number of refused commands.

    """

    def __init__(self, robot: RobotParameters, timing: ActuatorTimingParameters,
                 conditions: Conditions):
        self._limit = robot.joints.position_limit
        self._thrust_range = robot.rotors.thrust_min, robot.rotors.thrust_max
        self._timing = timing
        self._delays = conditions.command_delays(robot)
        self._pending: tuple[deque, deque] = (deque(), deque())
        self._last_stamp = self._last_arrival = -np.inf
        self.tilt = np.zeros(4)
        self.thrust = np.zeros(4)
        self.accepted = 0
        self.rejected: Counter = Counter()

    def push(self, command, now: float) -> bool:
        """
        Accept or refuse a command. A command with the stamp of the last one replaces it.

        Args:
            command: has ``stamp`` [s], ``tilt`` (4,) [rad], ``thrust`` (4,) [N].
            now: [s]; the command acts at its stamp plus the delay, or now if that has passed.

        Returns:
            whether it was accepted.

        """
        reason = self._refusal(command, now)
        if reason:
            self.rejected[reason] += 1
            return False
        self.accepted += 1
        self._last_stamp, self._last_arrival = command.stamp, now
        tilt = _clipped(command.tilt, -self._limit, self._limit)
        thrust = _clipped(command.thrust, *self._thrust_range)
        for queue, delay, value in zip(self._pending, self._delays, (tilt, thrust)):
            queue.append((max(command.stamp + delay, now), value))
        return True

    def _refusal(self, command, now):
        try:
            tilt = np.asarray(command.tilt, dtype=float)
            thrust = np.asarray(command.thrust, dtype=float)
            stamp = float(command.stamp)
        except (TypeError, ValueError):
            return 'not numbers'
        if tilt.shape != (4,) or thrust.shape != (4,):
            return 'wrong length'
        if not all(map(isfinite, (stamp, *tilt.tolist(), *thrust.tolist()))):
            return 'not finite'
        if stamp < self._last_stamp:
            return 'older than the last'
        if stamp > now + self._timing.command_future_limit:
            return 'from the future'
        return None

    def update(self, now: float) -> None:
        """Set the targets that are due at ``now``; stop the rotors after the timeout."""
        due = now + ROUNDING
        tilts, thrusts = self._pending
        while tilts and tilts[0][0] <= due:
            self.tilt = tilts.popleft()[1]
        while thrusts and thrusts[0][0] <= due:
            self.thrust = thrusts.popleft()[1]
        if now - self._last_arrival >= self._timing.command_timeout - ROUNDING:
            self.thrust = np.zeros(4)


def _clipped(values, low, high):
    """Clipped copy of four numbers, for which plain floats are faster than numpy."""
    return np.array([min(max(value, low), high)
                     for value in np.asarray(values, dtype=float).tolist()])
