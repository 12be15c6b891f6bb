"""Each consumer models each effect, ignores it with a reason, or refuses it."""

from dataclasses import replace
from functools import cache

from flights import KEYS, model, Motion
import numpy as np
import pytest

from beetle_omni_ros.control.base import Command
from beetle_omni_ros.control.disturbance import DisturbanceEstimator
from beetle_omni_ros.control.nmpc import NmpcParameters
from beetle_omni_ros.estimation.ekf import ErrorStateEkf, ImuReading, PoseReading
from beetle_omni_ros.estimation.parameters import EkfParameters
from beetle_omni_ros.identify.flights.body import BodyModel
from beetle_omni_ros.identify.flights.keys import all_keys, extra_keys, number_of
from beetle_omni_ros.identify.flights.treatment import TREATMENTS
from beetle_omni_ros.model import dynamics
from beetle_omni_ros.model.allocation import Allocator
from beetle_omni_ros.model.effects import CATALOGUE, ignored
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.sim.parameters import draw, SimulatorParameters
from beetle_omni_ros.sim.simulator import CommandLink, Simulator

ROBOT, WORLD = RobotParameters.load(), SimulatorParameters.load()


def without_effect(name):
    """The robot without an effect; with a drag if it only acts beside one."""
    return replace(ROBOT, effects={'rotor_drag': {'coefficient': 0.4}}) \
        if CATALOGUE[name].beside else ROBOT


def with_effect(name):
    """The robot with an effect of typical size; values of the file decrease by it."""
    values = {}
    for parameter, spec in CATALOGUE[name].parameters.items():
        size = TREATMENTS[name].sizes.get(parameter)
        if size is None:
            values[parameter] = spec.neutral
        elif spec.number:
            values[parameter] = (1 - size.typical) * number_of(ROBOT, spec.number)
        else:
            values[parameter] = np.array(spec.neutral) + size.typical
    return replace(ROBOT, effects=without_effect(name).effects | {name: {
        key: tuple(np.asarray(value).tolist()) if np.ndim(value) else float(value)
        for key, value in values.items()}})


def states(count=30):
    """(count, 25) states and (count, 8) commands, some at the limits of the servos."""
    rng = np.random.default_rng(1)
    x = np.hstack([rng.normal(size=(count, 3)) * 0.3 + [0, 0, 0.5], rng.normal(size=(count, 3)),
                   np.tile([0.1, 0.2, 0.0, np.sqrt(0.95)], (count, 1)),
                   rng.normal(size=(count, 3)), rng.uniform(-1, 1, (count, 4)),
                   rng.uniform(-12, 12, (count, 4)), rng.uniform(4, 12, (count, 4))])
    u = np.hstack([x[:, 13:17] + rng.uniform(-9, 9, (count, 4)), rng.uniform(2, 25, (count, 4))])
    return x, u


def nmpc(robot):
    """Model, limits and delays of the NMPC, its tilt commands, and the allocation."""
    x, u = states()
    derivative = dynamics.full_model(robot)
    settings = NmpcParameters.load()
    estimator = DisturbanceEstimator(robot, settings.disturbance, settings.model.command_delay,
                                     dynamics.integrator(ROBOT))
    allocator = Allocator(robot)
    return [np.array([derivative(a, b, np.zeros(10)) for a, b in zip(x, u)]).ravel(),
            [estimator.delay, estimator.encoder_delay, *settings.actuators(robot)],
            allocator.matrix.ravel(), np.array(allocator.weight).ravel()]


def training(robot):
    """A step of the training's model, and its delays."""
    pytest.importorskip('torch')
    from beetle_omni_ros.train.model import nominal_body, substep
    from beetle_omni_ros.train.parameters import TrainParameters
    from beetle_omni_ros.train.starts import latencies
    x, u = states()
    step, body, parameters = substep(robot, 0.0025), nominal_body(robot), TrainParameters()
    parameters = replace(parameters, random=replace(
        parameters.random, command_latency=np.zeros(2), tilt_latency=np.zeros(2)))
    return [np.array([step(a, b, np.zeros(6), body) for a, b in zip(x, u)]).ravel(),
            np.array(latencies(parameters, robot)).ravel()]


