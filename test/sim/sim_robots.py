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
