"""Checks of commands, and a record of each controller's valid and refused commands."""

from collections import Counter
from math import inf, isfinite

import numpy as np

from beetle_omni_ros.control.base import Command, ROTORS
from beetle_omni_ros.robot.allocation import clipped
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.safety.events import Silence
from beetle_omni_ros.safety.parameters import CommandLimits

NOT_A_COMMAND = 'not a command'
SHAPE = 'wrong shape'
NOT_FINITE = 'not finite'
STALE = 'stale stamp'
FUTURE = 'stamp in the future'
REPEATED = 'repeated stamp'
OLDER = 'older than the last'
THRUST = 'thrust out of range'
TILT = 'tilt out of range'
JUMP = 'implausible jump'
FROZEN = 'the same numbers again'
UNKNOWN = 'unknown controller'
SAME = 10       # commands or estimates in a row that are equal to the last digit

MEANINGS = {    # of reasons for refusals that do not explain themselves
    FROZEN: f' (more than {SAME} equal commands in a row count as a frozen controller; compute '
            'the command from the state, see docs/safety.md)'}


class CommandStream:
    """
    Commands of one controller: the last accepted one, and refusals with reasons.

    Args:
        limits: thresholds.
        robot: thrust and tilt ranges.

    Attributes:
        accepted: the last valid command, or None.
        cut: the last command that was refused for a range, clipped to the limits, or None.
        refused: reason -> count.
        last_refusal: reason of the last refusal, '' after a valid command.
        silence: time since the last valid command.
        good_for: time of valid commands without a gap or refusal [s].

    """

    def __init__(self, limits: CommandLimits, robot: RobotParameters):
        self._limits, self._rotors = limits, robot.rotors
        self._tilt_limit = robot.joints.position_limit
        self.accepted: Command | None = None
        self.cut: Command | None = None
        self.refused: Counter = Counter()
        self.last_refusal = ''
        self.silence = Silence(limits.timeout)
        self._overstepping = Silence(limits.timeout)
        self.good_for = 0.0
        self._offered: Command | None = None
        self._may_jump_for = 0.0
        self._same = 0

    @property
    def good(self) -> bool:
        """Whether the controller may get control."""
        return not self.silence.silent and self.good_for >= self._limits.return_after - 1e-9

    @property
    def in_force(self) -> Command | None:
        """
        The executable command: the last valid command, or a newer one clipped to the limits.

        None if the controller is silent. A command that slightly exceeds the limits for a short
        time in a manoeuvre is clipped, which is better than a fallback. Wrong units exceed the
        limits by more, and a failed controller exceeds them for longer.
        """
        cut, good = self.cut, self.accepted
        if cut is not None and (good is None or cut.stamp > good.stamp) \
                and not self._overstepping.silent \
                and self.silence.elapsed <= self._limits.overstep_time:
            return cut
        return None if self.silence.silent else good

    @property
    def complaint(self) -> str:
        """Why the controller may not get control, for messages."""
        if self.silence.silent:
            last = f'; last refused: {self.last_refusal}' if self.last_refusal else ''
            return self.silence.text + last
        return f'good for only {self.good_for:.2f} s of {self._limits.return_after:g} s'

    def offer(self, command: Command, now: float) -> str:
        """
        Check one command; store a copy of a valid command.

        Returns:
            '' when accepted, else the reason.

        """
        reason, clean = self._check(command, now)
        if reason:
            self.refused[reason] += 1
            self.last_refusal = reason
            # A step to a new target looks like a jump for one period only. Repeated jumps end in
            # the timeout.
            if reason != JUMP:
                self.good_for = 0.0
            if reason in (THRUST, TILT) and self._slightly(command, clean):
                self.cut = clean
                self._overstepping.reset()
            return reason
        self.accepted, self.last_refusal = clean, ''
        self.silence.reset()
        return ''

    def tick(self, dt: float) -> None:
        """``dt`` seconds passed."""
        if self.silence.elapsed == self._overstepping.elapsed == inf:
            return      # no command yet
        self.silence.tick(dt)
        self._overstepping.tick(dt)
        self.good_for = 0.0 if self.silence.silent else self.good_for + dt
        self._may_jump_for = max(0.0, self._may_jump_for - dt)

    def expect_jump(self) -> None:
        """Do not refuse jumps until the controller has had time to answer, its timeout."""
        self._may_jump_for = self._limits.timeout

    def clock_went_back(self, now: float) -> None:
        """Accept new stamps after a step of the clock."""
        if self.accepted is not None and self.accepted.stamp > now:
            self.accepted = self._offered = self.cut = None
            self.silence.elapsed = inf

    def _slightly(self, command, clean):
        """Whether a command exceeds the limits by at most a share of the ranges."""
        share, rotors = self._limits.overstep, self._rotors
        return _farthest(np.asarray(command.thrust, dtype=float), clean.thrust) \
            <= share * (rotors.thrust_max - rotors.thrust_min) \
            and _farthest(np.asarray(command.tilt, dtype=float), clean.tilt) \
            <= share * self._tilt_limit

    def _check(self, command, now):
        """Reason of a refusal and, without one, the copy with limits applied exactly."""
        try:
            stamp = float(command.stamp)
            tilt = np.array(command.tilt, dtype=float)
            thrust = np.array(command.thrust, dtype=float)
        except (AttributeError, TypeError, ValueError):
            return NOT_A_COMMAND, None
        if tilt.shape != (ROTORS,) or thrust.shape != (ROTORS,):
            return SHAPE, None
        angles, forces = tilt.tolist(), thrust.tolist()
        if not (isfinite(stamp) and all(map(isfinite, angles + forces))):
            return NOT_FINITE, None
        limit, low, high = self._tilt_limit, self._rotors.thrust_min, self._rotors.thrust_max
        clean = Command(stamp,
                        tilt if max(map(abs, angles)) <= limit else clipped(tilt, -limit, limit),
                        thrust if low <= min(forces) and max(forces) <= high else
                        clipped(thrust, low, high))
        return self._check_stamp(stamp, now) or self._check_range(tilt, thrust, clean), clean

    def _check_stamp(self, stamp, now):
        if now - stamp > self._limits.stale_after:
            return STALE
        if stamp - now > self._limits.clock_tolerance:
            return FUTURE
        if self.accepted is not None and stamp <= self.accepted.stamp:
            return REPEATED if stamp == self.accepted.stamp else OLDER
        return ''

    def _check_range(self, tilt, thrust, clean):
        tolerance = self._limits.limit_tolerance
        if thrust is not clean.thrust and _farthest(thrust, clean.thrust) > tolerance:
            return THRUST
        if tilt is not clean.tilt and _farthest(tilt, clean.tilt) > tolerance:
            return TILT
        before, self._offered = self._offered, clean
        same = before is not None and before.tilt.tolist() == clean.tilt.tolist() \
            and before.thrust.tolist() == clean.thrust.tolist()
        self._same = self._same + 1 if same else 0
        if self._same >= SAME:
            return FROZEN
        # Compared with the previous command, accepted or not: a single spike is refused, a real
        # step is delayed by one period.
        if before is not None and self._may_jump_for <= 0 \
                and clean.stamp - before.stamp <= self._limits.timeout and (
                _farthest(clean.tilt, before.tilt) > self._limits.tilt_step
                or _farthest(clean.thrust, before.thrust) > self._limits.thrust_step):
            return JUMP
        return ''


def within_limits(command: Command, robot: RobotParameters, stopped: bool = False) -> \
        Command | None:
    """
    Final check of the output: finite and clipped to the limits, or None.

    Args:
        command: of any source.
        robot: thrust and tilt ranges.
        stopped: whether zero thrust is intended, below the smallest thrust in flight.

    """
    tilt, thrust = command.tilt.tolist(), command.thrust.tolist()
    if not all(map(isfinite, tilt + thrust)):
        return None
    limit = robot.joints.position_limit
    low, high = 0.0 if stopped else robot.rotors.thrust_min, robot.rotors.thrust_max
    if max(map(abs, tilt)) <= limit and low <= min(thrust) and max(thrust) <= high:
        return command
    return Command(command.stamp, clipped(command.tilt, -limit, limit),
                   clipped(command.thrust, low, high))


def _farthest(a, b):
    return max(map(abs, (a - b).tolist()))
