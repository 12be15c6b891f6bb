"""Model matching: the flown robot moves as the robot of the training would."""

from dataclasses import replace

import numpy as np
import pytest

from beetle_omni_ros.control.base import Command, State
from beetle_omni_ros.control.matching import ModelMatching
from beetle_omni_ros.model import dynamics as model
from beetle_omni_ros.model.parameters import RobotParameters

TRAINED = RobotParameters.load()
STEP, DELAY = 0.01, 0.01
HOVER = np.r_[np.zeros(4), np.full(4, TRAINED.hover_thrust)]


def robot(**effects):
    joints = replace(TRAINED.joints, **effects.pop('joints', {}))
    rotors = replace(TRAINED.rotors, **effects.pop('rotors', {}))
    return replace(TRAINED, joints=joints, rotors=rotors, effects=effects)


def command(stamp, values):
    return Command(stamp, values[:4].copy(), values[4:].copy())


def state(stamp, x, latest):
    return State(stamp, x[model.POSITION], x[model.VELOCITY], x[model.QUATERNION], x[model.RATE],
                 x[model.TILT], x[model.TILT_RATE], stamp, latest)


def wanted(time):
    """Commands (8,) of a policy: moving tilts and thrusts around hover."""
    rng = np.random.default_rng(3)
    waves = np.sin(2 * np.pi * rng.uniform(0.3, 2.0, (8, 3)) * time + rng.uniform(0, 6, (8, 3)))
    return HOVER + np.repeat([0.2, 0.6], 4) * waves.sum(1)


def flown(plant, matching, late=0, settled=60, steps=60):
    """States (K, 25) of a plant whose commands act ``late`` steps later than nominal."""
    advance, x = model.integrator(plant), np.r_[0, 0, 2.0, 0, 0, 0, 0, 0, 0, 1.0, np.zeros(15)]
    x[model.THRUST] = HOVER[4:] / plant.thrust_scale
    latest, states = command(-1.0, np.r_[HOVER[:4], x[model.THRUST]]), []
    for k in range(-settled if matching else 0, 0):     # to hover, with the actuators alone
        matching.observed(state(k * STEP, x, latest))
        latest = matching.sent(command(k * STEP, HOVER))
        x = np.r_[x[:13], latest.tilt, np.zeros(4), latest.thrust]
    queue = [np.r_[latest.tilt, latest.thrust]] * (1 + late)
    for k in range(steps):
        own = command(k * STEP, wanted(k * STEP))
        if matching:
            matching.observed(state(k * STEP, x, latest))
            own = matching.sent(own)
        latest = own
        queue.append(np.r_[own.tilt, own.thrust])
        x = np.array(advance(x, queue.pop(0), np.zeros(10), STEP)).ravel()
        states.append(x)
    return np.array(states)


def apart(states, others):
    """Largest difference of velocity [m/s] and rate [rad/s]."""
    return np.abs(states - others)[:, np.r_[3:6, 10:13]].max()


@pytest.mark.parametrize('other, share', [
    (robot(rotors={'time_constant': 0.13}), 0.05),
    (robot(thrust_coefficient={'scale': 0.85}), 0.001),
    (robot(joints={'kp': 0.25}), 0.3),
    (robot(mass={'mass': 3.5}), 0.2), (robot(inertia={'inertia': (0.09, 0.08, 0.12)}), 0.3),
    (robot(centre_of_mass={'offset': (0.02, -0.015, 0.0)}), 0.1),
    (robot(rotor_drag={'coefficient': 1.2}), 0.7)])
def test_the_flown_robot_moves_as_that_of_the_training(other, share):
    trained = flown(TRAINED, None)
    unmatched = apart(flown(other, None), trained)
    matched = apart(flown(other, ModelMatching(TRAINED, other, DELAY, 10)), trained)
    assert matched < share * unmatched, (matched, unmatched)


def test_equal_robots_get_the_commands_of_the_policy():
    matching = ModelMatching(TRAINED, TRAINED, DELAY, 10)
    seen = state(0.0, np.r_[0, 0, 1.0, 0.1, 0, 0, 0, 0, 0, 1.0, np.zeros(11), HOVER[4:]],
                 command(-STEP, HOVER))
    observed, own = matching.observed(seen), command(0.0, wanted(0.3))
    np.testing.assert_allclose(observed.tilt, seen.tilt, atol=1e-12)
    np.testing.assert_allclose(observed.velocity, seen.velocity, atol=1e-12)
    sent = matching.sent(own)
    np.testing.assert_allclose(np.r_[sent.tilt, sent.thrust], np.r_[own.tilt, own.thrust],
                               atol=1e-9)


def test_with_later_commands_the_policy_observes_the_predicted_state():
    late = robot(command_latency={'delay': 0.03})
    matching = ModelMatching(TRAINED, late, DELAY, 10)
    x = np.r_[0, 0, 1.0, 0.5, 0, 0, 0, 0, 0, 1.0, np.zeros(11), HOVER[4:]]
    observed = matching.observed(state(0.0, x, command(-STEP, HOVER)))
    assert observed.position[0] == pytest.approx(0.5 * 0.03, rel=1e-3)


def test_own_commands_are_recognised_and_those_of_others_stay():
    other = robot(thrust_coefficient={'scale': 0.8})
    matching = ModelMatching(TRAINED, other, DELAY, 10)
    x = np.r_[0, 0, 1.0, 0, 0, 0, 0, 0, 0, 1.0, np.zeros(11), HOVER[4:] / 0.8]
    foreign = command(-STEP, 1.1 * HOVER)
    assert matching.observed(state(0.0, x, foreign)).command is foreign
    own = command(0.0, HOVER)
    sent = matching.sent(own)
    assert sent.thrust == pytest.approx(HOVER[4:] / 0.8, rel=0.02)
    assert matching.observed(state(STEP, x, sent)).command is own


def test_on_standby_the_tilts_are_those_of_the_other_controller():
    matching, x = ModelMatching(TRAINED, robot(mass={'mass': 3.5}), DELAY, 10), np.zeros(25)
    x[[2, 9]], x[model.THRUST] = 1.0, HOVER[4:]
    x[model.TILT] = 0.5, -0.5, 0.5, 0.2
    flown = np.r_[x[model.TILT], HOVER[4:]]
    for k in range(50):     # its own commands, with changes of the tilts, are not flown
        seen = state(k * STEP, x, command((k - 1) * STEP, flown))
        np.testing.assert_allclose(matching.observed(seen).tilt, seen.tilt, atol=1e-9)
        assert matching.sent(command(k * STEP, flown)).tilt != pytest.approx(flown[:4], abs=1e-3)


def test_commands_stay_within_the_limits_of_the_flown_robot():
    weak = robot(thrust_coefficient={'scale': 0.5}, mass={'mass': 6.0})
    matching = ModelMatching(TRAINED, weak, DELAY, 10)
    x = np.r_[0, 0, 1.0, 0, 0, 0, 0, 0, 0, 1.0, np.zeros(11), HOVER[4:]]
    matching.observed(state(0.0, x, command(-STEP, HOVER)))
    sent = matching.sent(command(0.0, np.r_[np.full(4, 9.0), np.full(4, 19.0)]))
    assert sent.thrust.max() <= weak.rotors.thrust_max
    assert np.abs(sent.tilt).max() <= weak.joints.position_limit
