"""Parameters of the simulator from params/simulator.yaml, and the conditions of one flight."""

from dataclasses import dataclass, field

import numpy as np

from beetle_omni_ros.robot.parameters import RobotParameters, Variation
from beetle_omni_ros.robot.schema import parameter, ParameterError, ParameterFile


@dataclass(frozen=True, kw_only=True)
class PlantParameters:
    """Time steps, floor contact and dimensions."""

    tick: float = parameter(doc='duration of one simulator step', unit='s', low=0.0005, high=0.05)
    substeps: int = parameter(doc='integration steps in one tick', low=1, high=100)
    floor_substeps: int = parameter(doc='integration steps in one tick during floor contact',
                                    low=1, high=100)
    floor_friction: float = parameter(doc='sliding friction with the floor', low=0, high=5)
    contact_time_constant: float = parameter(
        doc='time constant of the contact with the floor', unit='s', low=0.002, high=0.2)
    contact_damping_ratio: float = parameter(
        doc='damping ratio of the contact; 1 does not bounce', low=0.05, high=5)
    foot_spread: float = parameter(doc='|x| = |y| of a foot', unit='m', low=0.01, high=5)
    foot_depth: float = parameter(doc='depth of the sole of a foot below base_link', unit='m',
                                  low=0.01, high=5)
    foot_radius: float = parameter(doc='radius of the ball at the end of a leg', unit='m',
                                   low=1e-3, high=0.5)
    propeller_radius: float = parameter(doc='radius of the contact disc of a propeller', unit='m',
                                        low=0.005, high=2)
    end_effector_radius: float = parameter(doc='radius of the end-effector ball', unit='m',
                                           low=0.001, high=1)
    payload_depth: float = parameter(doc='depth of the centre of a payload below base_link',
                                     unit='m', low=0, high=5)
    payload_density: float = parameter(doc='density of a payload, a ball', unit='kg/m^3', low=10,
                                       high=30000)
    jam_stiffness: float = parameter(doc='stiffness of a jammed joint relative to its servo',
                                     low=1, high=100)


@dataclass(frozen=True, kw_only=True)
class CrashParameters:
    """Limits of a contact with the floor beyond which the robot breaks."""

    speed: float = parameter(doc='largest speed at a contact that the robot survives', unit='m/s',
                             low=0.01, high=100)
    inclination: float = parameter(doc='largest inclination in a contact that the robot survives',
                                   unit='rad', low=0, high=4)
    airborne_time: float = parameter(doc='time without contact after which a contact is a '
                                     'touchdown', unit='s', low=0, high=10)


@dataclass(frozen=True, kw_only=True)
class RotorSpeedParameters:
    """Telemetry of the speed controllers."""

    rpm_at_1_newton: float = parameter(doc='speed of a rotor at 1 N; grows with the root of '
                                       'thrust', unit='1/min', low=1, high=1e5)
    period: float = parameter(doc='time between two readings', unit='s', low=0.005, high=10)
    latency: float = parameter(doc='time from capture to arrival', unit='s', low=0, high=1)
    noise: float = parameter(doc='standard deviation relative to the speed', low=0, high=1)


@dataclass(frozen=True, kw_only=True)
class ActuatorTimingParameters:
    """Timing of the commands to the actuators."""

    command_delay: float = parameter(doc='time from the stamp of a command until it acts',
                                     unit='s', low=0, high=0.5)
    command_timeout: float = parameter(doc='time without a command after which the rotors stop',
                                       unit='s', low=0.01, high=10)
    command_future_limit: float = parameter(
        doc='largest lead of a stamp over the clock', unit='s', low=0, high=10)


@dataclass(frozen=True, kw_only=True)
class PackParameters:
    """Charge of the battery; voltage and resistance are in the robot file."""

    capacity: float = parameter(doc='charge of a full battery', unit='Ah', low=0.01, high=1000)
    initial_charge: float = parameter(doc='charge at reset as a fraction of a full battery', low=0,
                                      high=1)
    charge_levels: np.ndarray = parameter(doc='charges of the discharge curve, rising from 0 to '
                                          '1', low=0, high=1)
    relative_voltages: np.ndarray = parameter(
        doc='open-circuit voltages at these charges, relative to a full battery', low=0, high=1)
    rotor_power: float = parameter(doc='electrical power of a rotor divided by thrust^1.5',
                                   unit='W/N^1.5', low=0, high=1000)
    idle_power: float = parameter(doc='power of computer, servos and radio', unit='W', low=0,
                                  high=10000)
    period: float = parameter(doc='time between two readings', unit='s', low=0.005, high=10)
    voltage_noise: float = parameter(doc='standard deviation', unit='V', low=0, high=2)
    current_noise: float = parameter(doc='standard deviation', unit='A', low=0, high=50)

    def __post_init__(self):
        """Check the discharge curve."""
        levels, voltages = self.charge_levels, self.relative_voltages
        if len(levels) != len(voltages) or len(levels) < 2:
            raise ParameterError('charge_levels and relative_voltages must be equally long, two '
                                 f'or more; found {len(levels)} and {len(voltages)}')
        if np.any(np.diff(levels) <= 0) or np.any(np.diff(voltages) < 0) \
                or levels[0] != 0 or levels[-1] != 1 or voltages[-1] != 1:
            raise ParameterError('charge_levels must rise from 0 to 1 and relative_voltages must '
                                 f'not fall and end at 1; found {levels} and {voltages}')


