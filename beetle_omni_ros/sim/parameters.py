"""Parameters of the simulator from params/simulator.yaml, and the conditions of one flight."""

from dataclasses import dataclass

import numpy as np

from beetle_omni_ros.model.parameters import RobotParameters, Variation
from beetle_omni_ros.model.schema import parameter, ParameterError, ParameterFile

RPM_AT_1_NEWTON = 2700.0    # [1/min] of a rotor; grows with the root of the thrust; chosen

# The randomisation table of the paper: half-widths of uniform distributions. Biases, scales and
# latencies are drawn once for a seed, noise for each reading, on top of the nominal noise.
# docs/explanation/simulator.md explains how errors of estimates are applied to sensors.
MASS_SCALE = INERTIA_SCALE = 0.05           # [-] about 1
CENTRE_OF_MASS = 0.01                       # [m] each axis
POSITION_BIAS = POSITION_NOISE = 0.01       # [m] of the MoCap, each axis
# [rad] of the MoCap; the table prints deg, and rad is the more cautious interpretation
ORIENTATION_BIAS = ORIENTATION_NOISE = 0.01
# [m/s^2] of the accelerometer: 0.005 m/s of the table, divided by the time in which position fixes
# correct a velocity estimate, 0.1 s; chosen
ACCELERATION_BIAS = ACCELERATION_NOISE = 0.005 / 0.1
RATE_BIAS = RATE_NOISE = 0.005              # [rad/s] of the gyroscope
TILT_BIAS, TILT_NOISE = 0.0523599, 0.0349066    # [rad] 3 and 2 deg, encoders
LATENCY_UNIT = 0.005                        # [s] the table's dt
IMU_LATENCY = 3, 5                          # [dt] the stamp does not include this delay
TILT_LATENCY, COMMAND_LATENCY = (1, 2), (1, 3)  # [dt] of joint feedback, of each kind of command


@dataclass(frozen=True, kw_only=True)
class SimulatorParameters(ParameterFile, file='simulator.yaml'):
    """Content of params/simulator.yaml."""

    tick: float = parameter(doc='duration of one step, the period of IMU and joint feedback',
                            unit='s', low=0.0005, high=0.05)
    substeps: int = parameter(doc='integration steps in one tick', low=1, high=100)
    foot_spread: float = parameter(doc='|x| = |y| of a foot', unit='m', low=0.01, high=5)
    foot_depth: float = parameter(doc='depth of the sole of a foot below base_link', unit='m',
                                  low=0.01, high=5)
    foot_radius: float = parameter(doc='radius of the ball at the end of a leg', unit='m',
                                   low=1e-3, high=0.5)
    propeller_radius: float = parameter(doc='radius of the contact disc of a propeller', unit='m',
                                        low=0.005, high=2)
    end_effector_radius: float = parameter(doc='radius of the end-effector ball', unit='m',
                                           low=0.001, high=1)
    crash_speed: float = parameter(doc='largest speed at a contact that the robot survives',
                                   unit='m/s', low=0.01, high=100)
    crash_inclination: float = parameter(
        doc='largest inclination in a contact that the robot survives', unit='rad', low=0, high=4)
    command_delay: float = parameter(doc='time from the stamp of a command until it acts',
                                     unit='s', low=0, high=0.5)
    command_timeout: float = parameter(doc='time without a command after which the rotors stop',
                                       unit='s', low=0.01, high=10)
    battery_capacity: float = parameter(doc='charge of a full battery', unit='Ah', low=0.01,
                                        high=1000)
    battery_charge: float = parameter(doc='charge at reset as a fraction of a full battery', low=0,
                                      high=1)
    rotor_power: float = parameter(doc='electrical power of a rotor divided by thrust^1.5',
                                   unit='W/N^1.5', low=0, high=1000)
    idle_power: float = parameter(doc='power of computer, servos and radio', unit='W', low=0,
                                  high=10000)
    specific_force_noise: float = parameter(doc='standard deviation of an axis of the IMU',
                                            unit='m/s^2', low=0, high=10)
    angular_velocity_noise: float = parameter(doc='standard deviation of an axis of the IMU',
                                              unit='rad/s', low=0, high=10)
    mocap_period: float = parameter(doc='time between two frames', unit='s', low=0.001, high=1)
    mocap_latency: float = parameter(doc='time from capture to arrival', unit='s', low=0, high=1)
    position_noise: float = parameter(doc='standard deviation of an axis of the MoCap', unit='m',
                                      low=0, high=1)
    orientation_noise: float = parameter(doc='standard deviation about an axis of the MoCap',
                                         unit='rad', low=0, high=1)
    encoder_latency: float = parameter(doc='time from capture to arrival of joint feedback',
                                       unit='s', low=0, high=1)


@dataclass(frozen=True, kw_only=True)
class Conditions:
    """Constants of one flight; the noises are half-widths of uniform ones, in units of biases."""

    variation: Variation                # of the body from the robot file
    position_bias: np.ndarray           # (3,) of the MoCap [m]
    orientation_bias: np.ndarray        # (3,) of the MoCap, a rotation vector [rad]
    imu_bias: np.ndarray                # (6,) specific force [m/s^2], rate [rad/s]
    tilt_bias: np.ndarray               # (4,) encoder reading minus true tilt [rad]
    imu_uniform_noise: np.ndarray       # (6,)
    mocap_uniform_noise: np.ndarray     # (6,)
    tilt_uniform_noise: float
    imu_latency: float                  # that its stamps do not contain [s]
    tilt_latency: float                 # age of joint feedback [s]
    tilt_command_delay: float           # from a command's stamp until it acts [s]
    thrust_command_delay: float         # [s]

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
    if name not in ('nominal', 'published'):
        raise ParameterError(f"conditions: '{name}' is unknown; expected one of nominal, "
                             'published')
    published = name == 'published'

    def uniform(half_width, size=None):
        return published * generator.uniform(-half_width, half_width, size)

    def latency(span, nominal):
        drawn = float(generator.integers(span[0], span[1] + 1) * LATENCY_UNIT)
        return drawn if published else nominal

    variation = Variation(1 + uniform(MASS_SCALE), 1 + uniform(INERTIA_SCALE, 3),
                          uniform(CENTRE_OF_MASS, 3))
    acceleration_bias = uniform(ACCELERATION_BIAS, 3)
    return Conditions(
        variation=variation,
        position_bias=uniform(POSITION_BIAS, 3),
        orientation_bias=uniform(ORIENTATION_BIAS, 3),
        imu_bias=np.concatenate([acceleration_bias, uniform(RATE_BIAS, 3)]),
        tilt_bias=uniform(TILT_BIAS, 4),
        imu_uniform_noise=published * np.repeat([ACCELERATION_NOISE, RATE_NOISE], 3),
        mocap_uniform_noise=published * np.repeat([POSITION_NOISE, ORIENTATION_NOISE], 3),
        tilt_uniform_noise=published * TILT_NOISE,
        imu_latency=latency(IMU_LATENCY, 0.0),
        tilt_latency=latency(TILT_LATENCY, parameters.encoder_latency),
        tilt_command_delay=latency(COMMAND_LATENCY, parameters.command_delay),
        thrust_command_delay=latency(COMMAND_LATENCY, parameters.command_delay))
