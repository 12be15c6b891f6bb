"""Servos and rotors of the plant have the response of their parameters."""

from dataclasses import replace

import numpy as np
import pytest
from sim_robots import immovable, plant, ROBOT, WORLD

from beetle_omni_ros.identify.flights.servo import simulate, Windows
from beetle_omni_ros.sim.plant import Plant

JOINT = ROBOT.joints
TICK = 0.005


def second_order(time, step):
    """Angle in J q'' = Kp (step - q) - Kd q' from rest, underdamped, in closed form."""
    damping = JOINT.damping_ratio * JOINT.natural_frequency
    ringing = JOINT.natural_frequency * np.sqrt(1 - JOINT.damping_ratio ** 2)
    return step * (1 - np.exp(-damping * time) * (
        np.cos(ringing * time) + damping / ringing * np.sin(ringing * time)))


def test_servo_sags_by_load_over_stiffness():
    """Upward acceleration loads the servo of a module at 90 deg like gravity."""
    made = plant(immovable())
    made.set_targets(np.full(4, np.pi / 2), np.zeros(4))
    acceleration = 9.8
    for _ in range(300):
        made.wrench[2] = 190 * acceleration
        made.step()
    module = ROBOT.multibody.module
    tilt = made.state[0][7:]
    load = -module.mass * acceleration * module.centre_of_mass[2] * np.sin(tilt)
    np.testing.assert_allclose(JOINT.kp * (np.pi / 2 - tilt), load, rtol=2e-3)
    assert np.all(np.pi / 2 - tilt > 0.05)


def test_tilt_rate_stays_at_its_limit():
    made = plant(immovable())
    made.set_targets(np.array([3.0, -3.0, 2.0, 1.5]), np.zeros(4))
    fastest, positions = 0.0, []
    for _ in range(60):
        made.step()
        fastest = np.maximum(fastest, np.abs(made.state[1][6:]))
        positions.append(made.state[0][7])
    np.testing.assert_allclose(fastest, JOINT.velocity_limit, rtol=1e-3)
    cruise = np.diff(positions[10:40]) / TICK
    np.testing.assert_allclose(cruise, JOINT.velocity_limit, rtol=1e-3)
    for _ in range(100):
        made.step()
    np.testing.assert_allclose(made.state[0][7:], [3.0, -3.0, 2.0, 1.5], atol=1e-3)


@pytest.mark.parametrize('friction', [0.0, 0.01])
@pytest.mark.parametrize('gradient', [JOINT.speed_gradient, 0.0])
@pytest.mark.parametrize(('substeps', 'step'), [(5, 1.25e-3), (20, 1.25e-3), (5, 2.5e-4)])
def test_plant_and_gap_turn_loaded_servos_alike_at_their_speed_limit_at_every_step(
        friction, gradient, substeps, step):
    values = {'coulomb': friction, 'stiction': friction}
    robot = replace(immovable(), joints=replace(JOINT, speed_gradient=gradient),
                    effects={'joint_friction': values} if friction else {})
    made = Plant(robot, replace(WORLD, substeps=substeps))
    made.reset((0.0, 0.0, 20.0))
    tilts, fastest = [made.state[0][7:]], 0.0
    for k in range(120):
        made.set_targets(np.array([3.0, -3.0, 2.0, 1.5]) * (k < 80), np.zeros(4))
        made.wrench[2] = 190 * 20.0     # weighs on the servos by their modules
        made.step()
        tilts.append(made.state[0][7:])
        fastest = np.maximum(fastest, np.abs(made.state[1][6:]))
    module, t = robot.multibody.module, step * (np.arange(120 * TICK / step) + 0.5)
    tilt = np.stack([np.interp(t, TICK * np.arange(121), one) for one in np.transpose(tilts)])
    load = -module.mass * 20.0 * module.centre_of_mass[2] * -np.sin(tilt.T[:, None])
    targets = np.array([3.0, -3.0, 2.0, 1.5]) * (t < 80 * TICK)[:, None, None]
    windows = Windows(np.zeros((1, 4)), np.zeros((1, 4)), 0 * load, load, step, 0,
                      round(TICK / step))
    shown = simulate(robot, windows, targets[None], [0], [{}], 1.0)[0, :, 0]
    assert np.abs(fastest - JOINT.velocity_limit).max() > 0.3 * gradient * np.abs(load).max()
    assert np.abs(shown - tilts[:-1]).max() < 3e-3


def test_thrust_follows_first_order_lag_up_and_down():
    made = plant()
    made.set_targets(np.zeros(4), np.array([2.0, 5.0, 10.0, 20.0]))
    for k in range(1, 60):
        made.step()
        expected = np.array([2, 5, 10, 20]) * -np.expm1(-k * TICK / ROBOT.rotors.time_constant)
        np.testing.assert_allclose(made.thrust, expected, rtol=1e-6)
    top = made.thrust
    made.set_targets(np.zeros(4), np.zeros(4))
    for _ in range(20):
        made.step()
    np.testing.assert_allclose(made.thrust, top * np.exp(-0.1 / ROBOT.rotors.time_constant),
                               rtol=1e-6)


def damped(time, rate):
    """Closed form of J q'' = -Kd q' from ``rate``: angle turned and rate left."""
    decay = np.exp(-JOINT.kd / JOINT.inertia * time)
    return rate * JOINT.inertia / JOINT.kd * (1 - decay), rate * decay


def test_a_joint_without_torque_ignores_its_target_and_only_its_damping_slows_it():
    made = plant(immovable())
    made.set_targets(np.full(4, 0.1), np.zeros(4), [True, False, False, True])
    made.data.qvel[6:] = [0.0, 8.0, 30.0, 0.0]      # the last beyond the motor's rate limit
    for k in range(1, 31):
        made.step()
        tilt, rate = made.state[0][7:], made.state[1][6:]
        turned, left = damped(k * TICK, np.array([8.0, 30.0]))
        np.testing.assert_allclose(tilt[1:3], turned, atol=1e-4)
        np.testing.assert_allclose(rate[1:3], left, rtol=1e-2, atol=1e-3)
        np.testing.assert_allclose(tilt[[0, 3]], second_order(k * TICK, 0.1), atol=1e-4)
