"""
Model matching: a policy flies another robot than that of its training.

What the policy observes and commands belongs to the robot of the training. The difference of the
two models is between it and the flown robot:

- Commands that act later: the policy observes the state that the model of the flown robot predicts
  for the additional delay of tilts or thrusts (Smith, Closer control of loops with dead time,
  1957).
- Rotors and servos: thrusts and tilts of the flown robot move as those of the robot of the
  training. For thrusts f with the lag T, a scale s of the flown robot, and the lag T* of the
  training, the command is f + T / T* (u / s - f) for the policy's command u.
- The body: the smallest change of tilts and thrusts gives the wrench for the same acceleration.
"""

from collections import deque
from dataclasses import replace

import casadi as ca
import numpy as np

from beetle_omni_ros.control.base import Command, State
from beetle_omni_ros.control.disturbance import (
    DisturbanceEstimator,
    DisturbanceParameters,
    flown,
    LONGEST_STEP,
)
from beetle_omni_ros.model import dynamics as model
from beetle_omni_ros.model import native
from beetle_omni_ros.model.allocation import clipped
from beetle_omni_ros.model.parameters import RobotParameters

# Largest change of a tilt [rad] and of a thrust [N] for the body: within it, the wrench changes
# nearly linearly.
LIMIT = np.repeat([0.3, 5.0], 4)
TILT_SHARE = 0.1    # [1] weight of the tilts in the smallest change: thrusts change first
DAMPING = 1e-4      # [1] of directions in which the actuators give no wrench


class ModelMatching:
    """
    Translation between the robot of a training and the flown robot.

    Args:
        trained: robot of the training.
        robot: the flown robot.
        command_delay: from the state stamp to the actuators without effects [s].
        latest: number of own commands that are recognised when they are reported as executed.
        latency: largest additional delay that is estimated [s].

    """

    def __init__(self, trained: RobotParameters, robot: RobotParameters, command_delay: float,
                 latest: int, latency: float = 0.0):
        self._trained, self._robot = trained, robot
        self._estimator = DisturbanceEstimator(
            robot, DisturbanceParameters(latency=latency), command_delay)
        # Of tilts and thrusts the later ones count: a loop forgives a command that acts earlier.
        self._own_delay, self._estimator.known_delay = (
            max(command_delay + max(each.command_delays), 0.0) for each in (trained, robot))
        self._wrenches = native.buffered(native.compiled(wrenches(trained, robot)))
        self._scale = robot.thrust_scale / trained.thrust_scale
        before, after = trained.joints, robot.joints
        inertia = after.inertia / before.inertia
        self._stiffness = inertia * before.kp / after.kp
        self._damping = (inertia * before.kd - after.kd) / after.kp
        # Faster rotors stay as they are: to slow them down would take accuracy away.
        self._lag = max(robot.rotors.time_constant / trained.rotors.time_constant, 1.0)
        # A tilt turns the thrust of hover: both sizes are in newtons.
        self._weights = np.repeat([TILT_SHARE / robot.hover_thrust ** 2, 1.0], 4)
        self._latest: deque[tuple[Command, Command]] = deque(maxlen=latest)
        self.reset()

    @property
    def latency(self) -> float:
        """Estimated additional delay of the commands [s]."""
        return self._estimator.latency

    def reset(self) -> None:
        """Forget the flight."""
        self._estimator.reset()
        self._latest.clear()
        self._stamp = -np.inf
        self._own: Command | None = None
        self._change, self._acting = np.zeros(8), np.zeros(8)   # commanded, and what acts of it
        self._thrust = np.zeros(4)      # that the robot of the training would have

    def observed(self, state: State) -> State:
        """
        State of the robot of the training, for the state of the flown one.

        Its command is the policy's own one, if the executed one was made from it.
        """
        present = self._estimator.observe(state)
        step, self._stamp = state.stamp - self._stamp, state.stamp
        own = next((own for sent, own in self._latest if same(sent, state.command)), None)
        # Without an own command in force, as on standby, the actuators are those of the robot.
        if own is None or self._own is None or not 0 < step <= LONGEST_STEP:
            self._thrust = self._scale * present[model.THRUST]
            self._change, self._acting = np.zeros(8), np.zeros(8)
        else:
            lags = np.repeat([self._robot.joints.time_constant,
                              self._robot.rotors.time_constant], 4)
            self._acting = self._acting + (1 - np.exp(-step / lags)) * (
                self._change - self._acting)
            self._thrust = self._thrust + (1 - np.exp(
                -step / self._trained.rotors.time_constant)) * (self._own.thrust - self._thrust)
        self._ahead = max(self._estimator.delay - self._own_delay, 0.0)
        self._seen = seen = self._estimator.flown(present, state.stamp, self._ahead)
        tilt = self._estimator.reading + seen[model.TILT] - present[model.TILT] - self._acting[:4]
        return replace(flown(state, seen, tilt), command=own or state.command)

    def sent(self, own: Command) -> Command:
        """Command for the flown robot, for the policy's own one on :meth:`observed`."""
        robot, scale, thrust = self._robot, self._scale, self._thrust
        x = self._estimator.flown(self._seen, own.stamp + self._ahead,
                                  self._estimator.delay - self._ahead)
        tilt = x[model.TILT] - self._acting[:4]
        u = np.concatenate([
            tilt + self._stiffness * (own.tilt - tilt) - self._damping * x[model.TILT_RATE],
            (own.thrust + self._lag * (own.thrust - thrust)) / scale])
        # Both models have the commanded thrusts, because what is added has the same lag.
        like = np.concatenate([x[:model.TILT.start], tilt, x[model.TILT_RATE], own.thrust])
        columns = self._wrenches(like, u, np.concatenate([
            own.tilt, 2 * own.thrust - thrust])).reshape(9, 6).T
        self._own, self._change = own, self._least(columns[:, 0], columns[:, 1:])
        wanted, force = own.thrust / scale + self._change[4:], x[model.THRUST]
        limit = robot.joints.position_limit
        sent = Command(own.stamp, clipped(u[:4] + self._change[:4], -limit, limit), clipped(
            force + self._lag * (wanted - force), robot.rotors.thrust_min,
            robot.rotors.thrust_max))
        self._latest.append((sent, own))
        return sent

    def _least(self, missing, effectiveness):
        """Least change (8,) of tilts and thrusts that gives a wrench (6,)."""
        weighted = self._weights[:, None] * effectiveness.T
        square = effectiveness @ weighted
        change = weighted @ np.linalg.solve(
            square + DAMPING * np.trace(square) / 6 * np.eye(6), missing)
        return clipped(change, -LIMIT, LIMIT)


