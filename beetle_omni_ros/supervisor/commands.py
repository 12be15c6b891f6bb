"""Commands of the controllers: checks, silence, age; the last check of the one that is sent."""

from collections import Counter, deque
from dataclasses import replace
from math import exp, inf, isfinite

import numpy as np

from beetle_omni_ros.control.base import Command
from beetle_omni_ros.model.allocation import ActuatorHealth, clipped, NO_ZEROS, ROTORS
from beetle_omni_ros.model.parameters import RobotParameters

FROZEN = 'the same numbers again'
JUMP = 'implausible jump'

TIMEOUT = 0.05          # [s] without a valid command: 5 periods of 100 Hz
RETURN_AFTER = 0.5      # [s] of valid commands before a controller gets control (again)
STALE_AFTER = 0.05      # [s] a command computed from an older state is refused
AHEAD = 0.02            # [s] a stamp farther in the future comes from another clock
OVERSTEP = 0.25         # [-] of a range: 5 N, 1 rad. A wrong unit exceeds it by a factor of 3
STEP = 1.0, 7.5         # [rad] and [N] at once: ten times what a joint can turn in a period, and
                        # four times what a rotor can change. A jump of tilts alone is none: by far
                        # targets on both sides a policy sets the rate of a joint
SAME = 10               # commands or estimates in a row that are equal to the last digit
AGES = 30               # messages: 0.3 s of commands at 100 Hz; a queue after a stall holds ten
HANDOVER_TIME = 0.3     # [s] longest duration: half a turn of a joint
TILT_RATE = 9.0         # [rad/s] as in hover.yaml: below the servos' 10
THRUST_RATE = 300.0     # [N/s] as in hover.yaml: 3 N a period
LEAD = 0.5              # [rad] from its target a joint turns at its full rate: 50 ms of delay and
                        # lag at 10 rad/s
SOME = 5                # late ones, 50 ms: before the fastest detector names an actuator (60 ms)


class Silence:
    """
    Time since the last message of a source.

    Time is counted in ticks of the supervisor, each of limited length. After a stall of the
    process or a change of the clock, messages in the queue are therefore processed before a source
    is treated as failed.

    Attributes:
        elapsed: [s], inf before the first message.
        silent: whether the silence is longer than ``limit`` [s].
        lost: whether there were messages, and are none now.

    """

    def __init__(self, limit: float):
        self.limit = limit
        self.elapsed, self.silent, self.lost, self._fresh = inf, True, False, False

    def reset(self) -> None:
        """A message arrived within the present tick."""
        self.elapsed, self.silent, self.lost, self._fresh = 0.0, False, False, True

    def tick(self, dt: float) -> None:
        """``dt`` seconds passed; the tick with the message is not counted."""
        if not self._fresh:
            self.elapsed += dt
            self.silent = self.elapsed >= self.limit - 1e-9     # tolerance for rounding
            self.lost = self.silent and self.elapsed < inf
        self._fresh = False

    @property
    def text(self) -> str:
        """For messages: 'silent for 52 ms', or 'silent since the start'."""
        return 'silent since the start' if self.elapsed == inf else \
            f'silent for {1000 * self.elapsed:.0f} ms'


