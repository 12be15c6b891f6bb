"""What a catalogue entry is made of."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import casadi as ca

LAYERS = ('body', 'rotor', 'joint', 'timing', 'sensor')


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

    """

    unit: str
    neutral: float | tuple[float, ...]
    low: float
    high: float
    typical: float = float('nan')
    smallest: float = float('nan')
    default: float | None = None
    of_each: bool = False


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
        settings: parameter -> dotted key of the robot file whose number it replaces.
        each: 'rotor' or 'joint' where the parameters are (4,), one for each.

    """

    layer: str
    parameters: dict[str, EffectParameter]
    source: str
    excited_by: str = ''
    confused_with: tuple[str, ...] = ()
    separated_by: str = ''
    apply: Callable | None = None
    servo: Callable | None = None
    settings: dict[str, str] = field(default_factory=dict)
    each: str = ''


def vector(values):
    """(n,) column of a tuple's numbers or symbols; anything else as it is."""
    return ca.vertcat(*ca.vertsplit(ca.SX(ca.vertcat(*values)))) if isinstance(values, tuple) \
        else values
