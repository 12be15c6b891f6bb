"""Nonlinear model predictive control by real-time iteration, and its parameters."""

from dataclasses import dataclass

import numpy as np

from beetle_omni_ros.control.base import Command, PoseTarget, State, Target
from beetle_omni_ros.control.disturbance import DisturbanceEstimator, DisturbanceParameters
from beetle_omni_ros.control.guidance import Guidance
from beetle_omni_ros.control.ocp import Rti, WEIGHTS
from beetle_omni_ros.control.references import ReferencePlanner
from beetle_omni_ros.model import dynamics as model
from beetle_omni_ros.model.allocation import ActuatorHealth, ALL_HEALTHY, clipped
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.model.schema import group, parameter, ParameterError, ParameterFile, RunError

FIRST_ITERATIONS = 5     # from a cold start, before the first command
NARROW = 1e-3            # [rad or N] between bounds of a failed actuator; the QP needs an interior
# Cost of exceeding velocity, rate or height, the published ones of velocity and rate: linear,
# squared, and squared height [1/m^2], so large that the plan is lower only if unavoidable.
SLACKS = 10.0, 100.0, 1e5
TOLERANCE, MAX_ITERATIONS = 1e-6, 50    # largest residual of a solved QP, and its iterations
# Largest tilt rate of the plan, as a share of the servos': they turn more slowly under load.
TILT_RATE_SHARE = 0.7
NO_HEIGHT = -1000.0      # [m] a bound that is never reached
FAILURES_TO_RESTART = 5  # unsolved cycles in a row after which the horizon is initialised again


@dataclass(frozen=True, kw_only=True)
class ModelParameters:
    """Options of the prediction model."""

    servo_lag: float | None = parameter(
        None, doc="time constant of the first-order servo model; absent: the robot's", unit='s',
        low=0.002, high=0.5)
    rotor_lag: bool = parameter(True, doc='thrust as a state with the rotor time constant '
                                '(21 states) instead of a direct input (17)')
    command_delay: float = parameter(
        0.01, doc='delay from the state stamp to the actuators, which is predicted', unit='s',
        low=0, high=0.1)


@dataclass(frozen=True, kw_only=True)
class LimitParameters:
    """Constraints of the optimisation."""

    velocity: float = parameter(
        3.0, doc='largest component of the world velocity', unit='m/s', low=0.05, high=20)
    rate: float = parameter(
        6.0, doc='largest component of the body rate', unit='rad/s', low=0.1, high=50)
    tilt: float | None = parameter(
        None, doc="largest tilt target, to each side; at most, and if absent, the robot's",
        unit='rad', low=0.1, high=20)
    tilt_rate_intervals: int = parameter(
        5, doc='number of first intervals in which the lead of tilt targets is bounded by the '
        'rate of the servos; 0: none', low=0, high=60)
    thrust_max: float | None = parameter(
        None, doc="largest thrust inside the optimisation; absent: the robot's", unit='N', low=0.1,
        high=200)
    soft: bool = parameter(
        True, doc='limits of velocity, rate and height may be exceeded at a cost, which keeps the '
        'QP feasible')
    height: float = parameter(
        0.5, doc='smallest height of base_link in world, unless the target is lower; inactive '
        'until the robot was above it; -1000: none',
        unit='m', low=-1000, high=1000)


def weight(default: float, doc: str, unit: str):
    """Weight of a squared error."""
    return parameter(default, doc=doc, unit=unit, low=0, high=1e5)


@dataclass(frozen=True, kw_only=True)
class NmpcWeights:
    """Weights of the squared errors."""

    position_xy: float = weight(300.0, 'horizontal position', '1/m^2')
    position_z: float = weight(400.0, 'height', '1/m^2')
    velocity: float = weight(10.0, 'linear velocity', 's^2/m^2')
    attitude_xy: float = weight(300.0, 'x and y of the error quaternion', '1')
    attitude_z: float = weight(600.0, 'z of the error quaternion', '1')
    rate: float = weight(5.0, 'body rate', 's^2/rad^2')
    tilt: float = weight(20.0, 'tilt against the hover allocation', '1/rad^2')
    thrust: float = weight(1.0, 'thrust against the hover allocation', '1/N^2')
    tilt_change: float = weight(250.0, 'tilt target against present tilt', '1/rad^2')
    thrust_change: float = weight(1.0, 'thrust target against present thrust', '1/N^2')
    thrust_command: float = weight(0.0, 'thrust target against the hover allocation', '1/N^2')

    def vector(self) -> np.ndarray:
        """In the order of :data:`ocp.WEIGHTS`."""
        return np.array([getattr(self, name) for name in WEIGHTS])


@dataclass(frozen=True, kw_only=True)
class NmpcParameters(ParameterFile, file='nmpc.yaml'):
    """All of them; one file, one controller."""

    horizon: np.ndarray = parameter(
        [0.02, 0.03, 0.04, 0.06, 0.08, 0.1, 0.12, 0.15, 0.2, 0.2], unit='s', doc='lengths of the '
        'shooting intervals, first to last', low=0.005, high=0.5)
    model: ModelParameters = group(ModelParameters, 'prediction')
    limits: LimitParameters = group(LimitParameters, 'constraints')
    weights: NmpcWeights = group(NmpcWeights, 'cost')
    disturbance: DisturbanceParameters = group(DisturbanceParameters, 'offset-free control')
    unwind: float = parameter(
        4.0, doc='tilt references are within +-pi, unless the nearest legal turn is closer to '
        'the present tilt by more than this; 0: always nearest, 6.3: always within +-pi',
        unit='rad', low=0, high=6.3)
    without: str = parameter('', doc="'unwinding' or 'all': no guidance")
    reach: float = parameter(10.0, doc='a target farther from the robot is refused', unit='m',
                             low=0.5, high=1000)

    def actuators(self, robot: RobotParameters) -> tuple[float, float, float, float]:
        """
        Actuators of the problem: of the robot file, unless this file overrides them.

        Time constant of the first-order servo model [s], largest tilt target to each side [rad],
        largest tilt rate [rad/s], largest thrust [N].
        """
        limits, joints = self.limits, robot.joints
        return (self.model.servo_lag or joints.time_constant,
                min(limits.tilt or joints.position_limit, joints.position_limit),
                TILT_RATE_SHARE * joints.velocity_limit,
                limits.thrust_max or robot.rotors.thrust_max)


