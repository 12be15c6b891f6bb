"""Free runs, and their noise floors with the gusts of each flight."""

from dataclasses import replace

from flights import gusts, KEYS, model, Motion, P, pushed, ROBOT
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from beetle_omni_ros.identify.gap.fit import Problem
from beetle_omni_ros.identify.gap.keys import tolerances
from beetle_omni_ros.identify.gap.noise import Noise
from beetle_omni_ros.identify.gap.residual import THIN
from beetle_omni_ros.identify.gap.rollouts import (
    floor_factors,
    gap,
    HORIZONS,
    noise_floor,
    Runs,
)

HALF = HORIZONS.index(0.5)
MOTION = Motion(7, duration=60.0)
NAMES = [f'wind.force[{k}]' for k in range(3)]
WIDE = dict.fromkeys(NAMES, 4.0)


def made(push):
    flight = model(pushed(MOTION, push))
    flight._mask = np.ones(len(flight._mask))
    return flight


def fitted(*acts_on_body_only, others=()):
    problem = Problem([made(push) for push in acts_on_body_only], KEYS, tolerances(P), P, others)
    problem.state({}, NAMES)
    problem.learn_noise(WIDE)
    return problem


def spread(noise):
    return float(np.linalg.norm(noise.spread['B'][:3]))


def test_every_flight_has_its_own_gusts():
    windy = made(gusts(MOTION, 3, 0.4))
    problem = fitted(gusts(MOTION, 1, 0.1), gusts(MOTION, 2, 0.1), others=[windy])
    *calm, storm = problem.noise_of_each({}, WIDE)
    assert spread(storm) / spread(calm[0]) == pytest.approx(4, rel=0.3)
    assert spread(calm[1]) / spread(calm[0]) == pytest.approx(1, rel=0.3)
    calm, storm = (replace(noise, seen={'B': noise.seen['B'] * ([1] * 3 + [0] * 3)})
                   for noise in (calm[0], storm))     # this motion does not test rotations
    assert noise_floor(windy, storm)[HALF, 1] > 2 * noise_floor(windy, calm)[HALF, 1]


def test_a_force_of_the_catalogue_is_not_counted_as_noise():
    problem = fitted(gusts(MOTION, 1, 0.1), others=[
        made(gusts(MOTION, 3, 0.1) + push) for push in ([0, 0, 0], [0.8, -0.5, 0.0])])
    _, plain, blown = problem.noise_of_each({}, WIDE)
    assert spread(blown) == pytest.approx(spread(plain), rel=0.02)


def runs(error, floor):
    shape = len(HORIZONS), 50, 5
    return Runs(np.full(shape, error), np.full(50, 'hover', object),
                np.full((len(HORIZONS), 5), floor))


def test_a_perfect_model_is_at_the_floor_on_a_windy_day_too():
    trim = floor_factors([runs(0.1, 0.1), runs(0.2, 0.2)])
    assert gap([runs(0.5, 0.5)], HALF, trim=trim) == pytest.approx(1)
    assert floor_factors([runs(3.0, 0.1)]) == pytest.approx(1)      # a bad fit does not raise it
    trim = floor_factors([runs(0.05, 0.1), runs(0.1, 0.2)])
    assert gap([runs(0.5, 0.5)], HALF, trim=trim) == pytest.approx(2)


def test_joints_with_the_spread_of_the_noise_are_at_the_floor():
    keep, drive = 0.9, 0.004
    spread = drive / np.sqrt(1 - keep**2)     # of x' = keep x + e
    flight = made(np.zeros(3))
    noise = Noise({'B': np.ones((6, 1)), 'J': np.tile([1.0, -keep], (4, 1))},
                  {'B': np.zeros(6), 'J': np.full(4, drive)})
    assert noise_floor(flight, noise)[HALF, 4] == pytest.approx(2 * spread, rel=0.02)


def test_unknown_torques_tilt_the_thrust():
    size, step = 0.5, THIN * P.grid * P.body_every
    noise = Noise({'B': np.ones((6, 1)), 'J': np.ones((4, 1))},
                  {'B': np.array([0, 0, 0, *[size] * 3]), 'J': np.zeros(4)})
    floor = noise_floor(made(np.zeros(3)), noise)[HALF]
    rng, reached = np.random.default_rng(5), []
    for _ in range(400):    # a hovering body that rotates, in plain steps
        attitude, (rate, velocity, place) = Rotation.identity(), np.zeros((3, 3))
        for _ in range(round(HORIZONS[HALF] / step)):
            rate = rate + step * size * rng.standard_normal(3)
            attitude = attitude * Rotation.from_rotvec(step * rate)
            force = attitude.apply([0, 0, ROBOT.gravity]) - [0, 0, ROBOT.gravity]
            velocity = velocity + step * force
            place = place + step * velocity
        reached.append([place @ place, velocity @ velocity])
    assert floor[:2] == pytest.approx(np.sqrt(np.mean(reached, axis=0)), rel=0.2)
