"""
Disturbance estimates for offset-free control.

Three slow estimates integrate the prediction error of the model: an external force in world, an
external torque in body and an offset of each servo's resting angle. An additional delay of the
commands is estimated, and noise is removed (:mod:`control.latency`). For a robot file with
``joint_friction`` the targets overcome it. docs/explanation/nmpc.md has the reasons.
"""

from collections import deque
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np

from beetle_omni_ros.control.base import Command, State
from beetle_omni_ros.control.latency import LatencyEstimator, NoiseFilter
from beetle_omni_ros.model import dynamics as model
from beetle_omni_ros.model import native
from beetle_omni_ros.model.allocation import ActuatorHealth, ALL_HEALTHY, clipped
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.model.rotations import matrix
from beetle_omni_ros.model.schema import parameter

MOTION = np.r_[model.VELOCITY, model.RATE]  # of a state: what the filter removes noise from
PERIOD = 0.01       # [s] between two states
LONGEST_STEP = 0.1  # [s] a longer gap between states restarts the actuator model
SHORT = 0.002           # [s] a command change nearer to an end of a span is treated as at this end
UNNOTICED = 0.3     # [s] before a fault is reported: the estimates contain the fault
RESOLUTION = 0.0015  # [rad] change of a target that reverses a servo: an encoder count
LIMIT = np.repeat([60.0, 5.0, 0.3], [3, 3, 4])  # of the estimates [N], [N m], [rad]
TILT_CORRECTION = 0.2   # share of a measured tilt error that corrects the tilt model in each step
# Initial standard deviations of predicted accelerations [m/s^2], [rad/s^2] and of tilts [rad].
MOTION_NOISE, TILT_NOISE = np.repeat([0.3, 3.0], 3), np.full(4, 0.01)
BLOCK = 0.075       # [s] mean accelerations over more than this give the delay: eight steps
HISTORY = 64        # number of stored states and commands, more than any latency needs


@dataclass(frozen=True, kw_only=True)
class DisturbanceParameters:
    """Disturbance estimates; a bandwidth of 0 switches one off."""

    force_bandwidth: float = parameter(
        3.0, doc='bandwidth of the external force', unit='rad/s', low=0, high=50)
    torque_bandwidth: float = parameter(
        4.0, doc='bandwidth of the external torque', unit='rad/s', low=0, high=50)
    tilt_bandwidth: float = parameter(
        3.0, doc='bandwidth of the servo offsets', unit='rad/s', low=0, high=50)
    latency: float = parameter(
        0.05, doc='largest additional delay of commands, and of joint feedback, that is estimated '
        'and predicted; 0: none', unit='s', low=0, high=0.2)