def plant(robot):
    """Readings of the simulated robot after some tilting and thrusting near the ground."""
    made = Simulator(robot, WORLD, seed=2)
    made.reset([0.0, 0.0, 0.6], [0.1, 0.05, 0.0, 1.0])
    read = []
    for k in range(60):
        wave = np.sin(0.35 * k + np.arange(4))
        made.command(Command(made.time, 0.3 * wave if k < 40 else np.full(4, 3.8), 9 + 12 * wave))
        frame = made.step()
        read += [frame.truth.position, frame.truth.tilt, frame.imu.specific_force,
                 frame.imu.angular_velocity, [frame.imu.stamp]]
        read += [[frame.joints.stamp], frame.joints.position] if frame.joints else []
        read += [[frame.mocap.stamp], frame.mocap.quaternion] if frame.mocap else []
    return read


@cache
def samples():
    """Stamps, specific forces, rates and poses of a second of rotation and vibration."""
    t = np.arange(0.005, 1.0, 0.005)
    angle = 0.5 * np.sin(3 * t)
    force = np.stack([np.sin(9 * t), 9.8 * np.sin(angle), 9.8 * np.cos(angle)], axis=1)
    rate = np.stack([1.5 * np.cos(3 * t), 0 * t, 0 * t], axis=1)
    pose = np.stack([np.sin(angle / 2), 0 * t, 0 * t, np.cos(angle / 2)], axis=1)
    return t, force, rate, pose


def estimator(robot):
    """The estimate after those samples."""
    ekf = ErrorStateEkf(EkfParameters.load().of_robot(robot), robot.gravity)
    for k, (t, force, rate, pose) in enumerate(zip(*samples(), strict=True)):
        ekf.imu(ImuReading(t, force, rate))
        if k % 2:
            ekf.pose(PoseReading(t, np.zeros(3), pose))
    found = ekf.estimate
    return [found.position, found.velocity, found.quaternion, found.angular_velocity]


def buses(robot):
    """Delays of tilts and thrusts of one command."""
    link = CommandLink(robot, WORLD.command_timeout, draw(
        'nominal', WORLD, np.random.default_rng(0)).command_delays(robot))
    link.push(Command(0.0, np.ones(4), np.full(4, 5.0)), 0.0)
    acting = []
    for k in range(20):
        link.update(0.005 * k)
        acting += [link.tilt.copy(), link.thrust.copy()]
    return acting


@cache
def flight_model():
    return model(Motion(duration=10.0).flight())


def gap(name):
    """Whether a key of the effect changes the residual."""
    made, own = flight_model(), KEYS
    if CATALOGUE[name].each == 'term' or CATALOGUE[name].beside:    # of what a robot has
        robot = replace(with_effect(name), multibody=None)
        own = {**all_keys(robot), **extra_keys(robot)}
        made = model(Motion(duration=10.0).flight(), robot, BodyModel(robot, own, (0, 0)), own)
    limit = TREATMENTS[name].limit     # beyond this calm flight
    theta = {key.name: np.log(1e-5 if limit else 1 - key.typical) if key.relative
             else key.typical for key in own.values() if key.effect == name and not key.form}
    before, after = made.residual({}), made.residual(theta)
    return any(not np.array_equal(before[group], after[group]) for group in before)


OUTPUTS = {'nmpc': nmpc, 'training': training, 'plant': plant, 'estimator': estimator,
           'buses': buses}


@cache
def plain(consumer, beside=False):
    robot = without_effect('wind_velocity' if beside else 'wind')
    return np.concatenate([np.ravel(part) for part in OUTPUTS[consumer](robot)])


@pytest.mark.parametrize('name', CATALOGUE)
@pytest.mark.parametrize('consumer', OUTPUTS)
def test_a_consumer_applies_an_effect_or_states_why_not(consumer, name):
    reason, robot = ignored(consumer, name), with_effect(name)
    found = np.concatenate([np.ravel(part) for part in OUTPUTS[consumer](robot)])
    before = plain(consumer, bool(CATALOGUE[name].beside))
    changed = found.shape != before.shape or not np.array_equal(found, before)
    assert changed != bool(reason), reason or f'{name} changes nothing'


@pytest.mark.parametrize('name', CATALOGUE)
def test_a_fit_has_a_complete_and_consistent_treatment_of_each_effect(name):
    treatment = TREATMENTS[name]
    assert list(treatment.sizes) == CATALOGUE[name].numbers
    assert treatment.excited_by and treatment.separated_by
    assert all(other in CATALOGUE for other in treatment.confused_with)
    assert set(treatment.channels) <= set('BAWJ') and treatment.channels
    assert all(len(start) == len(treatment.sizes) for start in treatment.starts)
    assert all(size.step > 0 and size.typical > size.smallest > 0
               for size in treatment.sizes.values())


@pytest.mark.parametrize('name', CATALOGUE)
def test_the_gap_finder_applies_every_effect(name):
    assert gap(name) != bool(ignored('gap', name))
