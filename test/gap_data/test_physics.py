"""The robot of the blind flights against closed forms, and its tracking of references."""

from gap_data.courses import RATE
from gap_data.flight import fly, LostFlight
from gap_data.hidden import Hidden
from gap_data.plant import Plant
from gap_data.truth import Robot
import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation


def plant(hidden=None, *, multibody=False, thrust=None, tilt=0.0, **more):
    robot = Robot()
    thrust = [robot.hover_thrust] * 4 if thrust is None else thrust
    return Plant(robot, hidden or Hidden(), multibody=multibody, position=(0, 0, 2),
                 quaternion=(1, 0, 0, 0), tilt=[tilt] * 4, thrust=thrust, **more)


def test_multibody_totals_equal_those_of_the_interface():
    body = plant(multibody=True)
    model, data = body.model, body.data
    mujoco.mj_forward(model, data)
    mass = model.body_mass[1:]
    centre = mass @ data.xipos[1:] / mass.sum()
    inertia = np.zeros((3, 3))
    for m, p, turn, own in zip(mass, data.xipos[1:], data.ximat[1:], model.body_inertia[1:]):
        d, r = p - centre, turn.reshape(3, 3)
        inertia += r @ np.diag(own) @ r.T + m * (d @ d * np.eye(3) - np.outer(d, d))
    assert mass.sum() == pytest.approx(3.0386, abs=1e-4)
    assert centre == pytest.approx([0, 0, 2], abs=1e-5)
    assert inertia == pytest.approx(np.diag([0.0627958, 0.0620796, 0.0948795]), abs=2e-5)


def test_the_step_response_of_a_servo_agrees_with_its_equation():
    body = plant()
    step = 0.05
    body.command(0.0, [step, 0, 0, 0], [body.robot.hover_thrust] * 4)
    angles = []
    for _ in range(80):
        body.step()
        angles.append(body.data.qpos[body._q[0]])
    j, kp, kd = 7.5e-5, 0.3449, 0.0094
    wn, decay = np.sqrt(kp / j), kd / (2 * j)
    wd = np.sqrt(wn ** 2 - decay ** 2)
    t = 0.001 * np.arange(1, 81)
    closed = step * (1 - np.exp(-decay * t) * (np.cos(wd * t) + decay / wd * np.sin(wd * t)))
    assert angles == pytest.approx(closed, abs=2e-6)


def test_thrust_acts_along_the_tilted_rotor():
    angle = 0.4
    for rotor, yaw in enumerate(np.radians([45, 135, 225, -45])):
        thrust = np.eye(4)[rotor] * 6.0
        body = plant(thrust=thrust, tilt=angle)
        body.command(0.0, [angle] * 4, thrust)
        body.step()
        axis = Rotation.from_rotvec(angle * np.array([np.cos(yaw), np.sin(yaw), 0])).apply(
            [0, 0, 6.0])
        torque = np.cross(body.robot.positions[rotor], axis) \
            - body.robot.spin[rotor] * 0.0165 * axis
        assert body.data.ctrl[:6] == pytest.approx([*axis, *torque], abs=1e-9)


def test_a_command_acts_after_its_age_and_delay():
    body = plant(hidden=Hidden(thrust_delay=0.02), command_age=0.01)
    body.command(0.0, [0.1] * 4, [9.0] * 4)
    for _ in range(30):
        body.step()
    assert body.rotors.thrust[0] == pytest.approx(body.robot.hover_thrust)
    body.step()
    assert body.rotors.thrust[0] > body.robot.hover_thrust
    assert body.data.qpos[body._q[0]] > 0.005  # the tilt had begun to move 20 ms before


HARD = {'multibody': True, 'gust': True, 'conditions': 'published'}
CLEAN = {'multibody': False, 'gust': False, 'conditions': 'nominal'}


def flown(kind, seconds, difficulty, robot=None):
    return fly(robot or Robot(), Hidden(), kind=kind, duration=seconds, seed=2, **difficulty)


@pytest.mark.parametrize('kind', ['poses', 'lemniscate', 'hover'])
def test_the_controller_tracks_its_reference(kind):
    truth = flown(kind, 8.0, HARD)
    every = int(round(1 / RATE / 0.001))
    rows = len(truth.t) // every
    error = truth.columns['position'][::every] - truth.course.position[:rows]
    assert np.sqrt((error ** 2).sum(axis=1).mean()) < 0.2
    assert truth.command_thrust.min() >= 0.3 and truth.command_thrust.max() <= 20.0
    assert np.abs(truth.columns['tilt']).max() < 3.96


def test_a_robot_that_cannot_fly_gives_a_lost_flight():
    robot = Robot()
    robot.thrust_scale = np.full(4, 0.3)
    with pytest.raises(LostFlight, match='poses flight, seed 2'):
        flown('poses', 5.0, CLEAN, robot)


def test_a_hidden_effect_appears_in_flight_with_its_size():
    # the accelerometer gives the thrust along the body axes for any controller
    robot = Robot()
    robot.thrust_scale = np.full(4, 0.92)
    truth = flown('poses', 6.0, CLEAN, robot=robot)
    tilt, thrust = truth.columns['tilt'], truth.columns['thrust']
    lift = (thrust * np.cos(tilt)).sum(axis=1) / robot.mass
    slope = lift @ truth.columns['specific_force'][:, 2] / (lift @ lift)
    assert slope == pytest.approx(0.92, abs=2e-3)
