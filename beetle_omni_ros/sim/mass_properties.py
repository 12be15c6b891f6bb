"""
How the robot's totals divide into its parts.

A robot file states the totals (mass, inertia about the centre of gravity) and the parts
that move or stick out; the main body is what is left. Frame: base_link, whose origin is
the centre of gravity with all tilts at zero.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.robot.schema import ParameterError


@dataclass(frozen=True)
class Variation:
    """
    How one particular robot differs from its file.

    Attributes:
        mass_scale: factor on the total mass.
        inertia_scale: (3,) factors on the total inertia.
        centre_of_mass: (3,) of the whole robot, seen from base_link's origin [m].

    """

    mass_scale: float = 1.0
    inertia_scale: np.ndarray = field(default_factory=lambda: np.ones(3))
    centre_of_mass: np.ndarray = field(default_factory=lambda: np.zeros(3))


@dataclass(frozen=True)
class RigidPart:
    """Mass [kg], centre of mass (3,) [m], inertia (3, 3) there [kg m^2], in base_link's axes."""

    mass: float
    centre: np.ndarray
    inertia: np.ndarray

    def inertia_about(self, point: np.ndarray) -> np.ndarray:
        """Inertia (3, 3) about ``point`` [m], by the parallel axis theorem."""
        r = self.centre - point
        return self.inertia + self.mass * (r @ r * np.eye(3) - np.outer(r, r))


@dataclass(frozen=True)
class MassProperties:
    """
    All parts of the robot with its tilts at zero.

    Attributes:
        main_body: what is left of the totals.
        modules: the four tilting modules.
        end_effector: the ball.
        main_origin: (3,) origin of the main body's frame in base_link [m].
        joint_origins: (4, 3) in base_link [m].
        module_rotations: (4, 3, 3), columns outward, sideways, up, in base_link.

    """

    main_body: RigidPart
    modules: tuple[RigidPart, ...]
    end_effector: RigidPart
    main_origin: np.ndarray
    joint_origins: np.ndarray
    module_rotations: np.ndarray


def combined(parts: list[RigidPart]) -> RigidPart:
    """Several parts as one rigid part."""
    mass = sum(part.mass for part in parts)
    centre = sum(part.mass * part.centre for part in parts) / mass
    return RigidPart(mass, centre, sum(part.inertia_about(centre) for part in parts))


def total_mass(robot: RobotParameters, variation: Variation) -> float:
    """Mass of the whole robot [kg], the effect ``mass`` and the variation included."""
    return robot.effects.get('mass', {}).get('mass', robot.mass) * variation.mass_scale


def mass_properties(robot: RobotParameters, variation: Variation | None = None) -> MassProperties:
    """
    Divide the totals into parts.

    The tilt axes run through the rotor centres of ``robot.rotors.positions``. The main body
    takes the mass, the place and the inertia that make the totals come true.

    Raises:
        ParameterError: the parts are heavier than the robot, or leave the main body an
            inertia that no body can have.

    """
    variation = variation or Variation()
    parts = robot.parts
    outward = robot.tilt_axes
    up = np.tile([0.0, 0.0, 1.0], (4, 1))
    module_rotations = np.stack([outward, np.cross(up, outward), up], axis=2)
    joint_origins = robot.rotors.positions - parts.module.rotor_offset * outward
    main_origin = joint_origins.mean(axis=0) - [0.0, 0.0, parts.module.joint_height]

    modules = tuple(
        RigidPart(parts.module.mass, origin + rotation @ parts.module.centre_of_mass,
                  rotation @ np.diag(parts.module.inertia) @ rotation.T)
        for origin, rotation in zip(joint_origins, module_rotations))
    end_effector = RigidPart(parts.end_effector.mass,
                             main_origin + [0.0, 0.0, parts.end_effector.height], np.zeros((3, 3)))
    known = [*modules, end_effector]

    mass = total_mass(robot, variation)
    main_mass = mass - sum(part.mass for part in known)
    if main_mass <= 0:
        raise ParameterError(f'multibody: modules and end-effector weigh {mass - main_mass:g} kg, '
                             f'the whole robot {mass:g} kg; nothing is left for the main body')
    offset = robot.effects.get('centre_of_mass', {}).get('offset', (0.0,) * 3)
    total_inertia = np.array(robot.effects.get('inertia', {}).get('inertia', robot.inertia))
    centre = variation.centre_of_mass + np.array(offset)
    main_centre = (mass * centre - sum(part.mass * part.centre for part in known)) / main_mass
    point_mass = RigidPart(main_mass, main_centre, np.zeros((3, 3)))
    inertia = np.diag(total_inertia * variation.inertia_scale) - sum(
        part.inertia_about(centre) for part in [point_mass, *known])
    moments = np.linalg.eigvalsh(inertia)
    if moments[0] <= 0 or moments[0] + moments[1] < moments[2]:
        raise ParameterError('inertia: the parts leave the main body principal moments of '
                             f'{np.array2string(moments, precision=4)} kg m^2, which no body has')
    return MassProperties(RigidPart(main_mass, main_centre, inertia), modules, end_effector,
                          main_origin, joint_origins, module_rotations)
