"""
Write the meshes of the robot: ``python description/generate_meshes.py [--robot FILE]``.

Own geometry from the same numbers as the URDF and the simulated plant, in the frames of the URDF's
links: binary STL, metres. Files that end in _collision are convex and coarse. Needs trimesh.
"""

import argparse
from pathlib import Path

import numpy as np
import trimesh
from trimesh.creation import box, capsule, cylinder, icosphere

from beetle_omni_ros.model.parameters import mass_properties, RobotParameters
from beetle_omni_ros.sim.parameters import SimulatorParameters

OUTPUT = Path(__file__).parent / 'meshes'
# Sizes for the eye [m]; those that can touch are the plant's.
PLATE_RADIUS, PLATE_HEIGHT, PLATE_GAP = 0.070, 0.004, 0.028
ARM_RADIUS, LEG_RADIUS, STALK_RADIUS, SERVO_RADIUS = 0.011, 0.0055, 0.006, 0.015
HUB_RADIUS, HUB_HEIGHT, DISC_HEIGHT = 0.06, 0.05, 0.006
BLADES, BLADE_WIDTH, BLADE_THICKNESS, BLADE_PITCH = 3, 0.011, 0.0022, 0.28      # pitch [rad]
SIDES, COARSE = 20, 12


def rod(start, end, radius, sides=SIDES):
    """A cylinder between two points."""
    return cylinder(radius, segment=[start, end], sections=sides)


def ball(centre, radius, fineness=2):
    """A sphere."""
    return icosphere(fineness, radius).apply_translation(centre)


def rounded(start, end, radius):
    """A capsule between two points."""
    start, end = np.asarray(start, float), np.asarray(end, float)
    length = np.linalg.norm(end - start)
    turn = trimesh.geometry.align_vectors([0, 0, 1], end - start)
    mesh = capsule(length, radius, count=[12, 12]).apply_transform(turn)
    return mesh.apply_translation(start)


def plate(height, radius=PLATE_RADIUS, thickness=PLATE_HEIGHT, sides=SIDES):
    """A disc that is centred at ``height``."""
    return cylinder(radius, thickness, sections=sides).apply_translation([0, 0, height])


def feet(plant, parts):
    """Centres of the four feet in the main body's frame."""
    return [np.array([x * plant.foot_spread, y * plant.foot_spread,
                      plant.foot_radius - plant.foot_depth]) - parts.main_origin
            for x, y in ((1, 1), (-1, 1), (-1, -1), (1, -1))]


def main_body(robot, plant, parts):
    """Name -> mesh of the main body: frame, shell and the two pairs of arms."""
    height = robot.multibody.module.joint_height
    frame = [plate(height + PLATE_GAP / 2), plate(height - PLATE_GAP / 2),
             box([0.13, 0.044, 0.04]).apply_translation([0, 0, height - 0.038]),
             rod([0, 0, height], [0, 0, robot.multibody.end_effector.height], STALK_RADIUS)]
    for foot in feet(plant, parts):
        top = np.array([*0.6 * PLATE_RADIUS * np.sign(foot[:2]), height - PLATE_GAP / 2])
        frame += [rod(top, foot, LEG_RADIUS, COARSE), ball(foot, plant.foot_radius)]
    shell = ball([0, 0, 0], 1.0).apply_scale([0.055, 0.055, 0.03])
    arms = {'arms_front': [], 'arms_rear': []}
    for joint, axis in zip(parts.joint_origins, robot.tilt_axes):
        end, root = joint - parts.main_origin, 0.6 * PLATE_RADIUS * axis + [0, 0, height]
        arms['arms_front' if axis[0] > 0 else 'arms_rear'] += [
            rod(root, end - 0.035 * axis, ARM_RADIUS),
            rounded(end - 0.05 * axis, end - 0.018 * axis, SERVO_RADIUS)]
    return {'frame': frame, 'shell': [shell.apply_translation([0, 0, height + 0.02])], **arms}


def rotor(radius, spin):
    """A propeller about the rotor's axis; ``spin`` +1 is seen from above anticlockwise."""
    parts = [ball([0, 0, 0.012], 0.012, 1)]
    for angle in 2 * np.pi * np.arange(BLADES) / BLADES:
        blade = icosphere(2, 1.0).apply_scale(
            [0.48 * radius, BLADE_WIDTH, BLADE_THICKNESS])
        blade.apply_translation([0.5 * radius, 0, 0])
        turn = trimesh.transformations.rotation_matrix
        blade.apply_transform(turn(spin * BLADE_PITCH, [1, 0, 0]))
        blade.apply_transform(turn(angle, [0, 0, 1]))
        parts.append(blade.apply_translation([0, 0, 0.012]))
    return parts


def meshes(robot: RobotParameters, plant) -> dict[str, trimesh.Trimesh]:
    """File name without suffix -> mesh."""
    parts = mass_properties(robot)
    hub = np.array([robot.multibody.module.rotor_offset, 0, 0])
    found = {
        **main_body(robot, plant, parts),
        'module': [rounded([-0.015, 0, 0], hub, 0.010),
                   rod(hub - [0, 0, 0.026], hub + [0, 0, 0.006], 0.016)],
        'rotor_anticlockwise': rotor(plant.propeller_radius, 1),
        'rotor_clockwise': rotor(plant.propeller_radius, -1),
        'end_effector': [ball([0, 0, 0], plant.end_effector_radius)],
        'hub_collision': [plate(0, HUB_RADIUS, HUB_HEIGHT, COARSE)],
        'foot_collision': [ball([0, 0, 0], plant.foot_radius, 1)],
        'rotor_collision': [plate(0, plant.propeller_radius, DISC_HEIGHT, COARSE)],
        'end_effector_collision': [ball([0, 0, 0], plant.end_effector_radius, 1)]}
    return {name: trimesh.util.concatenate(pieces) for name, pieces in found.items()}


def main():
    """Write the files."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument('--robot', default=None, help='robot file; default: the shipped one')
    parser.add_argument('--output', type=Path, default=OUTPUT)
    given = parser.parse_args()
    given.output.mkdir(parents=True, exist_ok=True)
    for name, mesh in meshes(RobotParameters.load(given.robot),
                             SimulatorParameters.load()).items():
        (given.output / f'{name}.stl').write_bytes(mesh.export(file_type='stl'))


if __name__ == '__main__':
    main()
