"""What a catalogue entry is made of."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import casadi as ca

LAYERS = ('body', 'rotor', 'joint', 'timing', 'sensor')


@dataclass(frozen=True)
class LogNumber:
    """
    A parameter as a fit of a servo's response log has it.

    Attributes:
        scale: a change that matters; of the logarithm where ``logarithmic``.
        low: smallest value; of friction as a dead band [rad].
        high: largest value.
        logarithmic: whether the logarithm is fitted.
        each: whether each joint has its own.
        better: name and unit of a number that a log determines better, or nothing.

    """

    scale: float
    low: float
    high: float
    logarithmic: bool = False
    each: bool = False
    better: tuple[tuple[str, str], ...] = ()


@dataclass(frozen=True)
class EffectParameter:
    """
    One number, or vector, of an effect.

    Attributes:
        unit: SI.
        neutral: value of no effect; NaN where that is the robot file's own number.
        low: smallest legal value.
        high: largest legal value.
        typical: realistic deviation from neutral; a fraction where neutral is NaN.
        smallest: deviation below which nobody would act on it; likewise.
        default: value where a file leaves it out; None: it must be there.
        of_each: whether a file may have a list of four in place of the number, one for each joint.
        number: dotted key of the robot file's own number that it stands for.
        sensor: number of a sensor that it stands for, as in :class:`SensorErrors`.
        tolerance: kind of tolerance by which robots of one type differ in it, a number
            ``tolerance_...`` of params/gap.yaml.
        least: smallest ratio to the robot file's own number that a fit may reach.
        step: change by which a fit takes derivatives; of the logarithm for the file's own numbers.
        curved: whether those derivatives change along a fit.
        form: whether it only chooses between forms of the effect and is not fitted.
        log: how a servo's response log shows it, or None.

    """

    unit: str
    neutral: float | tuple[float, ...]
    low: float
    high: float
    typical: float = float('nan')
    smallest: float = float('nan')
    default: float | None = None
    of_each: bool = False
    number: str = ''
    sensor: str = ''
    tolerance: str = ''
    least: float = 0.02
    step: float = 1e-3
    curved: bool = False
    form: bool = False
    log: LogNumber | None = None


@dataclass(frozen=True)
class Asked:
    """
    Start values of a limit: where it begins to cut what a flight asks for.

    Attributes:
        of: 'tilt_rate', 'torque' or 'thrust'.
        parts: of the most that the flight asks for, one start each.
        below: part of the limit, below which a start must lie.

    """

    of: str
    parts: tuple[float, ...]
    below: float


@dataclass(frozen=True)
class SensorErrors:
    """
    What a robot's sensors say beside the truth, as effects of the robot file have it.

    Attributes:
        accelerometer_bias: (3,) measured minus true [m/s^2].
        gyroscope_bias: (3,) [rad/s].
        imu_rotation: (3,) rotation vector of the IMU's axes seen from base_link [rad].
        imu_position: (3,) of the IMU in base_link [m].
        mocap_rotation: (3,) rotation vector of the markers' axes seen from base_link [rad].
        imu_delay: by which readings are older than their stamps [s].
        mocap_delay: likewise [s].
        encoder_delay: likewise [s].

    """

    accelerometer_bias: tuple[float, ...] = (0.0,) * 3
    gyroscope_bias: tuple[float, ...] = (0.0,) * 3
    imu_rotation: tuple[float, ...] = (0.0,) * 3
    imu_position: tuple[float, ...] = (0.0,) * 3
    mocap_rotation: tuple[float, ...] = (0.0,) * 3
    imu_delay: float = 0.0
    mocap_delay: float = 0.0
    encoder_delay: float = 0.0


@dataclass
class Terms:
    """
    The forces of one instant while they are put together, CasADi expressions throughout.

    Attributes:
        mass: [kg].
        inertia: (3,) diagonal about the centre of mass [kg m^2].
        centre_of_mass: (3,) seen from base_link's origin [m], or None where it is the origin.
        torque: (3,) torque added on the body, in base_link [N m].
        tilt: (4,) tilt angles [rad].
        tilt_acceleration: (4,) of the tilt joints [rad/s^2].
        tilt_axes: list of four (3,) unit vectors in base_link, outward along the arms.
        thrust: (4,) rotor thrusts after their lag [N].
        velocity: (3,) of the centre of gravity in world [m/s].
        angular_velocity: (3,) in base_link [rad/s].
        rotation: (3, 3) body to world.
        thrust_directions: list of four (3,) unit vectors in base_link.
        rotor_positions: list of four (3,) [m] in base_link.
        hover_thrust: of each rotor [N].
        force_world: (3,) force added in world [N].
        rotor_forces: list of four (3,) forces added at the rotors, in base_link [N].
        torque_ratio: reaction torque for each newton [m].
        tilt_rate: (4,) of the joints [rad/s].
        thrust_rate: (4,) change of the thrusts [N/s].
        spin: (4,) direction of rotation, +1 along the thrust.
        position: (3,) of base_link in world [m], or None where nobody knows it.
        voltage_ratio: pack voltage over that of a full pack, or None.

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

    def rotor_speeds(self) -> list:
        """Each rotor's speed over that in hover, from its thrust; list of four scalars."""
        return [ca.sqrt(ca.fmax(self.thrust[i], 0) / self.hover_thrust + 1e-9) for i in range(4)]

    def hub_velocities(self) -> list:
        """List of four (3,) velocities of the rotor hubs through still air, in base_link."""
        body = self.rotation.T @ self.velocity
        return [body + ca.cross(self.angular_velocity, r) for r in self.rotor_positions]