@dataclass(frozen=True, kw_only=True)
class ImuParameters:
    """IMU at base_link with one reading in each tick."""

    specific_force_noise: float = parameter(doc='standard deviation of an axis', unit='m/s^2',
                                            low=0, high=10)
    angular_velocity_noise: float = parameter(doc='standard deviation of an axis', unit='rad/s',
                                              low=0, high=10)


@dataclass(frozen=True, kw_only=True)
class MocapParameters:
    """Motion capture of base_link."""

    period: float = parameter(doc='time between two frames', unit='s', low=0.001, high=1)
    latency: float = parameter(doc='time from capture to arrival', unit='s', low=0, high=1)
    position_noise: float = parameter(doc='standard deviation of an axis', unit='m', low=0, high=1)
    orientation_noise: float = parameter(doc='standard deviation about an axis', unit='rad', low=0,
                                         high=1)


@dataclass(frozen=True, kw_only=True)
class EncoderParameters:
    """Joint feedback with one reading in each tick."""

    latency: float = parameter(doc='time from capture to arrival', unit='s', low=0, high=1)
    counts_per_turn: int = parameter(doc='position resolution', low=16, high=1 << 24)
    velocity_step: float = parameter(doc='velocity resolution', unit='rad/s', low=0, high=1)


def _latency(what):
    return parameter(doc=f'smallest and largest latency of {what}, in latency_unit', shape=(2,),
                     low=0, high=100)


@dataclass(frozen=True, kw_only=True)
class PublishedParameters:
    """The published randomisation table: half-widths of uniform distributions."""

    mass_scale: float = parameter(doc='factor of the mass, about 1', low=0, high=0.9)
    inertia_scale: float = parameter(doc='factors of the inertia, about 1, each axis', low=0,
                                     high=0.5)
    centre_of_mass: float = parameter(doc='offset of the centre of mass, each axis', unit='m',
                                      low=0, high=0.5)
    position_bias: float = parameter(doc='bias of the MoCap position, each axis', unit='m', low=0,
                                     high=1)
    position_noise: float = parameter(doc='noise of the MoCap position, each axis', unit='m',
                                      low=0, high=1)
    orientation_bias: float = parameter(doc='bias of the MoCap orientation, each axis', unit='rad',
                                        low=0, high=1)
    orientation_noise: float = parameter(doc='noise of the MoCap orientation, each axis',
                                         unit='rad', low=0, high=1)
    velocity_bias: float = parameter(doc='bias of the velocity estimate', unit='m/s', low=0,
                                     high=1)
    velocity_noise: float = parameter(doc='noise of the velocity estimate', unit='m/s', low=0,
                                      high=1)
    velocity_correction_time: float = parameter(
        doc='time that divides both to give accelerometer bias and noise', unit='s', low=0.01,
        high=10)
    angular_velocity_bias: float = parameter(doc='bias of the gyroscope, each axis', unit='rad/s',
                                             low=0, high=1)
    angular_velocity_noise: float = parameter(doc='noise of the gyroscope, each axis',
                                              unit='rad/s', low=0, high=1)
    tilt_bias: float = parameter(doc='bias of each encoder', unit='rad', low=0, high=1)
    tilt_noise: float = parameter(doc='noise of each encoder', unit='rad', low=0, high=1)
    latency_unit: float = parameter(doc='time step of the table', unit='s', low=0.001, high=0.1)
    imu_latency: np.ndarray = _latency('the IMU')
    tilt_latency: np.ndarray = _latency('joint feedback')
    tilt_command_latency: np.ndarray = _latency('tilt commands')
    thrust_command_latency: np.ndarray = _latency('thrust commands')


@dataclass(frozen=True, kw_only=True)
class SimulatorParameters(ParameterFile, file='simulator.yaml'):
    """Content of params/simulator.yaml."""

    plant: PlantParameters = parameter(doc='time steps, floor and dimensions')
    actuators: ActuatorTimingParameters = parameter(doc='timing of commands')
    battery: PackParameters = parameter(doc='battery')
    imu: ImuParameters = parameter(doc='IMU')
    mocap: MocapParameters = parameter(doc='motion capture')
    encoders: EncoderParameters = parameter(doc='joint feedback')
    rotor_speed: RotorSpeedParameters = parameter(doc='rotor speed telemetry')
    crash: CrashParameters = parameter(doc='limits of the robot at contacts')
    published: PublishedParameters = parameter(doc='randomisation of --conditions published')


def _zeros(size):
    return field(default_factory=lambda: np.zeros(size))


@dataclass(frozen=True, kw_only=True)
class Conditions:
    """Constants of one flight."""

    variation: Variation = field(default_factory=Variation)     # of the body from the robot file
    position_bias: np.ndarray = _zeros(3)           # of the MoCap [m]
    orientation_bias: np.ndarray = _zeros(3)        # of the MoCap, a rotation vector [rad]
    imu_bias: np.ndarray = _zeros(6)                # specific force [m/s^2], rate [rad/s]
    tilt_bias: np.ndarray = _zeros(4)               # encoder reading minus true tilt [rad]
    # Half-widths of uniform noise, in the units of the biases.
    imu_uniform_noise: np.ndarray = _zeros(6)
    mocap_uniform_noise: np.ndarray = _zeros(6)
    tilt_uniform_noise: float = 0.0
    imu_latency: float = 0.0                        # that its stamps do not contain [s]
    tilt_latency: float                             # age of joint feedback [s]
    tilt_command_delay: float                       # from a command's stamp until it acts [s]
    thrust_command_delay: float                     # [s]

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
        raise ParameterError(f"conditions: '{name}' is unknown; expected one of nominal, "
                             'published')
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
