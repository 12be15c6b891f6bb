"""
Mass properties of the robot's parts.

A robot file contains the totals (mass, inertia about the centre of gravity), the tilting modules
and the end-effector. The main body is the difference. The frame is base_link, whose origin is the
centre of gravity with all tilts at zero.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from beetle_omni_ros.robot.schema import ParameterError

if TYPE_CHECKING:       # reads robot files with this module
    from beetle_omni_ros.robot.parameters import RobotParameters

CLOSE = 5e-4        # [m] within which a described part agrees with the totals; 2.4e-4 as shipped
MISSING = 0.1       # [1] of the inertia that a described main body may lack; 0.07 as shipped


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
    centre = np.sum([part.mass * part.centre for part in parts], axis=0) / mass
    return RigidPart(mass, centre, inertia_about(centre, parts))


def inertia_about(point: np.ndarray, parts: list[RigidPart]) -> np.ndarray:
    """Inertia (3, 3) of several parts about ``point`` [m]."""
    return np.sum([part.inertia_about(point) for part in parts], axis=0)


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
    made = _described(robot)
    known = [*made.modules, made.end_effector]
    mass = total_mass(robot, variation)
    offset = robot.effects.get('centre_of_mass', {}).get('offset', (0.0,) * 3)
    total_inertia = np.array(robot.effects.get('inertia', {}).get('inertia', robot.inertia))
    centre = variation.centre_of_mass + np.array(offset)
    point_mass = _remaining(mass, centre, known)
    inertia = np.diag(total_inertia * variation.inertia_scale) - inertia_about(
        centre, [point_mass, *known])
    moments = np.linalg.eigvalsh(inertia)
    if moments[0] <= 0 or moments[0] + moments[1] < moments[2]:
        raise ParameterError(f'inertia: {_text(total_inertia)} kg m^2 leaves the main body the '
                             f'principal moments {_text(moments)} kg m^2, which are impossible')
    return replace(made, main_body=replace(point_mass, inertia=inertia))


def _described(robot):
    """All parts, without the main body."""
    parts, nothing = robot.parts, RigidPart(0.0, np.zeros(3), np.zeros((3, 3)))
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
    return MassProperties(nothing, modules, end_effector, main_origin, joint_origins,
                          module_rotations)


def _remaining(mass, centre, known):
    """Point mass that completes the ``known`` parts to a total mass with its centre."""
    rest = mass - sum(part.mass for part in known)
    if rest <= 0:
        raise ParameterError(f'multibody: modules and end-effector weigh {mass - rest:g} kg, '
                             f'the whole robot {mass:g} kg; expected a main body with mass')
    moment = mass * centre - np.sum([part.mass * part.centre for part in known], axis=0)
    return RigidPart(rest, moment / rest, np.zeros((3, 3)))


def moved_inertia(robot: RobotParameters, base: RobotParameters) -> np.ndarray:
    """
    Inertia (3,) of a robot that differs from ``base`` in mass, rotor positions or parts.

    The main body keeps its radii of gyration. A robot without described parts keeps those of the
    whole robot.

    Raises:
        ParameterError: the arms of a robot without described parts have changed.

    """
    if robot.multibody is None or base.multibody is None:
        if not np.array_equal(robot.rotors.positions, base.rotors.positions):
            raise ParameterError('inertia: without multibody it does not follow from the changed '
                                 'rotors.positions; expected the key beside them')
        return base.inertia * robot.mass / base.mass
    before, made, origin = mass_properties(base).main_body, _described(robot), np.zeros(3)
    known = [*made.modules, made.end_effector]
    main = _remaining(robot.mass, origin, known)
    main = replace(main, inertia=before.inertia * main.mass / before.mass)
    return np.diag(inertia_about(origin, [main, *known]))


def check_parts(robot: RobotParameters) -> None:
    """
    Compare the described parts with the totals, of which the main body is the rest.

    Raises:
        ParameterError: names the key that contradicts the totals, its value and the expected one.

    """
    made, parts = mass_properties(replace(robot, effects={})), robot.multibody
    if parts is None:
        return
    joints, main = made.joint_origins - made.main_origin, parts.main_body
    checks = [('module.joint_offset', parts.module.joint_offset, np.abs(joints[:, :2])),
              ('centre_of_gravity_height', parts.centre_of_gravity_height, -made.main_origin[2]),
              ('main_body.centre_of_mass', main.centre_of_mass if main else None,
               made.main_body.centre - made.main_origin)]
    for key, found, expected in checks:
        if found is not None and np.abs(found - expected).max() > CLOSE:
            right = expected if np.ndim(found) else np.mean(expected)
            raise ParameterError(
                f'multibody.{key}: {_text(found)} m contradicts mass {robot.mass:g} kg, '
                f'rotors.positions and the other parts; expected {_text(right)} m within '
                f'{CLOSE:g} m, or no such key')
    if main:
        rest = np.diag(made.main_body.inertia)
        missing = (rest - main.inertia) / robot.inertia
        if not 0 <= missing.min() <= missing.max() <= MISSING:
            raise ParameterError(
                f'inertia: {_text(robot.inertia)} kg m^2 leaves the main body {_text(rest)}, but '
                f'multibody.main_body.inertia is {_text(main.inertia)}; expected it to lack at '
                f'most {MISSING:.0%} of the total, or no such key')


def _text(numbers):
    return np.array2string(np.asarray(numbers), precision=5, separator=', ',
                           suppress_small=True)
