"""MuJoCo geometry of the robot for pictures, with the dimensions of the plant."""

from dataclasses import dataclass

import mujoco
import numpy as np

from beetle_omni_ros.robot.mass_properties import mass_properties
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.sim.parameters import PlantParameters

# Colours (red, green, blue), and sizes [m] that only pictures use.
CARBON, SHELL, METAL = (0.06, 0.065, 0.075), (0.82, 0.84, 0.87), (0.5, 0.52, 0.56)
FRONT, REAR, SERVO = (0.88, 0.14, 0.10), (0.13, 0.15, 0.18), (0.10, 0.11, 0.13)
BALL, LEG, BLADE = (0.97, 0.60, 0.08), (0.17, 0.18, 0.21), (0.05, 0.05, 0.06)
DISC_FRONT, DISC_REAR = (0.95, 0.45, 0.35), (0.35, 0.62, 0.90)
DISC_OPACITY = 0.22
ARM, STALK, HUB = 0.011, 0.006, 0.070
HUB_HEIGHT = 0.012              # height of a propeller above its joint axis
BLADES = 3
LIGHT = 'mass="0.001"'          # MuJoCo requires mass of a moving body


def _numbers(*values):
    return ' '.join(f'{x:.6g}' for x in np.hstack([np.ravel(value) for value in values]))


@dataclass(frozen=True)
class Look:
    """
    Appearance of a robot.

    Attributes:
        opacity: 1 for a solid robot, less for a ghost.
        tint: (3,) colour of the whole robot, or None for the colours of its parts.

    """

    opacity: float = 1.0
    tint: tuple[float, float, float] | None = None


class Figure:
    """
    MJCF text of one robot as a free body with turning joints and propellers.

    Generalised positions: pose of base_link (7), then for each arm the tilt and the angle of the
    propeller (8).
    """

    def __init__(self, robot: RobotParameters, plant: PlantParameters):
        self._robot, self._plant = robot, plant
        self._parts = mass_properties(robot)
        self._look = Look()

    def body(self, look: Look = Look()) -> str:
        """MJCF of a robot with this look."""
        self._look = look
        modules = ''.join(self._module(k) for k in range(4))
        return f'<body><freejoint/>{self._main_body()}{modules}</body>\n'

    def _geom(self, kind, size, colour, pos=None, ends=None, quat=None, opacity=1.0, shine=True):
        look = self._look
        place = f'fromto="{_numbers(ends)}"' if ends is not None else f'pos="{_numbers(pos)}"'
        turn = f'quat="{_numbers(quat)}"' if quat is not None else ''
        material = 'gloss' if shine else 'glow'
        return (f'<geom type="{kind}" size="{_numbers(size)}" {place} {turn} {LIGHT} '
                f'material="{material}" '
                f'rgba="{_numbers(look.tint or colour, opacity * look.opacity)}"/>\n')

    def _main_body(self):
        origin, parts, plant = self._parts.main_origin, self._parts, self._plant
        height = self._robot.parts.module.joint_height
        ball = origin + [0, 0, self._robot.parts.end_effector.height]
        shapes = [
            self._geom('cylinder', (HUB, 0.003), CARBON, origin + [0, 0, height + 0.014]),
            self._geom('cylinder', (HUB, 0.003), CARBON, origin + [0, 0, height - 0.014]),
            self._geom('ellipsoid', (0.055, 0.055, 0.030), SHELL, origin + [0, 0, height + 0.02]),
            self._geom('box', (0.065, 0.022, 0.020), SERVO, origin + [0, 0, height - 0.038]),
            self._geom('capsule', (0.006,), FRONT, ends=(origin + [0.03, 0, height + 0.046],
                                                         origin + [0.085, 0, height + 0.018])),
            self._geom('cylinder', (STALK,), METAL, ends=(origin + [0, 0, height], ball)),
            self._geom('sphere', (plant.end_effector_radius,), BALL, ball)]
        for joint, axis in zip(parts.joint_origins, self._robot.tilt_axes):
            colour = FRONT if axis[0] > 0 else REAR
            root = origin + [0, 0, height] + 0.6 * HUB * axis
            shapes.append(self._geom('cylinder', (ARM,), colour,
                                     ends=(root, joint - 0.035 * axis)))
            shapes.append(self._geom('capsule', (0.015,), SERVO, ends=(joint - 0.05 * axis,
                                                                      joint - 0.018 * axis)))
        for x, y in [(1, 1), (-1, 1), (-1, -1), (1, -1)]:
            foot = np.array([x * plant.foot_spread, y * plant.foot_spread,
                             plant.foot_radius - plant.foot_depth])
            top = origin + [0.6 * HUB * x, 0.6 * HUB * y, height - 0.014]
            shapes.append(self._geom('capsule', (0.0055,), LEG, ends=(top, foot)))
            shapes.append(self._geom('sphere', (plant.foot_radius,), CARBON, foot))
        return ''.join(shapes)

    def _module(self, k):
        axis_turn = np.empty(4)
        mujoco.mju_mat2Quat(axis_turn, self._parts.module_rotations[k].ravel())
        rotor = np.array([self._robot.parts.module.rotor_offset, 0, 0])
        radius = self._plant.propeller_radius
        disc = DISC_FRONT if self._robot.tilt_axes[k][0] > 0 else DISC_REAR
        hub = rotor + [0, 0, HUB_HEIGHT]
        shapes = [
            self._geom('capsule', (0.010,), METAL, ends=([-0.015, 0, 0], rotor)),
            self._geom('cylinder', (0.016, 0.016), METAL, rotor - [0, 0, 0.010]),
            self._geom('cylinder', (0.017, 0.004), FRONT if disc is DISC_FRONT else CARBON,
                       rotor - [0, 0, 0.022]),
            self._geom('cylinder', (radius, 0.0012), disc, hub, opacity=DISC_OPACITY,
                       shine=False)]
        blades = [self._geom('ellipsoid', (0.011, 0.011, 0.014), CARBON, np.zeros(3))]
        for blade in range(BLADES):
            angle = 2 * np.pi * blade / BLADES + 0.7 * k
            along = np.array([np.cos(angle), np.sin(angle), 0])
            twist = np.empty(4)
            mujoco.mju_axisAngle2Quat(twist, np.array([0, 0, 1.0]), angle)
            blades.append(self._geom('ellipsoid', (0.48 * radius, 0.011, 0.0025), BLADE,
                                     0.5 * radius * along, quat=twist))
        return (f'<body pos="{_numbers(self._parts.joint_origins[k])}" '
                f'quat="{_numbers(axis_turn)}"><joint axis="1 0 0"/>{"".join(shapes)}'
                f'<body pos="{_numbers(hub)}"><joint axis="0 0 1"/>{"".join(blades)}</body>'
                '</body>\n')
