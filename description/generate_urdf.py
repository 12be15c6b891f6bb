"""Write the URDF of a robot file: ``python description/generate_urdf.py [--robot FILE]``."""

import argparse
from pathlib import Path

import numpy as np

from beetle_omni_ros.model.parameters import (
    JOINT_NAMES,
    mass_properties,
    RobotParameters,
    ROTOR_NAMES,
)
from beetle_omni_ros.sim.parameters import SimulatorParameters

OUTPUT = Path(__file__).parent / 'beetle_omni.urdf'
MESHES = 'package://beetle_omni_ros/description/meshes'
DISC_HEIGHT = 0.003         # [m] of the disc that a turning propeller looks like
COLOURS = {'dark': '0.10 0.105 0.12 1', 'shell': '0.82 0.84 0.87 1', 'metal': '0.5 0.52 0.56 1',
           'front': '0.88 0.14 0.10 1', 'rear': '0.13 0.15 0.18 1', 'ball': '0.97 0.60 0.08 1',
           'propeller': '0.35 0.62 0.90 0.25'}


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


def mesh(name) -> str:
    """The <geometry> of one file of generate_meshes.py."""
    return f'<geometry><mesh filename="{MESHES}/{name}.stl"/></geometry>'


def visual(geometry, material) -> str:
    """A <visual> at the link's origin."""
    return f'<visual>{origin()}{geometry}<material name="{material}"/></visual>'


def collision(name, position=(0, 0, 0)) -> str:
    """A <collision> with one convex mesh."""
    return f'<collision>{origin(position)}{mesh(name)}</collision>'


def link(name, *content) -> str:
    """A <link>."""
    inside = '\n    '.join(part for part in content if part)
    return f'  <link name="{name}">\n    {inside}\n  </link>' if inside \
        else f'  <link name="{name}"/>'


def fixed(name, parent, child, position=(0, 0, 0)) -> str:
    """A fixed <joint>."""
    return (f'  <joint name="{name}" type="fixed">\n    <parent link="{parent}"/>'
            f'<child link="{child}"/>\n    {origin(position)}\n  </joint>')


def main_body(plant, parts) -> str:
    """Frame, shell, arms and legs; the main body's frame is parallel to base_link."""
    feet = [np.array([x * plant.foot_spread, y * plant.foot_spread,
                      plant.foot_radius - plant.foot_depth]) - parts.main_origin
            for x, y in [(1, 1), (-1, 1), (-1, -1), (1, -1)]]
    body = parts.main_body
    return link('main_body', inertial(body.mass, body.centre - parts.main_origin, body.inertia),
                visual(mesh('frame'), 'dark'), visual(mesh('shell'), 'shell'),
                visual(mesh('arms_front'), 'front'), visual(mesh('arms_rear'), 'rear'),
                collision('hub_collision'), *(collision('foot_collision', foot) for foot in feet))


def module(robot, plant, parts, k) -> str:
    """One tilting module with its rotor; x of the module's frame is the tilt axis."""
    module, joints = robot.multibody.module, robot.joints
    disc = (f'<geometry><cylinder radius="{text(plant.propeller_radius)}" '
            f'length="{text(DISC_HEIGHT)}"/></geometry>')
    propeller = 'rotor_anticlockwise' if robot.rotors.spin[k] > 0 else 'rotor_clockwise'
    return '\n'.join([
        link(f'module{k + 1}', inertial(module.mass, module.centre_of_mass,
                                        np.diag(module.inertia)),
             visual(mesh('module'), 'metal')),
        f'  <joint name="{JOINT_NAMES[k]}" type="revolute">\n    <parent link="base_link"/>'
        f'<child link="module{k + 1}"/>\n    '
        f'{origin(parts.joint_origins[k], (0, 0, robot.rotors.arm_yaw[k]))}\n    '
        '<axis xyz="1 0 0"/>\n'
        f'    <limit lower="{text(-joints.position_limit)}" upper="{text(joints.position_limit)}" '
        f'effort="{text(joints.effort_limit)}" velocity="{text(joints.velocity_limit)}"/>\n'
        '  </joint>',
        link(ROTOR_NAMES[k], visual(mesh(propeller), 'dark'), visual(disc, 'propeller'),
             collision('rotor_collision')),
        fixed(f'{ROTOR_NAMES[k]}_mount', f'module{k + 1}', ROTOR_NAMES[k],
              (module.rotor_offset, 0, 0))])


def urdf(robot: RobotParameters, plant) -> str:
    """The whole description; base_link is the centre of gravity."""
    parts = mass_properties(robot)
    ball = robot.multibody.end_effector
    materials = '\n'.join(f'  <material name="{name}"><color rgba="{rgba}"/></material>'
                          for name, rgba in COLOURS.items())
    solid = np.zeros((3, 3))
    return '\n'.join([
        '<?xml version="1.0"?>',
        '<!-- Written by description/generate_urdf.py from params/robot.yaml; edit those. -->',
        f'<robot name="{robot.name}">',
        '  <mujoco><compiler meshdir="meshes" strippath="true"/></mujoco>', materials,
        link('base_link'), main_body(plant, parts),
        fixed('main_body_mount', 'base_link', 'main_body', parts.main_origin),
        *[module(robot, plant, parts, k) for k in range(4)],
        link('end_effector', inertial(ball.mass, np.zeros(3), solid),
             visual(mesh('end_effector'), 'ball'), collision('end_effector_collision')),
        fixed('end_effector_mount', 'main_body', 'end_effector', (0, 0, ball.height)),
        link('imu'), fixed('imu_mount', 'base_link', 'imu'), '</robot>', ''])


def main():
    """Write the file."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--robot', default=None, help='robot file; default: the shipped one')
    parser.add_argument('--output', type=Path, default=OUTPUT)
    given = parser.parse_args()
    given.output.write_text(urdf(RobotParameters.load(given.robot),
                                 SimulatorParameters.load()))


if __name__ == '__main__':
    main()
