"""
Differences between the multibody plant and the single rigid body of the controller.

``python benchmarks/multibody_difference.py`` compares the plant (MuJoCo) with the CasADi model at
random states, as a force on the mass and a torque on the inertia. Joints are held or turn at
constant rate, so that only the shifted centre of mass and inertia remain. Then servos brake the
joints, which adds the reaction of the modules.
"""

import mujoco
import numpy as np

from beetle_omni_ros.model import rotations
from beetle_omni_ros.model.dynamics import body_acceleration
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.sim.parameters import SimulatorParameters
from beetle_omni_ros.sim.plant import Plant

HEIGHT = np.array([0.0, 0.0, 10.0])     # [m] away from the floor
STATES = 500                            # of each case
CASES = (                               # name, tilts, body rates, joint rates, joints held
    ('level hover', 0.0, 0.0, 0.0, True),
    ('hover, tilts within +-pi', np.pi, 0.0, 0.0, True),
    ('turning, |w| about 3 rad/s', np.pi, 2.0, 0.0, True),
    ('joints moving, 5 rad/s', np.pi, 2.0, 5.0, True),
    ('joints braked from 5 rad/s', np.pi, 2.0, 5.0, False))


def acceleration(plant, state, target):
    """Accelerations (10,) in a state with the tilt targets (4,) [rad]."""
    position, quaternion, velocity, angular_velocity, tilt, tilt_rate, thrust = state
    plant.reset(position, quaternion, [*velocity, *angular_velocity, *tilt_rate], tilt, thrust)
    plant.set_targets(target, thrust)
    mujoco.mj_forward(plant.model, plant.data)
    return plant.data.qacc.copy()


def held_target(plant, state, tilt):
    """Tilt targets at which no joint accelerates: the response to a target is linear."""
    rest = acceleration(plant, state, tilt)[6:]
    step = 0.01
    response = np.stack([(acceleration(plant, state, tilt + step * unit)[6:] - rest)
                         / step for unit in np.eye(4)], axis=1)
    return tilt - np.linalg.solve(response, rest)


def differences(robot, tilt_span, rate, joint_rate, held):
    """Force [N] and torque [N m] differences (STATES,) at random states."""
    plant, model = Plant(robot, SimulatorParameters.load()), body_acceleration(robot)
    generator = np.random.default_rng(0)
    force, torque = np.empty((2, STATES))
    for k in range(STATES):
        quaternion = rotations.normalized(generator.normal(size=4))
        velocity, angular_velocity = generator.normal(size=3), rate * generator.normal(size=3)
        tilt = tilt_span * generator.uniform(-1, 1, 4)
        thrust = robot.hover_thrust * generator.uniform(0.7, 1.3, 4)
        state = (HEIGHT, quaternion, velocity, angular_velocity, tilt,
                 joint_rate * generator.choice([-1, 1], 4), thrust)
        target = held_target(plant, state, tilt) if held else tilt
        found = acceleration(plant, state, target)
        linear, angular = model(velocity, quaternion, angular_velocity, tilt, thrust)
        force[k] = robot.mass * np.linalg.norm(found[:3] - np.ravel(linear))
        torque[k] = np.linalg.norm(robot.inertia * (found[3:6] - np.ravel(angular)))
    return force, torque


def main():
    """Print root mean square and largest difference of each case."""
    robot = RobotParameters.load()
    print(f"{'':<30}{'force N':>16}{'torque N m':>18}\n{'':<30}"
          f"{'rms':>8}{'max':>8}{'rms':>10}{'max':>8}")
    for name, *case in CASES:
        force, torque = differences(robot, *case)
        print(f'{name:<30}{np.sqrt((force ** 2).mean()):>8.3f}{force.max():>8.3f}'
              f'{np.sqrt((torque ** 2).mean()):>10.4f}{torque.max():>8.4f}')
    plant = Plant(robot, SimulatorParameters.load())
    module = robot.multibody.module
    aligned = np.pi / 2 * np.array([1, 1, -1, -1])
    plant.reset(HEIGHT, tilt=aligned)
    shift = plant.data.subtree_com[1] - HEIGHT
    weight = robot.mass * robot.gravity
    aside, up = np.linalg.norm(shift[:2]), shift[2]
    print(f'all modules at 90 deg to one side: centre of mass {1e3 * aside:.2f} mm aside, '
          f'{1e3 * up:.2f} mm up; as a moment of the weight {aside * weight:.4f} N m with the '
          f'body level, up to {up * weight:.4f} N m with it on its side')
    print(f'load of a module on its joint: up to '
          f'{-module.mass * module.centre_of_mass[2] * robot.gravity:.4f} N m at 1 g')


if __name__ == '__main__':
    main()
