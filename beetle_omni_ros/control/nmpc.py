"""Nonlinear model predictive control by real-time iteration."""

from dataclasses import replace

import numpy as np

from beetle_omni_ros.control import ocp
from beetle_omni_ros.control.base import Command, State, Target
from beetle_omni_ros.control.disturbance import DisturbanceEstimator, FunctionCall
from beetle_omni_ros.control.nmpc_parameters import NmpcParameters
from beetle_omni_ros.control.references import ReferencePlanner
from beetle_omni_ros.control.rti import Rti
from beetle_omni_ros.robot import dynamics as model
from beetle_omni_ros.robot import native
from beetle_omni_ros.robot.allocation import ActuatorHealth, ALL_HEALTHY, clipped
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.robot.schema import ParameterError, RunError

FIRST_ITERATIONS = 5     # from a cold start, before the first command
NARROW = 1e-3            # [rad or N] between bounds of a failed actuator; the QP needs an interior
# Cost of exceeding velocity, rate or height, the published ones of velocity and rate: linear,
# squared, and squared height [1/m^2], so large that the plan is lower only if unavoidable.
SLACKS = 10.0, 100.0, 1e5
TOLERANCE = 1e-6         # largest residual of a solved QP
NO_HEIGHT = -1000.0      # [m] a bound that is never reached
FAILURES_TO_RESTART = 5  # unsolved cycles in a row after which the horizon is initialised again


