"""Parameters of the NMPC, as read from params/nmpc.yaml or nmpc_published.yaml."""

from collections import namedtuple
from dataclasses import dataclass

import numpy as np

from beetle_omni_ros.control.ocp import WEIGHTS
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.robot.schema import group, parameter, ParameterError, ParameterFile

LONGEST_HORIZON = 64  # MAX_STAGES of rti.c
# Servos and rotors in the optimal control problem: time constant of the first-order servo model
# [s], largest tilt target to each side [rad], largest tilt rate [rad/s], largest thrust [N].
Actuators = namedtuple('Actuators', 'servo_lag tilt tilt_rate thrust_max')


@dataclass(frozen=True, kw_only=True)
class HorizonParameters:
    """Length and grid of the horizon."""

    intervals: np.ndarray = parameter(
        [0.02, 0.03, 0.04, 0.06, 0.08, 0.1, 0.12, 0.15, 0.2, 0.2], unit='s', doc='lengths of the '
        'shooting intervals, first to last; their sum is the horizon', low=0.005, high=0.5,
        read_only=True)

    change_time: float = parameter(
        0.1, doc='smallest duration of an interval in the cost of command leads', unit='s', low=0,
        high=1, read_only=True)

    def __post_init__(self):
        """Refuse a grid with too many stages for the solver."""
        if self.intervals.ndim != 1 or not 2 <= len(self.intervals) <= LONGEST_HORIZON:
            raise ParameterError(f'horizon.intervals: expected 2 to {LONGEST_HORIZON} lengths '
                                 f'[s], found {self.intervals.tolist()}')


@dataclass(frozen=True, kw_only=True)
class ModelParameters:
    """Options of the prediction model."""

    servo_lag: float | None = parameter(
        None, doc="time constant of the first-order servo model; absent: the robot's", unit='s',
        low=0.002, high=0.5, read_only=True)
    rotor_lag: bool = parameter(True, doc='thrust as a state with the rotor time constant '
                                '(21 states) instead of a direct input (17)', read_only=True)
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
    tilt_rate_share: float = parameter(
        0.7, doc="largest tilt rate, as a share of the robot's: a bound on the lead of the tilt "
        'targets', low=0.01, high=1)
    tilt_rate_intervals: int = parameter(
        5, doc='number of first intervals with this bound; 0: none', low=0, high=60,
        read_only=True)
    thrust_max: float | None = parameter(
        None, doc="largest thrust inside the optimisation; absent: the robot's", unit='N', low=0.1,
        high=200)
    soft: bool = parameter(
        True, doc='limits of velocity, rate and height may be exceeded at a cost, which keeps the '
        'QP feasible', read_only=True)
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
class DisturbanceParameters:
    """Disturbance estimates; a bandwidth of 0 switches one off."""

    force_bandwidth: float = parameter(
        3.0, doc='bandwidth of the external force', unit='rad/s', low=0, high=50)
    torque_bandwidth: float = parameter(
        4.0, doc='bandwidth of the external torque', unit='rad/s', low=0, high=50)
    tilt_bandwidth: float = parameter(
        3.0, doc='bandwidth of the servo offsets', unit='rad/s', low=0, high=50)


@dataclass(frozen=True, kw_only=True)
class SolverParameters:
    """Numerics."""

    max_iterations: int = parameter(
        30, doc='largest number of iterations of the interior-point method', low=1, high=500,
        read_only=True)


@dataclass(frozen=True, kw_only=True)
class NmpcParameters(ParameterFile, file='nmpc.yaml'):
    """All of them; one file, one controller."""

    horizon: HorizonParameters = group(HorizonParameters, 'look-ahead')
    model: ModelParameters = group(ModelParameters, 'prediction')
    limits: LimitParameters = group(LimitParameters, 'constraints')
    weights: NmpcWeights = group(NmpcWeights, 'cost')
    disturbance: DisturbanceParameters = group(DisturbanceParameters, 'offset-free control')
    solver: SolverParameters = group(SolverParameters, 'numerics')
    unwind: float = parameter(
        4.0, doc='tilt references are within +-pi, unless the nearest legal turn is closer to '
        'the present tilt by more than this; 0: always nearest, 6.3: always within +-pi',
        unit='rad', low=0, high=6.3)
    reach: float = parameter(10.0, doc='a target farther from the robot is refused', unit='m',
                             low=0.5, high=1000, read_only=True)

    def actuators(self, robot: RobotParameters) -> Actuators:
        """Servos and rotors of the problem: of the robot file, unless this file overrides them."""
        model, limits, joints = self.model, self.limits, robot.joints
        return Actuators(
            servo_lag=model.servo_lag or joints.time_constant,
            tilt=min(limits.tilt or joints.position_limit, joints.position_limit),
            tilt_rate=limits.tilt_rate_share * joints.velocity_limit,
            thrust_max=limits.thrust_max or robot.rotors.thrust_max)