class Lateness:
    """
    Ages of the last messages of a source [s], from the IMU sample that they answer to now.

    Attributes:
        age: the median, so that single late messages have no effect.
        late, partly: whether the median, or at least SOME ages, are above the limit.

    """

    def __init__(self, limit: float):
        self._limit, self._ages = limit, deque([0.0] * AGES, AGES)
        self.age, self.late, self.partly = 0.0, False, False

    def add(self, age: float) -> None:
        """Receive the age of a message [s], of no stamp 0."""
        self._ages.append(age if isfinite(age) else 0.0)
        ages, limit = sorted(self._ages), self._limit + 1e-6    # tolerance for rounding
        self.age = ages[AGES // 2]
        self.late, self.partly = self.age > limit, ages[-SOME] > limit

    @property
    def text(self) -> str:
        """For messages: 'late: median age 31 ms, at most 20 ms'."""
        return f'late: median age {1000 * self.age:.0f} ms, at most {1000 * self._limit:.0f} ms'


class CommandStream:
    """
    Commands of one controller: the last accepted one, and refusals with reasons.

    Attributes:
        accepted: the last valid command, clipped to the ranges, or None.
        refused: reason -> count.
        silence: time since the last valid command.
        ages: of the commands, also of refused ones.
        good_for: time of valid commands without a gap or refusal, and not late [s].

    """

    def __init__(self, robot: RobotParameters, age_limit: float):
        self._robot = robot
        self.accepted: Command | None = None
        self.refused = Counter[str]()
        self._last_refusal = ''
        self.silence, self.ages = Silence(TIMEOUT), Lateness(age_limit)
        self.good_for = 0.0
        self._offered: Command | None = None
        self._same = 0

    @property
    def good(self) -> bool:
        """Whether the controller may get control."""
        return not self.silence.silent and self.good_for >= RETURN_AFTER - 1e-9

    @property
    def complaint(self) -> str:
        """Why the controller may not get control, for messages."""
        if self.silence.silent:
            last = f'; last refused: {self._last_refusal}' if self._last_refusal else ''
            return self.silence.text + last
        if self.ages.late:
            return self.ages.text
        return f'good for only {self.good_for:.2f} s of {RETURN_AFTER:g} s'

    def offer(self, command: Command, now: float, doubted: float = -np.inf) -> str:
        """
        Check one command; '' when a copy is stored, else the reason of the refusal.

        ``doubted`` is the stamp of a refused estimate, which controllers also received [s].
        """
        self.ages.add(now - command.stamp)
        reason, clean = self._check(command, now, doubted)
        if reason:
            self.refused[reason] += 1
            self._last_refusal = reason
            # A step to a new target causes one jump. Repeated jumps end in the timeout.
            if reason != JUMP:
                self.good_for = 0.0
            return reason
        self.accepted, self._last_refusal = clean, ''
        self.silence.reset()
        return ''

    def tick(self, dt: float) -> None:
        """``dt`` seconds passed."""
        self.silence.tick(dt)
        self.good_for = 0.0 if self.silence.silent or self.ages.late else self.good_for + dt

    def forget(self) -> None:
        """Accept any stamp, after a step of the clock."""
        self.accepted = self._offered = None
        self.silence = Silence(TIMEOUT)

    def _check(self, command, now, doubted):
        """Reason of a refusal and, without one, a copy within the limits."""
        stamp, tilt, thrust = command.stamp, command.tilt, command.thrust
        clean = within_limits(command, self._robot)
        if clean is None or not isfinite(stamp):
            return 'not finite', None
        if stamp == doubted:
            return 'answers a refused estimate', None
        if now - stamp > STALE_AFTER:
            return 'stale stamp', None
        if stamp - now > AHEAD:
            return 'stamp in the future', None
        if self.accepted is not None and stamp <= self.accepted.stamp:
            return 'repeated or older stamp', None
        if _apart(tilt, clean.tilt) > OVERSTEP * self._robot.joints.position_limit:
            return 'tilt out of range', None
        if _apart(thrust, clean.thrust) > OVERSTEP * self._robot.rotors.thrust_max:
            return 'thrust out of range', None
        before, self._offered = self._offered, clean
        if before is None:
            return '', clean
        tilted, changed = _apart(clean.tilt, before.tilt), _apart(clean.thrust, before.thrust)
        self._same = self._same + 1 if tilted == changed == 0 else 0
        if self._same >= SAME:
            return FROZEN, None
        # Compared with the previous command, accepted or not: a single spike is refused, a real
        # step is delayed by one period.
        jumps = tilted > STEP[0] and changed > STEP[1]
        return (JUMP, None) if jumps and stamp - before.stamp <= TIMEOUT else ('', clean)


def _apart(a, b):
    """Largest difference of two arrays of four numbers."""
    return max(map(abs, (a - b).tolist()))


def within_limits(command: Command, robot: RobotParameters) -> Command | None:
    """Final check of the output: finite and clipped to the limits, or None."""
    if not all(map(isfinite, [*command.tilt.tolist(), *command.thrust.tolist()])):
        return None
    limit = robot.joints.position_limit
    return Command(command.stamp, clipped(command.tilt, -limit, limit),
                   clipped(command.thrust, 0.0, robot.rotors.thrust_max))


class Output:
    """
    The executed command.

    Attributes:
        in_force: the last one within the limits, or None.
        given: the same before the final check; None: the next one is checked in any case.
        hand_over_left: longest time in which changes are still limited [s].
        thrusts: (4,) modelled with the rotors' lag [N].

    """

    def __init__(self, robot: RobotParameters):
        self._robot = robot
        self.in_force: Command | None = None
        self.given: Command | None = None
        self._sent: Command | None = None
        self.hand_over_left, self.thrusts = 0.0, np.zeros(ROTORS)

    def checked(self, command: Command, health: ActuatorHealth) -> Command | None:
        """Final check: within limits and in angles of the present encoders; None: not finite."""
        if command is self.given:
            return self._sent
        self.given = command
        self.in_force = self._sent = sent = within_limits(command, self._robot)
        if sent is not None and health.zeros != NO_ZEROS:   # an encoder has jumped
            limit = self._robot.joints.position_limit
            self._sent = replace(sent, tilt=clipped(health.read(sent.tilt), -limit, limit))
        return self._sent

    def hand_over(self, asked: Command) -> Command:
        """
        Limit the change from the executed command after a change of the controller.

        A controller on standby has similar commands, but in a large turn they may differ. The
        limit ends when the new command is reached, or after HANDOVER_TIME.
        """
        before = self.in_force
        if self.hand_over_left <= 0 or before is None:
            return asked
        step = asked.stamp - before.stamp
        if step <= 0:       # a command for this state was already executed
            return before
        self.hand_over_left -= step
        change = np.concatenate([asked.tilt - before.tilt, asked.thrust - before.thrust])
        reach = step * np.repeat([TILT_RATE, THRUST_RATE], ROTORS)
        if (np.abs(change) <= reach).all():
            self.hand_over_left = 0.0
            return asked
        change = np.clip(change, -reach, reach)
        return Command(asked.stamp, before.tilt + change[:ROTORS], before.thrust + change[ROTORS:])

    def pull_back(self, tilt: np.ndarray) -> None:
        """Continue from the joints at ``tilt`` (4,) [rad], as the last command may be far away."""
        if self.in_force is not None:
            self.in_force = replace(self.in_force, tilt=clipped(
                self.in_force.tilt, tilt - LEAD, tilt + LEAD))
            self.given = None

    def turn_rotors(self, dt: float, command: Command | None) -> None:
        """Advance the modelled thrusts by ``dt`` [s] under a command, None: no thrust."""
        share = 1 - exp(-dt / self._robot.rotors.time_constant)
        self.thrusts += share * ((0.0 if command is None else command.thrust) - self.thrusts)