class NmpcController:
    """
    The model-based controller: a :class:`control.base.Controller`.

    Each step estimates disturbances, predicts the state at the time at which the command will act,
    shifts the stored horizon, and solves one QP. If a QP is not solved, the shifted previous plan
    is used; after several in a row the horizon is initialised again.

    Args:
        robot: the controller's model of the robot.
        parameters: weights, limits, horizon.

    Raises:
        ParameterError: there is no usable compiler.

    """

    name, Parameters = 'nmpc', NmpcParameters
    period = 0.01  # [s] 100 Hz, as published

    def __init__(self, robot: RobotParameters, parameters: NmpcParameters | None = None):
        """Build or load the solver; the first time takes some seconds of compilation."""
        p = parameters or NmpcParameters.load()
        actuators = p.actuators(robot)
        self._parameters, self.reach = p, p.reach
        self._robot = robot
        problem = ocp.build(robot, actuators.servo_lag, p.model.rotor_lag,
                            p.horizon.change_time)
        intervals = p.horizon.intervals
        # The estimator has its own model of the servos' friction.
        advance = model.integrator(replace(robot, effects={
            name: values for name, values in robot.effects.items() if name != 'joint_friction'}))
        try:
            self._rti = Rti(problem, intervals, SLACKS if p.limits.soft else None, TOLERANCE,
                            p.solver.max_iterations, p.limits.tilt_rate_intervals - 1)
        except RunError as error:
            raise ParameterError(f'the NMPC needs a C compiler: {error}') from None
        self._estimator = DisturbanceEstimator(robot, p.disturbance, p.model.command_delay,
                                               FunctionCall(native.compiled(advance)))
        self._planner = ReferencePlanner(robot, np.r_[0.0, np.cumsum(intervals)], p.unwind,
                                         actuators.servo_lag)
        self._state_size = problem.state_size
        self._weights = p.weights.vector()
        self._all_bounds = np.r_[np.full(4, -actuators.tilt), np.full(4, robot.rotors.thrust_min),
                             np.full(4, actuators.tilt), np.full(4, actuators.thrust_max),
                             p.limits.velocity, p.limits.rate,
                             # lead of a held target at which the lag has the rate limit
                             actuators.tilt_rate * intervals / -np.expm1(
                                 -intervals / actuators.servo_lag)]
        self._health, self._bounds = ALL_HEALTHY, self._all_bounds
        self.reset()

    def set_health(self, health: ActuatorHealth) -> None:
        """
        Use only working actuators from the next step on; may be called in flight.

        Bounds in prediction, reference and plan: lost rotors have zero thrust, rotors that hold a
        thrust have this thrust, other rotors the limit of the pack, and stuck joints their angle.
        """
        if health == self._health:
            return
        self._health, self._bounds = health, self._all_bounds.copy()
        self._estimator.set_health(health)
        self._planner.set_health(health)
        lower, upper = self._bounds[:8], self._bounds[8:16]
        upper[4:] = [health.limited(thrust) for thrust in upper[4:]]
        for i, (turns, angle, held) in enumerate(zip(health.rotors, health.stuck, health.held)):
            if angle is not None:
                lower[i], upper[i] = angle - NARROW, angle + NARROW
            if not turns:
                lower[4 + i], upper[4 + i] = 0.0, NARROW
            elif held is not None:
                lower[4 + i], upper[4 + i] = held - NARROW, held + NARROW
        self._iterate = FIRST_ITERATIONS

    def reset(self) -> None:
        """Reset estimates and horizon."""
        self._estimator.reset()
        self._started, self._failures, self._iterate = False, 0, 0
        self._above = False     # whether the robot was above the smallest height
        self._statuses: dict[int, int] = {}
        self._iterations = self._rejected = 0

    @property
    def disturbance(self) -> np.ndarray:
        """(10,) estimated force in world [N], torque in body [N m], servo offsets [rad]."""
        return self._estimator.disturbance.copy()

    @property
    def predicted_states(self) -> np.ndarray:
        """(N + 1, 17 or 21) states of the present plan."""
        return self._rti.states.copy()

    def step(self, state: State, target: Target) -> Command:
        """One command for one state; see the class. A non-finite state repeats the plan."""
        if self._started and not _finite(state):
            self._rejected += 1
            return self._command(state.stamp)
        full = self._estimator.update(state)
        x0 = np.concatenate([full[:13], full[model.TILT], full[model.THRUST]])[:self._state_size]
        start = state.stamp + self._estimator.delay
        disturbance = self._estimator.disturbance
        references = self._planner.plan(target, start, state.quaternion, full[model.TILT],
                                        disturbance)
        bounds = np.concatenate([self._bounds, self._lowest(full[2], references[1:, 2])])
        if not self._started:
            self._rti.fill(x0, np.clip(references[0, 13:21], self._bounds[:8], self._bounds[8:16]))
            self._iterate = FIRST_ITERATIONS
        else:
            self._rti.shift(self.period)
        for _ in range(self._iterate):
            self._rti.step(x0, references, disturbance, self._weights, bounds)
        self._iterate = 0
        status, self._iterations = self._rti.step(x0, references, disturbance, self._weights,
                                                  bounds)
        self._statuses[status] = self._statuses.get(status, 0) + 1
        self._failures = 0 if status == 0 else self._failures + 1
        self._started = self._failures < FAILURES_TO_RESTART
        return self._command(state.stamp)

    def _lowest(self, height, targets):
        """Smallest height at each node; none until the robot was above it, as on the floor."""
        lowest = self._parameters.limits.height
        self._above = self._above or height > lowest
        return np.minimum(targets, lowest if self._above else NO_HEIGHT)

    def _command(self, stamp):
        planned = self._rti.inputs[0]
        command = clipped(np.r_[self._estimator.sent(planned[:4]), planned[4:]],
                          self._bounds[:8], self._bounds[8:16])
        rotors, health = self._robot.rotors, self._health
        tilt = command[:4]
        thrust = clipped(command[4:], rotors.thrust_min, rotors.thrust_max)
        return Command(stamp, *((tilt, thrust) if health.healthy else
                                health.possible(tilt, thrust)))

    def diagnostics(self) -> dict[str, float | int | str]:
        """Solver health and estimated disturbances."""
        steps = sum(self._statuses.values())
        unsolved = steps - self._statuses.get(0, 0)
        d = self._estimator.disturbance
        return {'steps': steps, 'unsolved': unsolved, 'rejected_states': self._rejected,
                'iterations': self._iterations,
                'force_estimate_N': float(np.linalg.norm(d[model.FORCE])),
                'torque_estimate_Nm': float(np.linalg.norm(d[model.TORQUE])),
                'servo_offset_rad': float(np.max(np.abs(d[model.TILT_OFFSET])))}


def _finite(state):
    return bool(np.isfinite(np.concatenate([
        state.position, state.velocity, state.quaternion, state.angular_velocity, state.tilt,
        state.tilt_velocity])).all())
