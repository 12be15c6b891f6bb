"""
Body effects, added to the readings by an independent formula, are recovered.

The equations of all effects are compared with those of the plant in test/sim/test_agreement.py.
"""

from dataclasses import replace

from flights import KEYS, model, Motion, PLACE, ROBOT, solved
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from beetle_omni_ros.identify.flights.body import BodyModel, tilting_modules
from beetle_omni_ros.identify.flights.keys import all_keys, entries_of, extra_keys
from beetle_omni_ros.model.parameters import RobotParameters

MOTION = Motion()
HOVER = ROBOT.mass * ROBOT.gravity / 4
SPIN, ARMS = ROBOT.rotors.spin, ROBOT.rotors.positions


def on_rotors(force):
    """Force and torque (N, 3) of forces (N, 4, 3) at the rotors."""
    return force.sum(axis=1), sum(np.cross(ARMS[i], force[:, i]) for i in range(4))


def thrust_change(part):
    """Force and torque of a relative change of thrusts (N, 4), with reaction torque."""
    push = (part * MOTION.thrust)[:, :, None] * MOTION.normals
    force, torque = on_rotors(push)
    ratio = ROBOT.rotors.torque_to_thrust_ratio
    return force, torque - ratio * (SPIN[:, None] * push).sum(axis=1)


def speeds():
    return np.sqrt(MOTION.thrust / HOVER)


def split(vectors):
    """Parts along and across the thrust axes (N, 4), (N, 4, 3)."""
    along = (vectors * MOTION.normals).sum(axis=2)
    return along, vectors - along[:, :, None] * MOTION.normals


def total():
    return on_rotors(MOTION.thrust[:, :, None] * MOTION.normals)[0]


def wind(x):
    return MOTION.attitude.inv().apply(x), 0.0


def rotor_drag(x):
    return on_rotors(-x / 4 * speeds()[:, :, None] * split(MOTION.hubs)[1])


def ground_effect(x):
    place = np.stack([MOTION.attitude.apply(arm) for arm in ARMS], axis=1)
    height = np.maximum(MOTION.position[:, None, 2] + place[:, :, 2], 0.08)
    up = np.stack([MOTION.attitude.apply(MOTION.normals[:, i])[:, 2] for i in range(4)], axis=1)
    return thrust_change(x / 16 / height**2 * up**2)


def sag(x):
    return thrust_change(((MOTION.voltage / 25.2)**x - 1)[:, None] * np.ones(4))


def momentum(x):
    """Momentum of the rotors (N, 4, 3), along spin times thrust direction."""
    return x * (SPIN * speeds())[:, :, None] * MOTION.normals


def spin_up(x):
    size = np.gradient(speeds(), 0.005, axis=0)
    return 0.0, -(x * (SPIN * size)[:, :, None] * MOTION.normals).sum(axis=1)


def gyroscopic(x):
    # The rate of change of the rotors' angular momentum in an inertial frame, all at once.
    h = momentum(x).sum(axis=1)
    world = MOTION.attitude.apply(h)
    return 0.0, -MOTION.attitude.inv().apply(np.gradient(world, 0.005, axis=0))


def module(x):
    arms = ROBOT.tilt_axes
    return 0.0, -x * MOTION.tilt_acceleration @ arms


def joint_offset(x):
    turned = np.stack([Rotation.from_rotvec(x * axis).apply(MOTION.normals[:, i])
                       if i == 1 else MOTION.normals[:, i]
                       for i, axis in enumerate(ROBOT.tilt_axes)], axis=1)
    push = MOTION.thrust[:, :, None] * (turned - MOTION.normals)
    force, torque = on_rotors(push)
    return force, torque - ROBOT.rotors.torque_to_thrust_ratio * (SPIN[:, None] * push).sum(axis=1)


def mass(x):
    return total() * (ROBOT.mass / x - 1), 0.0


# One effect of each input of the equations, and each form of a deviation.
CASES = {
    'rotor_drag.coefficient': (rotor_drag, 0.4),
    'ground_effect.gain_at_0.25m': (ground_effect, 0.1), 'voltage_sag.exponent': (sag, 1.4),
    'rotor_thrust_coefficient.scale[2]': (lambda x: thrust_change((x - 1) * np.eye(4)[2]), 0.9),
    'propeller_gyroscopic_torque.angular_momentum_at_hover': (gyroscopic, 0.06),
    'rotor_acceleration_torque.angular_momentum_at_hover': (spin_up, 0.05),
    'module_reaction.module_inertia': (module, 4e-4), 'mass.mass': (mass, 3.3),
    'joint_offset.offset[1]': (joint_offset, 0.05)}


@pytest.fixture(scope='module')
def made():
    return model(MOTION.flight())


def without(made, force, torque):
    """Residual if the readings contain a further force [N] and torque [N m]."""
    size = MOTION.specific_force.shape
    more = np.concatenate([np.broadcast_to(force, size) / ROBOT.mass,
                           np.broadcast_to(torque, size) / ROBOT.inertia], axis=1)
    seen = np.stack([np.interp(made.signals.t, MOTION.t, column) for column in more.T], axis=1)
    return {'B': made.residual({}, 'B')['B'] - seen[made.rows]}


@pytest.mark.parametrize('name', list(CASES))
def test_a_known_value_is_recovered(name, made):
    formula, value = CASES[name]
    found = KEYS[name].value(solved(made, [name], 'B', without(made, *formula(value)))[name])
    assert found == pytest.approx(value, rel=0.01)


def test_a_wind_is_recovered_in_world_axes(made):
    true = np.array([0.6, -1.0, 0.3])
    names = [f'wind.force[{k}]' for k in range(3)]
    found = solved(made, names, 'B', without(made, *wind(true)))
    assert np.allclose([found[name] for name in names], true, rtol=0.01, atol=0.01)


def test_a_wind_velocity_moves_the_drag_and_has_no_key_without_one():
    true, names = np.array([2.0, -3.0, 0.5]), [f'wind_velocity.velocity[{k}]' for k in range(3)]
    assert not set(names) & set(KEYS)
    robot = replace(ROBOT, effects={'rotor_drag': {'coefficient': 0.4}})
    keys = {**all_keys(robot), **extra_keys(robot)}
    made = model(MOTION.flight(), robot, BodyModel(robot, keys, (0.0, 0.0)), keys)
    air = np.tile(MOTION.attitude.inv().apply(true)[:, None], (1, 4, 1))
    more = on_rotors(0.1 * speeds()[:, :, None] * split(air)[1])     # than the drag in still air
    found = solved(made, names, 'B', without(made, *more))
    assert np.allclose([found[name] for name in names], true, rtol=0.01, atol=0.01)


@pytest.mark.parametrize('file', [ROBOT, RobotParameters.load()], ids=['rigid', 'modules'])
def test_what_forces_and_torques_alone_show_is_tested_for_the_answer_of_feedback(file):
    keys = {**all_keys(file), **extra_keys(file)}
    made = model(MOTION.flight(), file, BodyModel(file, keys, tilting_modules(file)), keys)
    shown, tested = list(all_keys(file)), {}
    largest = np.abs(made.linear({}, shown).slopes).max(axis=0)
    for entry in entries_of(all_keys(file)):
        by = largest[:, [shown.index(name) for name in entry.keys]]
        if by[PLACE['B']].any() and not by[PLACE['J']].any():
            tested[entry.label] = entry.in_loop
    assert len(tested) > 20 and all(tested.values()), tested