@dataclass
class ServoTerms:
    """
    What acts on one tilt servo at one instant, numbers of any namespace.

    Attributes:
        target: angle asked for [rad].
        thrust: of the joint's rotor [N].
        gyroscopic: what the rotor's spin puts on the joint for each N m s of its angular
            momentum in hover [rad/s], or 0 where the body's rate is unknown.
        load: torque beside the motor's [N m].
        coulomb: friction while it slides [N m], or None.
        stiction: friction at rest [N m], or None.

    """

    target: Any
    thrust: Any = 0.0
    gyroscopic: Any = 0.0
    load: Any = 0.0
    coulomb: Any = None
    stiction: Any = None


@dataclass(frozen=True)
class Stand:
    """
    What a consumer makes of an effect.

    Attributes:
        acts: whether a change of its parameters changes what the consumer computes.
        reason: why not.
        error: whether a robot file with the effect is refused.

    """

    acts: bool
    reason: str = ''
    error: bool = False


@dataclass(frozen=True)
class Effect:
    """
    One catalogue entry.

    Attributes:
        layer: 'body', 'rotor', 'joint', 'timing' or 'sensor'.
        parameters: name -> :class:`EffectParameter`.
        source: the equation and where it comes from.
        excited_by: flight in which it shows.
        confused_with: names of entries that look alike in poor data.
        separated_by: experiment that tells them apart.
        apply: body: changes :class:`Terms` in place, called as apply(terms, **values).
        servo: joint: changes :class:`ServoTerms` in place, servo(terms, joint, **values).
        each: 'rotor' or 'joint' where the parameters are (4,), one for each.
        delays: what comes late, 'tilt' and 'thrust' commands or readings of 'imu', 'mocap' and
            'encoders'.
        own_clock: whether a clock of its own stamps those readings, which may then seem early.
        channels: where it shows. B: forces and torques, J: joints, A: MoCap's acceleration,
            W: MoCap's rate of turn; A and W against the IMU.
        starts: values from which a fit starts, where the effect has no slope at its neutral value.
        forms: deviations of the parameters that choose a form, one mapping for each form.
        one_regime: whether it acts in one regime alone, such as near the ground.
        same_response: entry that is another form of the same response.
        log_rival: entry that a servo's response log can hardly tell from this one.
        allocated: whether the allocation of thrusts has it.
        plant: how the simulated plant has a body effect: 'model' as numbers of its bodies and
            rotors, 'own' by equations of its own, else by this entry's.
        stands: consumer -> its stand, where that does not follow from the kind of effect.

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
    starts: tuple[tuple[float, ...], ...] | Asked = ()
    forms: tuple[dict[str, float], ...] = ({},)
    one_regime: bool = False
    same_response: str = ''
    log_rival: str = ''
    allocated: bool = False
    plant: str = ''
    stands: dict[str, Stand] = field(default_factory=dict)

    @property
    def settings(self) -> dict[str, str]:
        """Parameter -> dotted key of the number that it replaces when a robot file is read."""
        return {} if self.apply else {name: spec.number for name, spec in self.parameters.items()
                                      if spec.number}

    def in_readings(self, parameter: str) -> bool:
        """Whether a parameter only shows in what sensors read, not in the model's equations."""
        return bool(self.parameters[parameter].sensor) or self.kind == 'play'

    @property
    def kind(self) -> str:
        """
        How it acts.

        'body' or 'servo' by its equation, 'number' in place of one of the robot file, 'command'
        as a delay of commands, 'sensor' in readings of IMU and MoCap, 'feedback' in those of the
        encoders, and 'play' between encoder and rotor.
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
        """Names of the parameters that a fit determines."""
        return [name for name, spec in self.parameters.items() if not spec.form]


def vector(values):
    """(n,) column of a tuple's numbers or symbols; anything else as it is."""
    return ca.vertcat(*ca.vertsplit(ca.SX(ca.vertcat(*values)))) if isinstance(values, tuple) \
        else values
