"""What describes the simulated world; read from params/simulator.yaml."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from beetle_omni_ros.robot import schema
from beetle_omni_ros.robot.resources import share_path
from beetle_omni_ros.robot.schema import parameter, ParameterError


@dataclass(frozen=True, kw_only=True)
class PlantParameters:
    """Time steps and the ground."""

    tick: float = parameter(doc='time of one simulator step', unit='s', low=0.0005, high=0.05)
    substeps: int = parameter(doc='integration steps in one tick', low=1, high=100)
    floor_substeps: int = parameter(doc='the same while touching the floor', low=1, high=100)
    floor_friction: float = parameter(doc='sliding friction with the floor', low=0, high=5)
    contact_time_constant: float = parameter(
        doc='time in which a penetration is pushed out', unit='s', low=0.002, high=0.2)
    contact_damping_ratio: float = parameter(doc='1 does not bounce', low=0.05, high=5)
    foot_spread: float = parameter(doc='|x| = |y| of a foot', unit='m', low=0.01, high=5)
    foot_depth: float = parameter(doc='sole of a foot below base_link', unit='m', low=0.01, high=5)
    foot_radius: float = parameter(doc='of the ball at the end of a leg', unit='m', low=1e-3,
                                   high=0.5)
    propeller_radius: float = parameter(doc='of the disc that can touch', unit='m', low=0.005,
                                        high=2)
    end_effector_radius: float = parameter(doc='of the ball', unit='m', low=0.001, high=1)
    payload_depth: float = parameter(doc='centre of an attached payload below base_link',
                                     unit='m', low=0, high=5)
    payload_density: float = parameter(doc='of a payload, taken as a ball', unit='kg/m^3', low=10,
                                       high=30000)
    jam_stiffness: float = parameter(doc='of a jammed joint, relative to its servo', low=1,
                                     high=100)


@dataclass(frozen=True, kw_only=True)
class CrashParameters:
    """What a contact with the floor breaks."""

    speed: float = parameter(doc='faster at a contact, the robot breaks', unit='m/s', low=0.01,
                             high=100)
    inclination: float = parameter(doc='more inclined in a contact, it breaks', unit='rad', low=0,
                                   high=4)
    airborne_time: float = parameter(doc='without contact, after which a contact is a touchdown',
                                     unit='s', low=0, high=10)


@dataclass(frozen=True, kw_only=True)
class RotorSpeedParameters:
    """The speed controllers' telemetry."""

    rpm_at_1_newton: float = parameter(doc='of a rotor; grows with the root of thrust',
                                       unit='1/min', low=1, high=1e5)
    period: float = parameter(doc='between two readings', unit='s', low=0.005, high=10)
    latency: float = parameter(doc='from capture to arrival', unit='s', low=0, high=1)
    noise: float = parameter(doc='standard deviation relative to the speed', low=0, high=1)


@dataclass(frozen=True, kw_only=True)
class ActuatorTimingParameters:
    """How commands reach the actuators."""

    command_delay: float = parameter(doc="from a command's stamp until it acts", unit='s', low=0,
                                     high=0.5)
    command_timeout: float = parameter(doc='silence after which the rotors stop', unit='s',
                                       low=0.01, high=10)
    command_future_limit: float = parameter(
        doc='a stamp further ahead of the clock is refused', unit='s', low=0, high=10)


@dataclass(frozen=True, kw_only=True)
class PackParameters:
    """The battery's charge, beside its voltage and resistance in the robot file."""

    capacity: float = parameter(doc='charge of a full pack', unit='Ah', low=0.01, high=1000)
    initial_charge: float = parameter(doc='fraction at reset', low=0, high=1)
    charge_levels: np.ndarray = parameter(doc='fractions of charge, rising from 0 to 1', low=0,
                                          high=1)
    relative_voltages: np.ndarray = parameter(
        doc='open-circuit voltage there, relative to a full pack', low=0, high=1)
    rotor_power: float = parameter(doc='electrical power of a rotor is this times thrust^1.5',
                                   unit='W/N^1.5', low=0, high=1000)
    idle_power: float = parameter(doc='computer, servos, radio', unit='W', low=0, high=10000)
    period: float = parameter(doc='between two readings', unit='s', low=0.005, high=10)
    voltage_noise: float = parameter(doc='standard deviation', unit='V', low=0, high=2)
    current_noise: float = parameter(doc='standard deviation', unit='A', low=0, high=50)

    def __post_init__(self):
        """Refuse a discharge curve that is no curve."""
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
    """IMU at base_link, one reading a tick, stamped there."""

    specific_force_noise: float = parameter(doc='standard deviation of an axis', unit='m/s^2',
                                            low=0, high=10)
    angular_velocity_noise: float = parameter(doc='standard deviation of an axis', unit='rad/s',
                                              low=0, high=10)


