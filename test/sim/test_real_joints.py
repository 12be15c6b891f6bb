"""Joints as in measured logs: friction that holds, play, encoder errors, servos that differ."""

from dataclasses import replace

import numpy as np
import pytest
from sim_robots import plant, ROBOT, WORLD

from beetle_omni_ros.model.servo import NUMPY, Servo, Step

KP, TICK = ROBOT.joints.kp, WORLD.tick


def flown(targets, thrust=0.0, **effects):
    """Encoder angles (K, 4), true tilts (K, 4) and the plant after commands (K, 4)."""
    # In free fall the modules load no joint.
    made = plant(replace(ROBOT, effects=effects), [0.0, 0.0, 500.0])
    encoder, tilt = np.empty((2, *targets.shape))
    for k, target in enumerate(targets):
        made.set_targets(target, np.full(4, thrust))
        made.step()
        encoder[k], tilt[k] = made.encoder, made.tilt
    return encoder, tilt, made


def ticks(duration):
    return np.arange(0.0, duration, TICK)


def test_servos_with_friction_move_as_the_servo_model():
    gains, damping = (0.18, 0.16, 0.2, 0.22), (0.0042, 0.004, 0.005, 0.0045)
    coulomb = (0.002, 0.004, 0.003, 0.001)
    t = ticks(3.0)
    targets = np.tile(0.8 * np.sin(2 * np.pi * 0.8 * t)[:, None], (1, 4))
    encoder, _, _ = flown(targets, joint_bandwidth={'kp': gains, 'kd': damping},
                          joint_friction={'coulomb': coulomb, 'stiction': coulomb})
    step = Step(NUMPY, Servo(ROBOT.joints.inertia, np.array(gains), np.array(damping),
                             ROBOT.joints.velocity_limit, coulomb=np.array(coulomb),
                             stiction=np.array(coulomb)), TICK)
    q, v, model = np.zeros(4), np.zeros(4), np.empty_like(encoder)
    for k, target in enumerate(targets):
        q, v = step(target, q, v)
        model[k] = q
    # The free body turns a little against the modules, which the servo model does not have.
    assert np.sqrt(np.mean((encoder - model)**2)) < 2e-3
    assert np.ptp(encoder[-1]) > 0.005          # each servo is its own


@pytest.mark.parametrize('at_encoder', [0.0, 1.0])
def test_the_rotor_follows_behind_the_play(at_encoder):
    gap, t = 0.03, ticks(4.0)
    targets = np.tile(0.3 * np.sin(2 * np.pi * 0.5 * t)[:, None], (1, 4))
    encoder, tilt, made = flown(targets, thrust=6.0,
                                joint_backlash={'gap': gap, 'at_encoder': at_encoder})
    free, _, _ = flown(targets, thrust=6.0)
    lag = (encoder if not at_encoder else free) - tilt
    assert np.abs(lag).max() == pytest.approx(gap / 2, abs=2e-3)
    assert at_encoder == float(np.array_equal(encoder, tilt))
    # The thrust acts along the true tilts.
    along, wrong = (made.thrust @ (np.cos(angle)[:, None] * [0, 0, 1.0] + np.sin(angle)[:, None]
                                    * np.cross(ROBOT.tilt_axes, [0, 0, 1.0])) / ROBOT.mass
                    for angle in (tilt[-1], encoder[-1]))
    if not at_encoder and np.abs(along - wrong).max() > 1e-3:
        felt = made.specific_force
        assert np.linalg.norm(felt - along) < np.linalg.norm(felt - wrong)


def test_readings_of_erring_encoders_are_corrected():
    robot = replace(ROBOT, effects={'joint_encoder_error': {
        'gain': (0.01, 0.0, -0.02, 0.0), 'sine': (0.02, -0.03, 0.0, 0.0),
        'cosine': (0.0, 0.01, 0.02, 0.0)}})
    tilt = np.random.default_rng(0).uniform(-3.9, 3.9, (200, 4))
    read = robot.sensors.encoders(tilt)
    assert np.abs(read - tilt).max() > 0.02
    assert np.allclose(robot.sensors.tilts(read), tilt, atol=1e-5)