def same(one: Command, other: Command | None) -> bool:
    """Whether two commands have equal numbers."""
    return other is not None and np.array_equal(one.tilt, other.tilt) \
        and np.array_equal(one.thrust, other.thrust)


def wrenches(trained: RobotParameters, robot: RobotParameters) -> ca.Function:
    """
    Return f(x (25), u (8), own (8)) -> (54,), the columns of a (6, 9) matrix.

    The first column is the wrench [N], [N m] in base_link that ``robot`` with the inputs ``u``
    lacks for the acceleration of ``trained`` with the inputs ``own``. The others are the changes
    of its wrench for each radian of tilt and each newton of thrust. ``x`` has the actuators of
    ``trained``.
    """
    x, u = ca.SX.sym('x', model.STATE_SIZE), ca.SX.sym('u', model.INPUT_SIZE)
    own, d = ca.SX.sym('own', model.INPUT_SIZE), ca.DM.zeros(model.DISTURBANCE_SIZE)
    scale = ca.DM(robot.thrust_scale / trained.thrust_scale)
    scaled = ca.vertcat(x[:model.THRUST.start], x[model.THRUST] / scale)
    rotation = model.rotation_matrix(x[model.QUATERNION])
    mass = robot.effect('mass.mass', robot.mass)
    inertia = ca.DM(robot.effect('inertia.inertia', robot.inertia))

    def wrench(x_dot):
        return ca.vertcat(mass * (rotation.T @ x_dot[model.VELOCITY]),
                          inertia * x_dot[model.RATE])

    given = wrench(model.full_model(robot)(scaled, u, d))
    missing = wrench(model.full_model(trained)(x, own, d)) - given
    effectiveness = ca.horzcat(ca.jacobian(given, x[model.TILT]),
                               ca.jacobian(given, x[model.THRUST]) @ ca.diag(scale))
    return ca.Function('wrenches', [x, u, own], [ca.vec(ca.densify(ca.cse(
        ca.horzcat(missing, effectiveness))))], ['x', 'u', 'own'], ['columns'])
