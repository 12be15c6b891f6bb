"""Entries of the catalogue of effects, and the terms of the model that their equations change."""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np

NAN = float('nan')


@dataclass
class Terms:
    """
    Terms of the body's equations at one instant, as CasADi expressions; effects change them.

    Vectors are in base_link, unless stated otherwise. Lists have an entry for each rotor.
    """

    mass: ca.SX                     # [kg]
    inertia: ca.SX                  # (3,) diagonal about the centre of mass [kg m^2]
    centre_of_mass: ca.SX           # (3,) [m]
    torque: ca.SX                   # (3,) added on the body [N m]
    tilt: ca.SX                     # (4,) [rad]
    tilt_acceleration: ca.SX        # (4,) [rad/s^2]
    tilt_axes: list                 # of (3,) unit vectors, outward along the arms
    thrust: ca.SX                   # (4,) after the rotors' lag [N]
    velocity: ca.SX                 # (3,) of the centre of gravity in world [m/s]
    angular_velocity: ca.SX         # (3,) [rad/s]
    rotation: ca.SX                 # (3, 3) body to world
    thrust_directions: list         # of (3,) unit vectors
    rotor_positions: list           # of (3,) [m]
    hover_thrust: float             # of each rotor [N]
    force_world: ca.SX              # (3,) added, in world [N]
    rotor_forces: list              # of (3,) added at the rotors [N]
    torque_ratio: ca.SX             # reaction torque for each newton [m]
    tilt_rate: ca.SX                # (4,) [rad/s]
    thrust_rate: ca.SX              # (4,) [N/s]
    spin: tuple[float, ...]         # (4,) +1 along the thrust
    position: ca.SX | None = None       # (3,) of base_link in world [m]; None: unknown
    voltage_ratio: ca.SX | None = None  # of the pack over that of a full pack; None: unknown
    state: ca.SX | None = None      # (4,) of the effect's rate, at the rotors; None: unknown

    def rotor_speeds(self) -> list:
        """Rotor speeds relative to hover, computed from thrust; list of four scalars."""
        return [ca.sqrt(ca.fmax(self.thrust[i], 0) / self.hover_thrust + 1e-9) for i in range(4)]

    def hub_velocities(self) -> list:
        """List of four (3,) velocities of the rotor hubs through still air in base_link [m/s]."""
        body = self.rotation.T @ self.velocity
        return [body + ca.cross(self.angular_velocity, r) for r in self.rotor_positions]

    def in_plane_velocities(self) -> list:
        """Parts of :meth:`hub_velocities` in the planes of the rotors."""
        return [v - n * ca.dot(n, v) for n, v in zip(
            self.thrust_directions, self.hub_velocities(), strict=True)]


@dataclass
class ServoTerms:
    """Terms that act on one tilt servo at one instant, numbers of any namespace."""

    target: Any             # commanded angle [rad]
    thrust: Any = 0.0       # of the joint's rotor [N]
    load: Any = 0.0         # torque beside the motor's [N m]
    coulomb: Any = None     # sliding friction [N m]
    stiction: Any = None    # friction at rest [N m]


@dataclass(frozen=True)
class EffectParameter:
    """One number, or vector, of an effect; SI units."""

    unit: str
    # without effect; NaN: the robot file's own number; of text: an example
    neutral: float | tuple[float, ...] | tuple[str, ...]
    low: float                              # smallest and largest legal value
    high: float
    default: float | tuple[float, ...] | None = None    # if a file omits it; None: it is required
    of_each: bool = False   # a file may give a list of four, one for each joint
    number: str = ''        # dotted key of the robot file's number that it replaces
    sensor: str = ''        # field of SensorErrors that it sets
    form: bool = False      # it only chooses a form of the effect and is not fitted
    text: bool = False      # it is a list of expressions, see :mod:`model.formula`


