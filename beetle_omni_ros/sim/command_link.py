"""The way of a command to the actuators: checks, delay, timeout."""

from __future__ import annotations

from collections import Counter, deque

import numpy as np

from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.sim.conditions import Conditions
from beetle_omni_ros.sim.parameters import ActuatorTimingParameters

ROUNDING = 1e-9                 # [s] sums of ticks differ from their product by less


class CommandLink:
    """
    Holds commands until they act.

    Attributes:
        tilt: (4,) targets in force [rad].
        thrust: (4,) targets in force [N].
        accepted: number of commands taken.
        rejected: reason -> number of commands refused.

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
        Take a command, or refuse and count it.

        Args:
            command: has ``stamp`` [s], ``tilt`` (4,) [rad], ``thrust`` (4,) [N].
            now: [s]; the command acts at its stamp plus the delay, or now if that has passed.

        Returns:
            whether it was taken. A stamp as old as the last one replaces that command.

        """
        reason = self._refusal(command, now)
        if reason:
            self.rejected[reason] += 1
            return False
        self.accepted += 1
        self._last_stamp, self._last_arrival = command.stamp, now
        tilt = np.clip(np.asarray(command.tilt, dtype=float), -self._limit, self._limit)
        thrust = np.clip(np.asarray(command.thrust, dtype=float), *self._thrust_range)
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
        if not (np.isfinite(stamp) and np.isfinite(tilt.sum() + thrust.sum())):
            return 'not finite'
        if stamp < self._last_stamp:
            return 'older than the last'
        if stamp > now + self._timing.command_future_limit:
            return 'from the future'
        return None

    def update(self, now: float) -> None:
        """Put in force what acts by ``now``; stop the rotors when commands have ceased."""
        due = now + ROUNDING
        tilts, thrusts = self._pending
        while tilts and tilts[0][0] <= due:
            self.tilt = tilts.popleft()[1]
        while thrusts and thrusts[0][0] <= due:
            self.thrust = thrusts.popleft()[1]
        if self.timed_out(now):
            self.thrust = np.zeros(4)

    def timed_out(self, now: float) -> bool:
        """Whether the last command came so long ago that the rotors stop."""
        return due_after(self._last_arrival, self._timing.command_timeout, now)


def due_after(start: float, duration: float, now: float) -> bool:
    """Whether ``duration`` has passed since ``start``, up to rounding."""
    return now - start >= duration - ROUNDING
