"""Write the URDF of a robot file: ``python description/generate_urdf.py [--robot FILE]``."""

import argparse
from math import atan2, hypot
from pathlib import Path

import numpy as np

from beetle_omni_ros.robot.parameters import JOINT_NAMES, RobotParameters, ROTOR_NAMES
from beetle_omni_ros.sim.mass_properties import mass_properties
from beetle_omni_ros.sim.parameters import SimulatorParameters

OUTPUT = Path(__file__).parent / 'beetle_omni.urdf'
HUB_RADIUS, HUB_HEIGHT, ARM_RADIUS, LEG_RADIUS = 0.06, 0.05, 0.009, 0.005   # [m] for the eye
DISC_HEIGHT = 0.006                                                         # [m] for the eye


def text(*numbers) -> str:
    """Numbers as URDF writes them, without noise in the last digits."""
    return ' '.join(f'{0.0 if abs(x) < 1e-12 else x:.9g}' for x in np.ravel(numbers))


def origin(position=(0, 0, 0), rpy=(0, 0, 0)) -> str:
    """An <origin> element."""
    return f'<origin xyz="{text(position)}" rpy="{text(rpy)}"/>'


def inertial(mass, centre, inertia) -> str:
    """An <inertial> element; ``inertia`` (3, 3) at ``centre`` in the link's axes."""
    names = {'ixx': (0, 0), 'ixy': (0, 1), 'ixz': (0, 2), 'iyy': (1, 1), 'iyz': (1, 2),
             'izz': (2, 2)}
    entries = ' '.join(f'{name}="{text(inertia[at])}"' for name, at in names.items())
    return (f'<inertial>{origin(centre)}<mass value="{text(mass)}"/>'
            f'<inertia {entries}/></inertial>')


def shape(geometry, position=(0, 0, 0), rpy=(0, 0, 0), material='dark', collision=False) -> str:
    """A <visual>, and the same as <collision> if asked."""
    body = f'{origin(position, rpy)}<geometry>{geometry}</geometry>'
    visual = f'<visual>{body}<material name="{material}"/></visual>'
    return visual + (f'\n    <collision>{body}</collision>' if collision else '')


def rod(start, end, radius, material='dark') -> str:
    """A cylinder between two points."""
    x, y, z = np.subtract(end, start)
    return shape(f'<cylinder radius="{text(radius)}" length="{text(hypot(x, y, z))}"/>',
                 np.add(start, end) / 2, (0, atan2(hypot(x, y), z), atan2(y, x)), material)


def link(name, *content) -> str:
    """A <link>."""
    inside = '\n    '.join(part for part in content if part)
    return f'  <link name="{name}">\n    {inside}\n  </link>' if inside \
        else f'  <link name="{name}"/>'


def fixed(name, parent, child, position=(0, 0, 0)) -> str:
    """A fixed <joint>."""
    return (f'  <joint name="{name}" type="fixed">\n    <parent link="{parent}"/>'
            f'<child link="{child}"/>\n    {origin(position)}\n  </joint>')


def main_body(robot, plant, parts) -> str:
    """Hub, arms and legs; the main body's frame is parallel to base_link."""
    ball = [0, 0, robot.multibody.end_effector.height]
    arms = [rod([0, 0, robot.multibody.module.joint_height], joint - parts.main_origin, ARM_RADIUS,
                'front' if joint[0] > 0 else 'dark') for joint in parts.joint_origins]
    legs = []
    for x, y in [(1, 1), (-1, 1), (-1, -1), (1, -1)]:
        foot = np.array([x * plant.foot_spread, y * plant.foot_spread,
                         plant.foot_radius - plant.foot_depth]) - parts.main_origin
        legs += [rod(0.5 * np.array([x, y, 0]) * HUB_RADIUS, foot, LEG_RADIUS),
                 shape(f'<sphere radius="{text(plant.foot_radius)}"/>', foot, collision=True)]
    body = parts.main_body
    return link('main_body', inertial(body.mass, body.centre - parts.main_origin, body.inertia),
                shape(f'<cylinder radius="{text(HUB_RADIUS)}" length="{text(HUB_HEIGHT)}"/>',
                      collision=True), rod([0, 0, 0], ball, LEG_RADIUS), *arms, *legs)


def module(robot, plant, parts, k) -> str:
    """One tilting module with its rotor; x of the module's frame is the tilt axis."""
    module, joints = robot.multibody.module, robot.joints
    disc = (f'<cylinder radius="{text(plant.propeller_radius)}" '
            f'length="{text(DISC_HEIGHT)}"/>')
    return '\n'.join([
        link(f'module{k + 1}', inertial(module.mass, module.centre_of_mass,
                                        np.diag(module.inertia)),
             rod([0, 0, 0], [module.rotor_offset, 0, 0], ARM_RADIUS)),
        f'  <joint name="{JOINT_NAMES[k]}" type="revolute">\n    <parent link="base_link"/>'
        f'<child link="module{k + 1}"/>\n    '
        f'{origin(parts.joint_origins[k], (0, 0, robot.rotors.arm_yaw[k]))}\n    '
        '<axis xyz="1 0 0"/>\n'
        f'    <limit lower="{text(-joints.position_limit)}" upper="{text(joints.position_limit)}" '
        f'effort="{text(joints.effort_limit)}" velocity="{text(joints.velocity_limit)}"/>\n'
        '  </joint>',
        link(ROTOR_NAMES[k], shape(disc, material='propeller', collision=True)),
        fixed(f'{ROTOR_NAMES[k]}_mount', f'module{k + 1}', ROTOR_NAMES[k],
              (module.rotor_offset, 0, 0))])


def urdf(robot: RobotParameters, plant) -> str:
    """The whole description; base_link is the centre of gravity."""
    parts = mass_properties(robot)
    ball = robot.multibody.end_effector
    materials = ''.join(f'  <material name="{name}"><color rgba="{rgba}"/></material>\n'
                        for name, rgba in [('dark', '0.15 0.15 0.17 1'),
                                           ('front', '0.85 0.2 0.15 1'),
                                           ('propeller', '0.25 0.5 0.75 0.5')])
    solid = np.zeros((3, 3))
    return '\n'.join([
        '<?xml version="1.0"?>',
        '<!-- Written by description/generate_urdf.py from params/robot.yaml; edit those. -->',
        f'<robot name="{robot.name}">', materials.rstrip('\n'),
        link('base_link'), main_body(robot, plant, parts),
        fixed('main_body_mount', 'base_link', 'main_body', parts.main_origin),
        *[module(robot, plant, parts, k) for k in range(4)],
        link('end_effector', inertial(ball.mass, np.zeros(3), solid),
             shape(f'<sphere radius="{text(plant.end_effector_radius)}"/>', collision=True)),
        fixed('end_effector_mount', 'main_body', 'end_effector', (0, 0, ball.height)),
        link('imu'), fixed('imu_mount', 'base_link', 'imu'), '</robot>', ''])


def main():
    """Write the file."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--robot', default=None, help='robot file; default: the shipped one')
    parser.add_argument('--output', type=Path, default=OUTPUT)
    given = parser.parse_args()
    given.output.write_text(urdf(RobotParameters.load(given.robot),
                                 SimulatorParameters.load().plant))


if __name__ == '__main__':
    main()
