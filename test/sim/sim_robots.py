"""Variants of the shipped robot, and measurements on a plant."""

from dataclasses import replace

import mujoco
import numpy as np

from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.sim.parameters import SimulatorParameters
from beetle_omni_ros.sim.plant import Plant

ROBOT = RobotParameters.load()
WORLD = SimulatorParameters.load()
LEVEL = np.array([0.0, 0.0, 0.0, 1.0])
HIGH = np.array([0.0, 0.0, 20.0])
# Each effect of the body equations but for modules and formulas.
EQUATIONS = {
    'mass': {'mass': 3.3}, 'inertia': {'inertia': (0.08, 0.07, 0.11)},
    'centre_of_mass': {'offset': (0.01, -0.015, 0.02)}, 'thrust_coefficient': {'scale': 0.93},
    'rotor_thrust_coefficient': {'scale': [1.0, 0.9, 1.05, 0.97]},
    'torque_coefficient': {'torque_to_thrust_ratio': 0.021},
    'joint_offset': {'offset': [0.05, -0.1, 0.2, 0.03]}, 'wind': {'force': [1.0, -2.0, 0.5]},
    'wind_velocity': {'velocity': [3.0, -2.0, 1.0]},
    'body_drag': {'coefficient': 0.11}, 'rotor_drag': {'coefficient': 0.4},
    'rotor_hub_moment': {'coefficient': 0.1}, 'axial_inflow': {'per_rotor': 0.4},
    'translational_lift': {'per_rotor': 0.03}, 'tilt_thrust_loss': {'loss_at_60deg': 0.06},
    'ground_effect': {'gain_at_0.25m': 0.2},
    'propeller_gyroscopic_torque': {'angular_momentum_at_hover': 0.066},
    'rotor_acceleration_torque': {'angular_momentum_at_hover': 0.05},
    'voltage_sag': {'exponent': 1.3}}


def massless_modules(**changes):
    """The robot with modules without mass and inertia, a single rigid body."""
    module = replace(ROBOT.multibody.module, mass=0.0, inertia=np.zeros(3),
                     centre_of_mass=np.zeros(3))
    return replace(ROBOT, multibody=replace(ROBOT.multibody, module=module), **changes)


def immovable():
    """The robot with a very heavy main body and without gravity, as on a test bench."""
    return replace(ROBOT, mass=190.0, inertia=np.full(3, 90.0), gravity=0.0)


def plant(robot=ROBOT, position=HIGH, quaternion=LEVEL, variation=None):
    made = Plant(robot, WORLD, variation)
    made.reset(position, quaternion)
    return made


def acceleration(made, position, quaternion, velocity, rate, tilt, tilt_rate, thrust,
                 command=None):
    """Accelerations (10,) of a state whose tilts are their targets, away from the floor."""
    made.reset(position, quaternion, [*velocity, *rate, *tilt_rate], tilt, thrust)
    if command is not None:     # thrusts [N] to which the rotors are on their way
        made.set_targets(tilt, command)
        made._update()
    return made.data.qacc.copy()


def momenta(made):
    """Linear momentum, angular momentum about the centre of mass, centre of mass."""
    model, data = made.model, made.data
    mujoco.mj_forward(model, data)
    mujoco.mj_subtreeVel(model, data)
    return (model.body_mass.sum() * data.subtree_linvel[1], data.subtree_angmom[1].copy(),
            data.subtree_com[1].copy())
