"""Conditions of a flight: variation of the robot, biases and latencies, drawn from a seed."""

from dataclasses import dataclass, field

import numpy as np

from beetle_omni_ros.robot.parameters import RobotParameters, Variation
from beetle_omni_ros.robot.schema import ParameterError
from beetle_omni_ros.sim.parameters import SimulatorParameters

NAMES = ('nominal', 'published')


def zeros(size: int):
    """Declare a dataclass field that defaults to ``size`` zeros."""
    return field(default_factory=lambda: np.zeros(size))


@dataclass(frozen=True, kw_only=True)
class Conditions:
    """
    Constants of one flight.

    Attributes:
        variation: deviation of mass, inertia and centre of mass from the robot file.
        position_bias: (3,) bias of the MoCap [m].
        orientation_bias: (3,) bias of the MoCap, a rotation vector [rad].
        imu_bias: (6,) biases of specific force [m/s^2] and angular velocity [rad/s].
        tilt_bias: (4,) encoder reading minus true tilt [rad].
        imu_uniform_noise: (6,) half-widths of the IMU's uniform noise.
        mocap_uniform_noise: (6,) half-widths for position [m] and rotation vector [rad].
        tilt_uniform_noise: half-width of the encoders' uniform noise [rad].
        imu_latency: latency of the IMU that its stamps do not contain [s].
        tilt_latency: age of joint feedback [s].
        tilt_command_delay: time from the stamp of a command until its tilts act [s].
        thrust_command_delay: time from the stamp of a command until its thrusts act [s].

    """

    variation: Variation = field(default_factory=Variation)
    position_bias: np.ndarray = zeros(3)
    orientation_bias: np.ndarray = zeros(3)
    imu_bias: np.ndarray = zeros(6)
    tilt_bias: np.ndarray = zeros(4)
    imu_uniform_noise: np.ndarray = zeros(6)
    mocap_uniform_noise: np.ndarray = zeros(6)
    tilt_uniform_noise: float = 0.0
    imu_latency: float = 0.0
    tilt_latency: float
    tilt_command_delay: float
    thrust_command_delay: float

    def command_delays(self, robot: RobotParameters) -> tuple[float, float]:
        """Delays of tilt and thrust commands [s], with the effects of the robot file."""
        tilt, thrust = robot.command_delays
        return self.tilt_command_delay + tilt, self.thrust_command_delay + thrust


def draw(name: str, parameters: SimulatorParameters,
         generator: np.random.Generator) -> Conditions:
    """
    Draw the conditions ``name``, 'nominal' or 'published'.

    Raises:
        ParameterError: unknown name.

    """
    if name == 'nominal':
        delay = parameters.actuators.command_delay
        return Conditions(tilt_latency=parameters.encoders.latency, tilt_command_delay=delay,
                          thrust_command_delay=delay)
    if name != 'published':
        raise ParameterError(f"conditions: '{name}' is unknown; expected one of "
                             f"{', '.join(NAMES)}")
    p = parameters.published

    def uniform(half_width, size=None):
        return generator.uniform(-half_width, half_width, size)

    def latency(span):
        low, high = np.rint(span).astype(int)
        return float(generator.integers(low, high + 1) * p.latency_unit)

    variation = Variation(1 + uniform(p.mass_scale), 1 + uniform(p.inertia_scale, 3),
                          uniform(p.centre_of_mass, 3))
    acceleration_bias = uniform(p.velocity_bias / p.velocity_correction_time, 3)
    return Conditions(
        variation=variation,
        position_bias=uniform(p.position_bias, 3),
        orientation_bias=uniform(p.orientation_bias, 3),
        imu_bias=np.concatenate([acceleration_bias, uniform(p.angular_velocity_bias, 3)]),
        tilt_bias=uniform(p.tilt_bias, 4),
        imu_uniform_noise=np.repeat([p.velocity_noise / p.velocity_correction_time,
                                     p.angular_velocity_noise], 3),
        mocap_uniform_noise=np.repeat([p.position_noise, p.orientation_noise], 3),
        tilt_uniform_noise=p.tilt_noise,
        imu_latency=latency(p.imu_latency),
        tilt_latency=latency(p.tilt_latency),
        tilt_command_delay=latency(p.tilt_command_latency),
        thrust_command_delay=latency(p.thrust_command_latency))
