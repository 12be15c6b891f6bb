"""The blind flights: tracking, excitation, and reports of lost flights."""

from gap_data.courses import RATE
from gap_data.flight import fly, LostFlight
from gap_data.hidden import Hidden
from gap_data.truth import Robot
import numpy as np
import pytest

HARD = {'multibody': True, 'gust': True, 'conditions': 'published'}
CLEAN = {'multibody': False, 'gust': False, 'conditions': 'nominal'}


def flown(kind, seconds, difficulty, robot=None, hidden=None):
    return fly(robot or Robot.nominal(), hidden or Hidden(), kind=kind, duration=seconds, seed=2,
               command_age=0.01, **difficulty)


@pytest.mark.parametrize('difficulty', [CLEAN, HARD], ids=['clean', 'hard'])
@pytest.mark.parametrize('kind', ['poses', 'lemniscate', 'hover'])
def test_the_controller_tracks_its_reference(kind, difficulty):
    truth = flown(kind, 8.0, difficulty)
    every = int(round(1 / RATE / 0.001))
    rows = len(truth.t) // every
    error = truth.columns['position'][::every] - truth.course.position[:rows]
    assert np.sqrt((error ** 2).sum(axis=1).mean()) < 0.2
    assert truth.command_thrust.min() >= 0.3 and truth.command_thrust.max() <= 20.0
    assert np.abs(truth.columns['tilt']).max() < 3.96


def test_a_robot_that_cannot_fly_gives_a_lost_flight():
    robot = Robot.nominal()
    robot.thrust_scale = np.full(4, 0.3)
    with pytest.raises(LostFlight, match='poses flight, seed 2'):
        fly(robot, Hidden(), kind='poses', duration=5.0, seed=2, command_age=0.0, **CLEAN)


def test_a_hidden_effect_appears_in_flight_with_its_size():
    # the accelerometer gives the thrust along the body axes for any controller
    robot = Robot.nominal()
    robot.thrust_scale = np.full(4, 0.92)
    truth = flown('poses', 6.0, CLEAN, robot=robot)
    tilt, thrust = truth.columns['tilt'], truth.columns['thrust']
    lift = (thrust * np.cos(tilt)).sum(axis=1) / robot.mass
    slope = lift @ truth.columns['specific_force'][:, 2] / (lift @ lift)
    assert slope == pytest.approx(0.92, abs=2e-3)
