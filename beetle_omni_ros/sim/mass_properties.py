"""
Mass properties of the robot's parts.

A robot file contains the totals (mass, inertia about the centre of gravity), the tilting modules
and the end-effector. The main body is the difference. The frame is base_link, whose origin is the
centre of gravity with all tilts at zero.
"""

from dataclasses import dataclass, field

import numpy as np

from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.robot.schema import ParameterError


@dataclass(frozen=True)
class Variation:
    """
    Deviation of one robot from its file.

    Attributes:
        mass_scale: factor of the total mass.
        inertia_scale: (3,) factors of the total inertia.
        centre_of_mass: (3,) centre of mass of the whole robot in base_link [m].

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
        main_body: totals minus the other parts.
        modules: the four tilting modules.
        end_effector: the ball.
        main_origin: (3,) origin of the main body's frame in base_link [m].
        joint_origins: (4, 3) origins of the tilt joints in base_link [m].
        module_rotations: (4, 3, 3), columns outward, sideways, up, in base_link.

    """

    main_body: RigidPart
    modules: tuple[RigidPart, ...]
    end_effector: RigidPart
    main_origin: np.ndarray
    joint_origins: np.ndarray
    module_rotations: np.ndarray


def combined(parts: list[RigidPart]) -> RigidPart:
    """Combine parts into one rigid part."""
    mass = sum(part.mass for part in parts)
    centre = sum(part.mass * part.centre for part in parts) / mass
    return RigidPart(mass, centre, sum(part.inertia_about(centre) for part in parts))


def total_mass(robot: RobotParameters, variation: Variation) -> float:
    """Mass of the whole robot [kg] with the effect ``mass`` and the variation."""
    return robot.effects.get('mass', {}).get('mass', robot.mass) * variation.mass_scale


def mass_properties(robot: RobotParameters, variation: Variation | None = None) -> MassProperties:
    """
    Mass properties of all parts.

    The tilt axes contain the rotor centres of ``robot.rotors.positions``. Mass, centre and inertia
    of the main body follow from the totals.

    Raises:
        ParameterError: the parts are heavier than the robot, or the inertia of the main body is
            impossible.

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
                             f'the whole robot {mass:g} kg; expected a main body with mass')
    offset = robot.effects.get('centre_of_mass', {}).get('offset', (0.0,) * 3)
    total_inertia = np.array(robot.effects.get('inertia', {}).get('inertia', robot.inertia))
    centre = variation.centre_of_mass + np.array(offset)
    main_centre = (mass * centre - sum(part.mass * part.centre for part in known)) / main_mass
    point_mass = RigidPart(main_mass, main_centre, np.zeros((3, 3)))
    inertia = np.diag(total_inertia * variation.inertia_scale) - sum(
        part.inertia_about(centre) for part in [point_mass, *known])
    moments = np.linalg.eigvalsh(inertia)
    if moments[0] <= 0 or moments[0] + moments[1] < moments[2]:
        raise ParameterError('inertia: the main body would have the principal moments '
                             f'{np.array2string(moments, precision=4)} kg m^2, which are '
                             'impossible')
    return MassProperties(RigidPart(main_mass, main_centre, inertia), modules, end_effector,
                          main_origin, joint_origins, module_rotations)