class NmpcController:
    """
    The model-based controller.

    Each step estimates disturbances, predicts the state at the time at which the command will act,
    shifts the stored horizon, and solves one QP. If a QP is not solved, the shifted previous plan
    is used; after several in a row the horizon is initialised again. Between poses whose joints
    are wound differently, the plan may end in a local minimum; :mod:`control.guidance` leads out
    of it through the level attitude.
    """

    name, Parameters = 'nmpc', NmpcParameters
    period = 0.01  # [s] 100 Hz, as published

    def __init__(self, robot: RobotParameters, parameters: NmpcParameters | None = None):
        """Build or load the solver; ParameterError if there is no usable compiler."""
        p = parameters or NmpcParameters.load()
        servo_lag, tilt, tilt_rate, thrust_max = p.actuators(robot)
        self._parameters, self.reach = p, p.reach
        self._robot = robot
        try:
            self._rti = Rti(robot, servo_lag, p.model.rotor_lag, p.horizon,
                            SLACKS if p.limits.soft else None, TOLERANCE, MAX_ITERATIONS,
                            p.limits.tilt_rate_intervals - 1)
        except RunError as error:
            raise ParameterError(f'the NMPC needs a C compiler: {error}') from None
        self._estimator = DisturbanceEstimator(robot, p.disturbance, p.model.command_delay)
        self._planner = ReferencePlanner(robot, np.r_[0.0, np.cumsum(p.horizon)], p.unwind,
                                         servo_lag)
        self._weights, self._state_size = p.weights.vector(), self._rti.states.shape[1]
        self._all_bounds = np.r_[np.full(4, -tilt), np.full(4, robot.rotors.thrust_min),
                             np.full(4, tilt), np.full(4, thrust_max),
                             p.limits.velocity, p.limits.rate,
                             # lead of a held target at which the lag has the rate limit
                             tilt_rate * p.horizon / -np.expm1(-p.horizon / servo_lag)]
        self._health, self._bounds = ALL_HEALTHY, self._all_bounds
        # Plan and disturbance estimate do what the other layers do.
        self._guidance = Guidance(robot.tilt_axes, f'{p.without},routing,easing,trimming,gravity')
        self.guidance = self._guidance.text
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
        self._guidance.reset()
        self._started, self._failures, self._iterate = False, 0, 0
        self._above = False     # whether the robot was above the smallest height
        self._steps = self._unsolved = self._iterations = 0

    def step(self, state: State, target: Target) -> Command:
        """One command for one state; see the class."""
        if isinstance(target, PoseTarget) and self._health.healthy:
            target = self._guidance.target(state, target)
        full = self._estimator.update(state)
        x0 = np.concatenate([full[:13], full[model.TILT], full[model.THRUST]])[:self._state_size]
        start = state.stamp + self._estimator.delay
        disturbance = self._estimator.disturbance
        references = self._planner.plan(target, start, state.quaternion, full[model.TILT],
                                        disturbance)
        lowest = self._parameters.limits.height
        self._above = self._above or full[2] > lowest   # no bound before, as on the floor
        bounds = np.concatenate([self._bounds, np.minimum(
            references[1:, 2], lowest if self._above else NO_HEIGHT)])
        if not self._started:
            self._rti.fill(x0, np.clip(references[0, 13:21], self._bounds[:8], self._bounds[8:16]))
            self._iterate = FIRST_ITERATIONS
        else:
            self._rti.shift(self.period)
        for _ in range(1 + self._iterate):
            solved, self._iterations = self._rti.step(x0, references, disturbance, self._weights,
                                                      bounds)
        self._iterate = 0
        self._steps, self._unsolved = self._steps + 1, self._unsolved + (not solved)
        self._failures = 0 if solved else self._failures + 1
        self._started = self._failures < FAILURES_TO_RESTART
        return self._command(state.stamp)

    def _command(self, stamp):
        planned, bounds, rotors = self._rti.inputs[0], self._bounds, self._robot.rotors
        tilt = clipped(self._estimator.sent(planned[:4]), bounds[:4], bounds[8:12])
        thrust = clipped(clipped(planned[4:], bounds[4:8], bounds[12:16]),
                         rotors.thrust_min, rotors.thrust_max)
        if not self._health.healthy:
            tilt, thrust = self._health.possible(tilt, thrust)
        return Command(stamp, tilt, thrust)

    def diagnostics(self) -> dict[str, float | int | str]:
        """Solver health and estimated disturbances."""
        d = self._estimator.disturbance
        return {'steps': self._steps, 'unsolved': self._unsolved, 'iterations': self._iterations,
                **self._guidance.diagnostics(),
                'latency_estimate_s': self._estimator.latency,
                'force_estimate_N': float(np.linalg.norm(d[model.FORCE])),
                'torque_estimate_Nm': float(np.linalg.norm(d[model.TORQUE])),
                'servo_offset_rad': float(np.max(np.abs(d[model.TILT_OFFSET])))}