@dataclass(frozen=True, kw_only=True)
class MocapParameters:
    """Motion capture of base_link."""

    period: float = parameter(doc='between two frames', unit='s', low=0.001, high=1)
    latency: float = parameter(doc='from capture to arrival', unit='s', low=0, high=1)
    position_noise: float = parameter(doc='standard deviation of an axis', unit='m', low=0, high=1)
    orientation_noise: float = parameter(doc='standard deviation about an axis', unit='rad', low=0,
                                         high=1)


@dataclass(frozen=True, kw_only=True)
class EncoderParameters:
    """Joint feedback, one reading a tick."""

    latency: float = parameter(doc='from capture to arrival', unit='s', low=0, high=1)
    counts_per_turn: int = parameter(doc='position resolution', low=16, high=1 << 24)
    velocity_step: float = parameter(doc='velocity resolution', unit='rad/s', low=0, high=1)


@dataclass(frozen=True, kw_only=True)
class PublishedParameters:
    """The published randomisation table; half-widths of uniform ranges, drawn from the seed."""

    mass_scale: float = parameter(doc='about 1', low=0, high=0.9)
    inertia_scale: float = parameter(doc='about 1, each axis', low=0, high=0.5)
    centre_of_mass: float = parameter(doc='each axis', unit='m', low=0, high=0.5)
    position_bias: float = parameter(doc='MoCap, each axis', unit='m', low=0, high=1)
    position_noise: float = parameter(doc='MoCap, each axis and frame', unit='m', low=0, high=1)
    orientation_bias: float = parameter(doc='MoCap, about each axis', unit='rad', low=0, high=1)
    orientation_noise: float = parameter(doc='MoCap, about each axis, each frame', unit='rad',
                                         low=0, high=1)
    velocity_bias: float = parameter(doc='of the velocity estimate', unit='m/s', low=0, high=1)
    velocity_noise: float = parameter(doc='of the velocity estimate', unit='m/s', low=0, high=1)
    velocity_correction_time: float = parameter(
        doc='turns both into accelerometer bias and noise', unit='s', low=0.01, high=10)
    angular_velocity_bias: float = parameter(doc='gyroscope, each axis', unit='rad/s', low=0,
                                             high=1)
    angular_velocity_noise: float = parameter(doc='gyroscope, each axis and reading', unit='rad/s',
                                              low=0, high=1)
    tilt_bias: float = parameter(doc='each encoder', unit='rad', low=0, high=1)
    tilt_noise: float = parameter(doc='each encoder and reading', unit='rad', low=0, high=1)
    latency_unit: float = parameter(doc="the table's dt", unit='s', low=0.001, high=0.1)
    imu_latency: np.ndarray = parameter(doc='from, to, in latency_unit', shape=(2,), low=0,
                                        high=100)
    tilt_latency: np.ndarray = parameter(doc='from, to, in latency_unit', shape=(2,), low=0,
                                         high=100)
    tilt_command_latency: np.ndarray = parameter(doc='from, to, in latency_unit', shape=(2,),
                                                 low=0, high=100)
    thrust_command_latency: np.ndarray = parameter(doc='from, to, in latency_unit', shape=(2,),
                                                   low=0, high=100)


@dataclass(frozen=True, kw_only=True)
class SimulatorParameters:
    """Everything in params/simulator.yaml."""

    plant: PlantParameters = parameter(doc='time steps and ground')
    actuators: ActuatorTimingParameters = parameter(doc='timing of commands')
    battery: PackParameters = parameter(doc='charge')
    imu: ImuParameters = parameter(doc='IMU')
    mocap: MocapParameters = parameter(doc='motion capture')
    encoders: EncoderParameters = parameter(doc='joint feedback')
    rotor_speed: RotorSpeedParameters = parameter(doc='rotor speed telemetry')
    crash: CrashParameters = parameter(doc='what breaks the robot')
    published: PublishedParameters = parameter(doc='what --conditions published adds')

    @classmethod
    def load(cls, path: str | Path | None = None) -> SimulatorParameters:
        """
        Read a simulator file; without a path, the shipped one.

        Raises:
            ParameterError: naming file, key and what was expected.

        """
        return schema.load(cls, path if path else share_path('params/simulator.yaml'))
