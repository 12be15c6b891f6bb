"""Types of which the catalogue of effects consists."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import casadi as ca
import numpy as np

LAYERS = ('body', 'rotor', 'joint', 'timing', 'sensor')
# Terms that the simulated plant and the gap finder have -> why NMPC and training leave out an
# effect of them.
MEASURED = {'voltage_ratio': 'it has no voltage and assumes a full pack',
            'charge_drawn': 'it has no current of the pack and assumes that no charge was drawn'}


@dataclass(frozen=True)
class EffectParameter:
    """
    One number, or vector, of an effect.

    Attributes:
        unit: SI.
        neutral: value without effect; NaN if that is the robot file's own number.
        low: smallest legal value.
        high: largest legal value.
        typical: realistic deviation from neutral; a fraction if neutral is NaN.
        smallest: smallest significant deviation; a fraction if neutral is NaN.
        default: value if a file omits it; None: it is required.
        of_each: whether a file may give a list of four, one for each joint.
        number: dotted key of the robot file's number that it replaces.
        sensor: field of :class:`SensorErrors` that it sets.
        tolerance: kind of tolerance between robots of one type, a number ``tolerance_...`` of
            params/gap.yaml.
        least: smallest ratio to the robot file's own number in a fit.
        step: step of a fit's derivatives; of the logarithm for the file's own numbers.
        curved: whether these derivatives change during a fit.
        form: whether it only chooses a form of the effect and is not fitted.

    """

    unit: str
    neutral: float | tuple[float, ...]
    low: float
    high: float
    typical: float = float('nan')
    smallest: float = float('nan')
    default: float | tuple[float, ...] | None = None
    of_each: bool = False
    number: str = ''
    sensor: str = ''
    tolerance: str = ''
    least: float = 0.02
    step: float = 1e-3
    curved: bool = False
    form: bool = False


@dataclass(frozen=True)
class LimitStarts:
    """
    Start values of a fitted limit, relative to the demand of a flight.

    Attributes:
        of: 'tilt_rate', 'torque' or 'thrust'.
        parts: fractions of the largest demand, one start each.
        below: fraction of the file's limit below which a start must lie.

    """

    of: str
    parts: tuple[float, ...]
    below: float


@dataclass(frozen=True)
class SensorErrors:
    """
    Errors of the robot's sensors by the effects of the robot file.

    Attributes:
        accelerometer_bias: (3,) measured minus true [m/s^2].
        gyroscope_bias: (3,) measured minus true [rad/s].
        imu_rotation: (3,) rotation vector from base_link to the IMU's axes [rad].
        imu_position: (3,) position of the IMU in base_link [m].
        mocap_rotation: (3,) rotation vector from base_link to the markers' axes [rad].
        imu_delay: age of readings at their stamps [s].
        mocap_delay: age of poses at their stamps [s].
        encoder_delay: age of readings at their stamps [s].
        encoder_gain: (4,) error of the readings per angle [1].
        encoder_sine: (4,) error by the sine of the angle [rad].
        encoder_cosine: (4,) error by the cosine of the angle minus 1 [rad].

    """

    accelerometer_bias: tuple[float, ...] = (0.0,) * 3
    gyroscope_bias: tuple[float, ...] = (0.0,) * 3
    imu_rotation: tuple[float, ...] = (0.0,) * 3
    imu_position: tuple[float, ...] = (0.0,) * 3
    mocap_rotation: tuple[float, ...] = (0.0,) * 3
    imu_delay: float = 0.0
    mocap_delay: float = 0.0
    encoder_delay: float = 0.0
    encoder_gain: tuple[float, ...] = (0.0,) * 4
    encoder_sine: tuple[float, ...] = (0.0,) * 4
    encoder_cosine: tuple[float, ...] = (0.0,) * 4

    @property
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


@dataclass
class Terms:
    """
    Terms of the body's equations at one instant, as CasADi expressions; effects change them.

    Attributes:
        mass: [kg].
        inertia: (3,) diagonal about the centre of mass [kg m^2].
        centre_of_mass: (3,) in base_link [m], or None for its origin.
        torque: (3,) added torque on the body, in base_link [N m].
        tilt: (4,) tilt angles [rad].
        tilt_acceleration: (4,) [rad/s^2].
        tilt_axes: list of four (3,) unit vectors in base_link, outward along the arms.
        thrust: (4,) rotor thrusts after their lag [N].
        velocity: (3,) of the centre of gravity in world [m/s].
        angular_velocity: (3,) in base_link [rad/s].
        rotation: (3, 3) body to world.
        thrust_directions: list of four (3,) unit vectors in base_link.
        rotor_positions: list of four (3,) in base_link [m].
        hover_thrust: thrust of each rotor in hover [N].
        force_world: (3,) added force in world [N].
        rotor_forces: list of four (3,) added forces at the rotors, in base_link [N].
        torque_ratio: reaction torque for each newton [m].
        tilt_rate: (4,) [rad/s].
        thrust_rate: (4,) [N/s].
        spin: (4,) direction of rotation, +1 along the thrust.
        position: (3,) of base_link in world [m], or None if unknown.
        voltage_ratio: pack voltage over that of a full pack, or None if unknown.
        charge_drawn: charge drawn from the pack [A h], or None if unknown; in the simulator
            since the pack was inserted, in a recording since its first battery message.

    """

    mass: ca.SX
    inertia: ca.SX
    centre_of_mass: ca.SX | None
    torque: ca.SX
    tilt: ca.SX
    tilt_acceleration: ca.SX
    tilt_axes: list
    thrust: ca.SX
    velocity: ca.SX
    angular_velocity: ca.SX
    rotation: ca.SX
    thrust_directions: list
    rotor_positions: list
    hover_thrust: float
    force_world: ca.SX
    rotor_forces: list
    torque_ratio: ca.SX
    tilt_rate: ca.SX
    thrust_rate: ca.SX
    spin: tuple[float, ...]
    position: ca.SX | None = None
    voltage_ratio: ca.SX | None = None
    charge_drawn: ca.SX | None = None

    def rotor_speeds(self) -> list:
        """Rotor speeds relative to hover, computed from thrust; list of four scalars."""
        return [ca.sqrt(ca.fmax(self.thrust[i], 0) / self.hover_thrust + 1e-9) for i in range(4)]

    def hub_velocities(self) -> list:
        """List of four (3,) velocities of the rotor hubs through still air in base_link [m/s]."""
        body = self.rotation.T @ self.velocity
        return [body + ca.cross(self.angular_velocity, r) for r in self.rotor_positions]


@dataclass
class ServoTerms:
    """
    Terms that act on one tilt servo at one instant, numbers of any namespace.

    Attributes:
        target: commanded angle [rad].
        thrust: thrust of the joint's rotor [N].
        gyroscopic: load on the joint for each N m s of the rotor's angular momentum in hover
            [rad/s]; 0 if the body's rate is unknown.
        load: torque beside the motor's [N m].
        coulomb: sliding friction [N m], or None.
        stiction: friction at rest [N m], or None.

    """

    target: Any
    thrust: Any = 0.0
    gyroscopic: Any = 0.0
    load: Any = 0.0
    coulomb: Any = None
    stiction: Any = None


@dataclass(frozen=True)
class Treatment:
    """
    How a consumer treats an effect.

    Attributes:
        acts: whether a change of its parameters changes the consumer's results.
        reason: reason why it does not act.

    """

    acts: bool
    reason: str = ''


@dataclass(frozen=True)
class Effect:
    """
    One catalogue entry.

    Attributes:
        layer: 'body', 'rotor', 'joint', 'timing' or 'sensor'.
        parameters: name -> :class:`EffectParameter`.
        source: equation and its source.
        excited_by: flight that excites it.
        confused_with: names of entries that poor data cannot distinguish from it.
        separated_by: experiment that distinguishes them.
        apply: equation of a body effect; changes :class:`Terms` in place, called as
            apply(terms, **values).
        servo: equation of a joint effect; changes :class:`ServoTerms` in place, called as
            servo(terms, joint, **values).
        each: 'rotor' or 'joint' if the parameters are (4,), one for each.
        delays: delayed quantities, 'tilt' and 'thrust' commands or readings of 'imu', 'mocap' and
            'encoders'.
        own_clock: whether these readings are stamped by another clock and may appear early.
        channels: measurements that it affects. B: forces and torques, J: joints, A: MoCap's
            acceleration, W: MoCap's angular velocity; A and W against the IMU.
        starts: start values of a fit, if the effect has no slope at its neutral value.
        forms: for each form of the effect, the parameters that choose it.
        one_regime: whether it acts in one regime only, such as near the ground.
        same_response: entry that is another form of the same response.
        allocated: whether the allocation includes it.
        measured: terms that not every consumer has, of ``MEASURED``. Where one is None, the
            effect is left out.
        plant: how the simulated plant includes a body effect. 'model': numbers of its bodies and
            rotors, 'own': equations of its own, else the equation of this entry.
        treatments: 'nmpc', 'training', 'plant', 'estimator', 'buses' or 'gap' -> its
            :class:`Treatment`, if that does not follow from the kind of effect.

    """

    layer: str
    parameters: dict[str, EffectParameter]
    source: str
    excited_by: str = ''
    confused_with: tuple[str, ...] = ()
    separated_by: str = ''
    apply: Callable | None = None
    servo: Callable | None = None
    each: str = ''
    delays: tuple[str, ...] = ()
    own_clock: bool = False
    channels: str = 'B'
    starts: tuple[tuple[float, ...], ...] | LimitStarts = ()
    forms: tuple[dict[str, float], ...] = ({},)
    one_regime: bool = False
    same_response: str = ''
    allocated: bool = False
    measured: tuple[str, ...] = ()
    plant: str = ''
    treatments: dict[str, Treatment] = field(default_factory=dict)

    @property
    def settings(self) -> dict[str, str]:
        """Parameter -> dotted key of the robot file's number that it replaces."""
        return {} if self.apply else {name: spec.number for name, spec in self.parameters.items()
                                      if spec.number}

    def in_readings(self, parameter: str) -> bool:
        """Whether a parameter affects sensor readings only, not the model's equations."""
        return bool(self.parameters[parameter].sensor) or self.kind == 'play'

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


def vector(values):
    """(n,) column of a tuple of numbers or symbols; any other value unchanged."""
    return ca.vertcat(*ca.vertsplit(ca.SX(ca.vertcat(*values)))) if isinstance(values, tuple) \
        else values