@dataclass(frozen=True)
class SensorErrors:
    """Errors of the robot's sensors by the effects of the robot file."""

    accelerometer_bias: tuple[float, ...] = (0.0,) * 3  # measured minus true [m/s^2]
    gyroscope_bias: tuple[float, ...] = (0.0,) * 3      # measured minus true [rad/s]
    imu_rotation: tuple[float, ...] = (0.0,) * 3        # vector from base_link to its axes [rad]
    imu_position: tuple[float, ...] = (0.0,) * 3        # in base_link [m]
    mocap_rotation: tuple[float, ...] = (0.0,) * 3      # from base_link to the markers' axes [rad]
    imu_delay: float = 0.0          # age of readings at their stamps [s]
    mocap_delay: float = 0.0
    encoder_delay: float = 0.0
    encoder_gain: tuple[float, ...] = (0.0,) * 4        # error per angle [1]
    encoder_sine: tuple[float, ...] = (0.0,) * 4        # by the sine of the angle [rad]
    encoder_cosine: tuple[float, ...] = (0.0,) * 4      # by its cosine minus 1 [rad]

    @cached_property
    def encoders_err(self) -> bool:
        """Whether the encoders' readings depend on the angle."""
        return any((*self.encoder_gain, *self.encoder_sine, *self.encoder_cosine))

    def encoders(self, tilt: np.ndarray) -> np.ndarray:
        """Readings [rad] of the encoders at tilts (..., 4) [rad]."""
        return tilt + tilt * self.encoder_gain + np.sin(tilt) * self.encoder_sine \
            + (np.cos(tilt) - 1) * self.encoder_cosine

    def tilts(self, readings: np.ndarray) -> np.ndarray:
        """Tilts (..., 4) [rad] at readings of the encoders, by three fixed-point steps."""
        tilt = readings
        for _ in range(3):
            tilt = tilt + readings - self.encoders(tilt)
        return tilt


@dataclass(frozen=True)
class Effect:
    """One catalogue entry."""

    layer: str      # 'body', 'rotor', 'joint', 'timing' or 'sensor'
    parameters: dict[str, EffectParameter]
    source: str     # equation and its source
    # Equation of a body effect, which changes Terms in place: apply(terms, **values).
    apply: Callable | None = None
    # Equation of a joint effect, which changes ServoTerms: servo(terms, joint, **values).
    servo: Callable | None = None
    # Rate [1/s] of a state of each rotor that is zero at the begin of a flight, such as a
    # temperature: rate(state (4,), thrust over hover thrust (4,), **values), of NumPy arrays.
    rate: Callable | None = None
    each: str = ''      # 'rotor' or 'joint' if parameters are (4,), 'term': one each expression
    # Delayed quantities: 'tilt' and 'thrust' commands, readings of 'imu', 'mocap', 'encoders'.
    delays: tuple[str, ...] = ()
    allocated: bool = False     # the allocation includes it
    beside: tuple[str, ...] = ()    # it acts by another effect, one of these
    measured: tuple[str, ...] = ()  # terms of MEASURED; where one is None, it is left out
    # Name of CONSUMERS -> why it ignores the effect, where this does not follow from its kind.
    ignored_by: dict[str, str] = field(default_factory=dict)

    @property
    def settings(self) -> dict[str, str]:
        """Parameter -> dotted key of the robot file's number that it replaces."""
        return {} if self.apply else {name: spec.number for name, spec in self.parameters.items()
                                      if spec.number}

    def in_readings(self, parameter: str) -> bool:
        """Whether a parameter affects sensor readings only, not the model's equations."""
        return bool(self.parameters[parameter].sensor) or self.kind == 'play'

    def advanced(self, values: dict, state: np.ndarray, thrust: np.ndarray, step: float
                 ) -> np.ndarray:
        """
        States (4,) of the rotors a ``step`` [s] later, by Euler's method.

        ``values`` are the parameters, of which those within their bounds are used, ``thrust`` (4,)
        is that over hover thrust.
        """
        assert self.rate is not None
        return state + step * self.rate(state, thrust, **{
            key: np.clip(value, self.parameters[key].low, self.parameters[key].high)
            for key, value in values.items()})

    @property
    def kind(self) -> str:
        """
        How it acts.

        'body' or 'servo': by its equation. 'number': replaces one of the robot file. 'command':
        delays commands. 'sensor': in readings of IMU and MoCap. 'feedback': in readings of the
        encoders. 'play': between encoder and rotor.
        """
        if self.apply or self.servo:
            return 'body' if self.apply else 'servo'
        if self.settings:
            return 'number'
        if any(spec.sensor for spec in self.parameters.values()):
            return 'feedback' if 'encoders' in self.delays else 'sensor'
        return 'command' if self.delays else 'play'

    @property
    def numbers(self) -> list[str]:
        """Names of the fitted parameters."""
        return [name for name, spec in self.parameters.items() if not spec.form]
