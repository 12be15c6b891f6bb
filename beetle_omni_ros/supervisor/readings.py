"""Detection of joints, rotors and MoCap poses that contradict commands and models."""

from collections import deque
from math import expm1, inf, isfinite, nan, sqrt

import numpy as np

from beetle_omni_ros.control.base import State
from beetle_omni_ros.model import rotations
from beetle_omni_ros.model.allocation import ROTORS
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.model.servo import Responses
from beetle_omni_ros.supervisor.wrench import LEAST_THRUST, SHARE

KEPT = 64               # commands, 0.3 s at 200 Hz
# Of joints
LONGEST = 0.1           # [s] between two readings; after a longer gap no jump is detected
ERROR = 0.25            # [rad] beside both models, and the friction of the file
TIME = 0.12             # [s] until it is a fault
DELAY = 0.025           # [s] command 10 to 15 ms, feedback 5 to 10 ms
SPREAD = 0.03           # [s] uncertainty of the delay: another 0.3 rad at 10 rad/s
JUMP = 0.5              # [rad] between two readings, beyond the motion that is possible
# Of rotors
LEARNT = 1.0            # [s] time constant of the learnt factor between speed and thrust
ROTOR_DELAY = 0.01      # [s] from a command's stamp until it acts
STALLED, SHORTEST = 2.5, 0.05   # [intervals], [s]: a longer pause of the reports is a stall
SETTLED = 0.3           # [s] after a stall, three time constants of a rotor
NOTICED = 0.25          # [-] missing share that confirms a loss by the wrench
ROTOR_TIME = 0.06       # [s] until a lost rotor is named: three ESC reports of 50 Hz
EXCESS = 3.0            # [N] over the command: a lag longer by a third leaves 1 N after a step
# Of MoCap
AGE = 0.05              # [s] largest time between pose and estimate
FASTEST = 6.0           # [m/s] largest speed of a robot in a hall
ATTITUDE = 0.35         # [rad] from the estimate, or jump against the gyroscope
DISTANCE = 0.3          # [m] the same; larger than the error of dead reckoning after 1 s
LASTING = 10            # poses, 0.1 s, of a contradiction
AFTER_JUMP = 30         # poses after a jump; longer than a temporary confusion of markers
FROZEN = 5              # equal poses; noise of 1 mm never repeats exactly


class JointWatch:
    """
    Compares encoders with the fastest and the slowest servo that the robot file allows.

    Both follow the commands with a first-order lag, at a limited rate and after a delay. A joint
    between them, or within the noise and its friction beside them, follows its commands.

    Attributes:
        commands: stamps [s] and joint targets (4,) [rad], the newest last.
        astray: joints (4) that do not follow their command.
        jump: 4 jumps [rad] of the last reading relative to the motion before it, if larger than a
            joint can turn, else 0.
        suspects: whether a joint differed from its model at the last reading.

    """

    def __init__(self, robot: RobotParameters):
        allowed = Responses.of(robot)
        self._rate_limit = robot.joints.velocity_limit
        self._lags, (low, high) = allowed.servo_lag, allowed.servo_delay
        self._delays = max(0.0, DELAY - SPREAD + low), DELAY + SPREAD + high
        self._error = ERROR + allowed.friction
        self.commands: deque = deque(maxlen=KEPT)
        self._stamp, zero = -inf, [0.0] * ROTORS
        self._tilt, self._models, self._change, self._for = zero, [zero, zero], zero, zero
        self.astray, self.jump, self.suspects = [False] * ROTORS, zero, False

    def on_joints(self, stamp: float, tilt: np.ndarray) -> None:
        """Receive a complete reading (4,) [rad] of the time ``stamp`` [s]."""
        dt, before, angles = stamp - self._stamp, self._tilt, tilt.tolist()
        self._stamp, self._tilt, self.jump = stamp, angles, [0.0] * ROTORS
        if dt > LONGEST:
            self._models, self._change, self._for = [angles, angles], self.jump, self.jump
            return
        reach = self._rate_limit * dt
        for k, (delay, lag) in enumerate(zip(self._delays, self._lags)):
            target = next((asked for at, asked in reversed(self.commands) if at <= stamp - delay),
                          tilt)
            gain = -expm1(-dt / lag)
            self._models[k] = [model + min(max(gain * (goal - model), -reach), reach)
                               for model, goal in zip(self._models[k], target.tolist())]
        changes = [new - old for new, old in zip(angles, before)]
        for i, change in enumerate(changes):
            if abs(change) > reach + JUMP:
                self.jump[i], changes[i] = change - self._change[i], self._change[i]
                for model in self._models:
                    model[i] = angles[i]
        self._change = changes
        self._for = [
            0.0 if min(one, other) - self._error <= angle <= max(one, other) + self._error
            else time + dt for time, angle, one, other in zip(self._for, angles, *self._models)]
        self.astray, self.suspects = [time >= TIME for time in self._for], any(self._for)


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
        self._responses = [(lag, ROTOR_DELAY + delay)
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
        self.lost = self._slow_for.index(slow) if slow >= ROTOR_TIME else None
        self.deaf = self._more_for.index(more) if more >= ROTOR_TIME else None

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


class MocapWatch:
    """
    Detects impossible jumps, repeated values, and lasting contradictions.

    Attributes:
        good: whether the last pose may be used.
        frozen: whether equal poses repeat.
        jumped: whether the contradiction began with a jump of MoCap.
        contradicts: whether pose and estimate have contradicted each other for long enough.

    """

    def __init__(self):
        self._before: tuple[float, np.ndarray, np.ndarray] | None = None
        self.good = self.frozen = self.jumped = self.contradicts = False
        self._same = self._off = 0

    def on_pose(self, stamp: float, position: np.ndarray, quaternion: np.ndarray,
                state: State | None) -> None:
        """Receive a pose and the estimate of about that time, None: there is none."""
        before, self._before = self._before, (stamp, position, quaternion)
        turning = 0.0 if state is None else sqrt(state.angular_velocity.dot(
            state.angular_velocity))
        if before is not None:
            dt, moved = stamp - before[0], position - before[1]
            turn = rotations.geodesic_angle(before[2], quaternion)
            self._same = self._same + 1 if not any(moved.tolist()) \
                and quaternion.tolist() == before[2].tolist() else 0
            if dt < LONGEST:
                self.jumped |= turn > ATTITUDE + turning * dt \
                    or sqrt(moved.dot(moved)) > DISTANCE + FASTEST * dt
        self.frozen = self._same >= FROZEN
        off = False
        if state is not None:
            error = position - state.position
            speed = sqrt(state.velocity.dot(state.velocity))
            off = rotations.geodesic_angle(state.quaternion, quaternion) \
                > ATTITUDE + turning * AGE or sqrt(error.dot(error)) > DISTANCE + speed * AGE
        self.jumped &= off
        self._off = self._off + 1 if off else 0
        self.contradicts = self._off >= (AFTER_JUMP if self.jumped else LASTING)
        self.good = not off and not self.frozen