class DisturbanceEstimator:
    """
    Estimates the robot's full state and the disturbances.

    Args:
        robot: nominal robot.
        parameters: bandwidths.
        command_delay: from a command to the actuators without the robot file's effects [s].
        advance: :func:`dynamics.integrator`; None: of the robot without joint_friction, of which
            this class has its own model.

    Attributes:
        known_delay: from a command to the actuators [s], with the mean of the robot file's delays
            of tilts and thrusts, with which the NMPC's error on a lemniscate is smallest.
        disturbance: (10,) force in world [N], torque in body [N m], servo offsets [rad].
        reading: (4,) tilts without the noise of the encoders, moved on by the estimated additional
            delay of the joints [rad].

    """

    def __init__(self, robot: RobotParameters, parameters: DisturbanceParameters,
                 command_delay: float, advance: ca.Function | None = None):
        if advance is None:
            advance = native.compiled(model.integrator(replace(robot, effects={
                name: values for name, values in robot.effects.items()
                if name != 'joint_friction'})))
        self._advance, self._known_encoder_delay = (native.buffered(advance),
                                                    robot.sensors.encoder_delay)
        self.known_delay = max(command_delay + sum(robot.command_delays) / 2, 0.0)
        p, self._gravity = parameters, robot.gravity
        self._late = LatencyEstimator(p.latency, max(p.force_bandwidth, p.torque_bandwidth),
                                      MOTION_NOISE)
        self._late_tilts = LatencyEstimator(
            p.latency, p.tilt_bandwidth + TILT_CORRECTION / PERIOD, TILT_NOISE)
        # Slower filters would let the disturbance estimates oscillate.
        least = 4 * PERIOD * np.repeat([p.force_bandwidth, p.torque_bandwidth], 3)
        self._motion_noise = NoiseFilter(np.where(least > 0, least, 1.0))
        self._tilt_noise = NoiseFilter(np.zeros(4))
        self._estimates_latency = p.latency > 0
        # bandwidth times inertia: turns a velocity error of one step into a change of force
        self._force_gain = p.force_bandwidth * robot.mass
        self._torque_gain = p.torque_bandwidth * robot.inertia
        self._tilt_bandwidth = p.tilt_bandwidth
        servos = [model.tilt_servo(robot, joint, 0.0)[0] for joint in range(4)]
        self._band = np.array([(servo.coulomb or 0.0) / servo.kp for servo in servos])
        self._sticks = self._band.any()
        self._health = ALL_HEALTHY
        self._movable = np.ones(4)
        self.reset()

    @property
    def latency(self) -> float:
        """Estimated additional delay of the commands [s]."""
        return self._late.latency

    @property
    def delay(self) -> float:
        """From a command to the actuators [s]."""
        return self.known_delay + self.latency

    @property
    def encoder_delay(self) -> float:
        """From the capture of tilts to their stamp [s]."""
        return self._known_encoder_delay + self._late_tilts.latency

    def reset(self):
        """Reset all estimates."""
        for each in (self._late, self._late_tilts, self._motion_noise, self._tilt_noise):
            each.reset()
        self._begin_block()
        self.disturbance = np.zeros(model.DISTURBANCE_SIZE)
        self._state: np.ndarray | None = None
        self.reading = np.zeros(4)
        self._direction = np.zeros(4)
        self._stamp = -np.inf
        self._commands: deque[Command] = deque(maxlen=HISTORY)
        self._tilts: deque[tuple[float, np.ndarray]] = deque(maxlen=HISTORY)
        self._learnt: deque[tuple[float, np.ndarray]] = deque(maxlen=HISTORY)

    def set_health(self, health: ActuatorHealth) -> None:
        """
        Predict with the remaining actuators from now on.

        Changes of the disturbance estimates shortly before the fault was reported are undone.
        """
        self._health = health
        self._movable = np.array([float(angle is None) for angle in health.stuck])
        before = [d for stamp, d in self._learnt if stamp <= self._stamp - UNNOTICED]
        self.disturbance = before[-1].copy() if before else np.zeros(model.DISTURBANCE_SIZE)
        self.disturbance[model.TILT_OFFSET] *= self._movable
        if self._state is not None:
            self._state = self._state.copy()
            self._state[model.TILT], self._state[model.THRUST] = health.possible(
                self._state[model.TILT], self._state[model.THRUST])

    def update(self, state: State) -> np.ndarray:
        """Observe, and predict the state (25,) at which a command for ``state`` acts."""
        return self.flown(self.observe(state), state.stamp, self.delay)

    def ahead(self, state: State) -> State:
        """Update with one state; returns it as far ahead as the commands act later than known."""
        seen = present = self.observe(state)
        if self.latency > SHORT:
            seen = self.flown(present, state.stamp, self.latency)
        return flown(state, seen, self.reading + seen[model.TILT] - present[model.TILT])

    def observe(self, state: State) -> np.ndarray:
        """Update with one state estimate; returns the (25,) full state at its stamp."""
        if state.command is not None and (
                not self._commands or state.command.stamp > self._commands[-1].stamp):
            self._sent = state.command.tilt
            # with the tilts at which each servo would rest without friction
            rest = clipped(self._commands[-1].tilt, self._sent - self._band,
                           self._sent + self._band) if self._sticks and self._commands \
                else self._sent
            self._commands.append(Command(state.command.stamp, rest, state.command.thrust))
        step = state.stamp - self._stamp
        motion = np.concatenate([state.velocity, state.angular_velocity])
        if self._state is None or not 0 < step <= LONGEST_STEP:
            thrust = np.zeros(4) if state.command is None else state.command.thrust
            actuators = np.concatenate([state.tilt, state.tilt_velocity, thrust])
            self._tilts.clear()
            self._late.pause()
            self._late_tilts.pause()
            self._begin_block()
        else:
            predicted = self.flown(self._state, self._stamp, step)
            error = self._motion_noise.without(motion - predicted[MOTION], step)
            motion = predicted[MOTION] + error
            self._learn(state, predicted, error)
            actuators = predicted[13:]
        present = np.concatenate([state.position, motion[:3], state.quaternion, motion[3:],
                                  actuators])
        self._correct_tilt(state, present, step)
        self._state, self._stamp = present, state.stamp
        self._tilts.append((state.stamp, present[model.TILT].copy()))
        self._learnt.append((state.stamp, self.disturbance))
        return present

    def sent(self, tilt: np.ndarray) -> np.ndarray:
        """Targets (4,) [rad] that overcome the friction, for targets without friction."""
        if self._sticks and self._commands:
            motion = tilt - self._commands[-1].tilt
            self._direction = np.where(np.abs(motion) > RESOLUTION, np.sign(motion),
                                       self._direction)
        return tilt + self._band * self._direction

    def flown(self, state: np.ndarray, start: float, duration: float) -> np.ndarray:
        """(25,) state after a time span [s], in which commands may change."""
        end = start + duration
        changes = [end]
        for command in reversed(self._commands):    # newest first
            at = command.stamp + self.delay
            if at <= start + SHORT:
                break
            if at < end - SHORT:
                changes.append(at)
        for until in reversed(changes):
            tilt, thrust = self._input((start + until) / 2 - self.delay)
            if not self._health.healthy:
                tilt, thrust = self._health.possible(tilt, thrust)
            state = self._advance(state, np.concatenate([tilt, thrust]), self.disturbance,
                                  until - start)
            start = until
        return state

    def _input(self, stamp):
        """Tilts and thrusts of the command that was in force for a state of this stamp."""
        for command in reversed(self._commands):
            if command.stamp <= stamp:
                return command.tilt, command.thrust
        if self._commands:
            return self._commands[0].tilt, self._commands[0].thrust
        return (np.zeros(4) if self._state is None else self._state[model.TILT]), np.zeros(4)

    def _learn(self, state, predicted, error):
        change = np.zeros(model.DISTURBANCE_SIZE)
        change[model.FORCE] = self._force_gain * error[:3]
        change[model.TORQUE] = self._torque_gain * error[3:]
        self.disturbance = clipped(self.disturbance + change, -LIMIT, LIMIT)
        if self._estimates_latency:
            self._errors += error
            self._changes += predicted - self._state
            self._span += state.stamp - self._stamp
            if self._span > BLOCK:
                self._learn_latency(matrix(state.quaternion).T)

    def _learn_latency(self, to_body):
        """Compare the mean accelerations since the last call, in base_link."""
        changes, errors, span = self._changes, self._errors, self._span
        given = np.concatenate([changes[model.VELOCITY], changes[model.RATE]])
        given[2] += self._gravity * span
        given[:3], errors[:3] = to_body @ given[:3], to_body @ errors[:3]
        self._late.observe(given / span, errors / span, span)
        self._begin_block()

    def _begin_block(self):
        self._errors, self._changes, self._span = np.zeros(6), np.zeros(model.STATE_SIZE), 0.0

    def _correct_tilt(self, state, present, step):
        """Compare the encoders with the tilt model at their capture time."""
        stamp = state.tilt_stamp - self._known_encoder_delay
        due, modelled = (self._modelled_tilt(each) for each in (
            stamp, stamp - self._late_tilts.latency))
        self.reading = state.tilt
        if modelled is None:
            return
        error = state.tilt - modelled
        clean = self._tilt_noise.without(error, step)
        self.reading = due + clean
        limit = LIMIT[model.TILT_OFFSET]
        error = self._movable * clipped(error, -limit, limit)
        if self._estimates_latency:
            self._late_tilts.observe(modelled, error, step)
        present[model.TILT] += TILT_CORRECTION * self._movable * clipped(clean, -limit, limit)
        change = self._tilt_bandwidth * step * error
        if self._sticks and self._commands:
            # Friction explains a reading within the band, the offset only what is beyond.
            newest = self._commands[-1]
            rest = clipped(newest.tilt + change, self._sent - self._band, self._sent + self._band)
            change = change - (rest - newest.tilt)
            self._commands[-1] = Command(newest.stamp, rest, newest.thrust)
        offset = self.disturbance[model.TILT_OFFSET] + change
        self.disturbance[model.TILT_OFFSET] = clipped(offset, -limit, limit)

    def _modelled_tilt(self, stamp):
        later = None
        for time, tilt in reversed(self._tilts):
            if time <= stamp + 1e-6:
                if later is None or later[0] <= time:
                    return tilt
                part = (stamp - time) / (later[0] - time)
                return tilt + part * (later[1] - tilt)
            later = (time, tilt)
        return None


def flown(state: State, x: np.ndarray, tilt: np.ndarray) -> State:
    """State with the motion of ``x`` (25,) and the tilts (4,) [rad]."""
    return State(state.stamp, x[model.POSITION], x[model.VELOCITY], x[model.QUATERNION],
                 x[model.RATE], tilt, x[model.TILT_RATE], state.tilt_stamp, state.command)
