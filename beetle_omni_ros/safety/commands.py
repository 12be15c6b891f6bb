"""Checks of the commands of the controllers, and of the one that is sent."""

from collections import Counter
from math import isfinite

import numpy as np

from beetle_omni_ros.control.base import Command
from beetle_omni_ros.robot.allocation import clipped
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.safety.events import Silence

FROZEN = 'the same numbers again'
SCATTER = 'thrust scatters'
NOT_FINITE = 'not finite'

TIMEOUT = 0.05          # [s] without a valid command: 5 periods of 100 Hz
RETURN_AFTER = 0.5      # [s] of valid commands before a controller gets control (again)
STALE_AFTER = 0.05      # [s] a command computed from an older state is refused
AHEAD = 0.02            # [s] a stamp farther in the future comes from another clock
OVERSTEP = 0.25         # [-] of a range: 5 N, 1 rad. A wrong unit exceeds it by a factor of 3
THRUST_STEP = 4.0       # [N] largest mean step of the thrusts, a fifth of the range: a rotor
                        # follows a tenth of a step within a period, random thrusts step by 6.7 N.
                        # Tilts may step: far targets on both sides set the rate of a joint
MEMORY = 0.3            # [-] weight of the last step in the mean
SAME = 10               # commands or estimates in a row that are equal to the last digit


class CommandStream:
    """
    Commands of one controller: the last accepted one, and refusals with reasons.

    Attributes:
        accepted: the last valid command, clipped to the ranges, or None.
        clipped: number of accepted commands that were clipped.
        refused: reason -> count.
        silence: time since the last valid command.
        good_for: time of valid commands without a gap or refusal [s].

    """

    def __init__(self, robot: RobotParameters):
        self._robot = robot
        self.accepted: Command | None = None
        self.clipped, self.refused = 0, Counter[str]()
        self._last_refusal = ''
        self.silence = Silence(TIMEOUT)
        self.good_for = 0.0
        self._offered: Command | None = None
        self._same, self._step = 0, 0.0

    @property
    def dead(self) -> bool:
        """Whether it loses control: it is silent, or its last command is not finite."""
        return self.silence.silent or self._last_refusal == NOT_FINITE

    @property
    def good(self) -> bool:
        """Whether the controller may get control."""
        return not self.dead and self.good_for >= RETURN_AFTER - 1e-9

    @property
    def complaint(self) -> str:
        """Why the controller may not get control, for messages."""
        if self.dead:
            last = f'; last refused: {self._last_refusal}' if self._last_refusal else ''
            return self.silence.text + last
        return f'good for only {self.good_for:.2f} s of {RETURN_AFTER:g} s'

    def offer(self, command: Command, now: float, doubted: float = -np.inf) -> str:
        """
        Check one command; '' when a copy is stored, else the reason of the refusal.

        ``doubted`` is the stamp of a refused estimate, which controllers also received [s].
        """
        reason, clean = self._check(command, now, doubted)
        if reason:
            self.refused[reason] += 1
            self._last_refusal = reason
            self.good_for = 0.0
            return reason
        self.accepted, self._last_refusal = clean, ''
        self.silence.reset()
        return ''

    def tick(self, dt: float) -> None:
        """``dt`` seconds passed."""
        self.silence.tick(dt)
        self.good_for = 0.0 if self.silence.silent else self.good_for + dt

    def forget(self) -> None:
        """Accept any stamp, after a step of the clock."""
        self.accepted = self._offered = None
        self.silence = Silence(TIMEOUT)

    def _check(self, command, now, doubted):
        """Reason of a refusal and, without one, a copy within the limits."""
        stamp, tilt, thrust = command.stamp, command.tilt, command.thrust
        clean = within_limits(command, self._robot)
        if clean is None or not isfinite(stamp):
            return NOT_FINITE, None
        if stamp == doubted:
            return 'answers a refused estimate', None
        if now - stamp > STALE_AFTER:
            return 'stale stamp', None
        if stamp - now > AHEAD:
            return 'stamp in the future', None
        if self.accepted is not None and stamp <= self.accepted.stamp:
            return 'repeated or older stamp', None
        beyond = np.abs(tilt - clean.tilt).max(), np.abs(thrust - clean.thrust).max()
        if beyond[0] > OVERSTEP * self._robot.joints.position_limit:
            return 'tilt out of range', None
        if beyond[1] > OVERSTEP * self._robot.rotors.thrust_max:
            return 'thrust out of range', None
        self.clipped += bool(max(beyond) > 0)
        before, self._offered = self._offered, clean
        if before is None:
            return '', clean
        same = (clean.tilt == before.tilt).all() and (clean.thrust == before.thrust).all()
        self._same = self._same + 1 if same else 0
        if self._same >= SAME:
            return FROZEN, None
        step = np.abs(clean.thrust - before.thrust).mean()
        self._step += MEMORY * (step - self._step)
        return (SCATTER, None) if self._step > THRUST_STEP else ('', clean)


def within_limits(command: Command, robot: RobotParameters) -> Command | None:
    """Final check of the output: finite and clipped to the limits, or None."""
    if not all(map(isfinite, [*command.tilt.tolist(), *command.thrust.tolist()])):
        return None
    limit = robot.joints.position_limit
    return Command(command.stamp, clipped(command.tilt, -limit, limit),
                   clipped(command.thrust, 0.0, robot.rotors.thrust_max))

