"""Every hidden effect has the sign and the size of its label."""

from gap_data.effects import inject, SHAPES
from gap_data.hidden import Hidden, Snapshot
from gap_data.plant import Plant
from gap_data.rotors import Rotors
from gap_data.truth import Robot
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

UP = (0.0, 0.0, 1.0)
HOVER, LOW = Robot().hover_thrust, Robot().positions[0, 2]


def put(name, size, shape='plain', seed=0):
    robot, hidden = Robot(), Hidden()
    label = inject(name, robot, hidden, size, shape, np.random.default_rng(seed))
    return robot, hidden, label


def shapes(name):
    return pytest.mark.parametrize('shape', ['plain', *SHAPES.get(name, ())])


def snapshot(**more):
    s = Snapshot()
    fields = {'t': 0.0, 'position': [0, 0, 2.0], 'quaternion': (1, 0, 0, 0),
              'rotation': tuple(np.eye(3).ravel()), 'velocity_world': (0, 0, 0),
              'velocity': (0, 0, 0), 'rate': (0, 0, 0), 'tilt': [0.0] * 4,
              'tilt_rate': [0.0] * 4, 'thrust': [7.45] * 4, 'thrust_rate': [0.0] * 4,
              'voltage': 25.2, 'command': [7.45] * 4, 'heat': [1.0] * 4, 'axes': [UP] * 4}
    for key, value in (fields | more).items():
        setattr(s, key, value)
    return s


@pytest.mark.parametrize(('name', 'size', 'state', 'speed', 'change'), [
    ('ground_effect', 0.12, {'position': [0, 0, 0.25 - LOW]}, (0, 0, 0), 0.12),
    ('tilt_thrust_loss', 0.08, {'tilt': [np.radians(60)] * 4}, (0, 0, 0), -0.08),
    ('tilt_thrust_loss', 0.08, {'tilt': [-np.radians(60)] * 4}, (0, 0, 0), -0.08),
    ('tilt_thrust_loss', 0.08, {}, (0, 0, 0), 0.0),
    ('axial_inflow', 0.4, {}, (0, 0, 1e-3), -0.4e-3 / HOVER),
    ('translational_lift', 0.08, {}, (1, 0, 0), 0.08 / HOVER),
    ('translational_lift', 0.08, {}, (0, 0, 2), 0.0),
    ('voltage_sag', 1.2, {'voltage': 22.8}, (0, 0, 0), (22.8 / 25.2)**1.2 - 1)])
def test_a_thrust_changes_by_its_label_in_every_shape(name, size, state, speed, change):
    for shape in ('plain', *SHAPES.get(name, ())):
        _, hidden, _ = put(name, size, shape)
        found = np.prod([hook(0, snapshot(**state), HOVER, UP, speed) for hook in hidden.gains])
        assert found - 1 == pytest.approx(change, rel=0.03, abs=1e-9)


@shapes('rotor_drag')
def test_rotor_drag_opposes_motion_in_the_plane(shape):
    robot, hidden, _ = put('rotor_drag', 0.6, shape)
    h = 1e-3
    total = sum(np.array(hook(i, snapshot(), robot.hover_thrust, UP, (h, 0, h))[:3]) / h
                for hook in hidden.wrenches for i in range(4))
    assert total == pytest.approx([-0.6, 0, 0], abs=1e-3)


@shapes('body_drag')
def test_body_drag_at_two_metres_a_second(shape):
    _, hidden, _ = put('body_drag', 0.2, shape)
    v = (0.0, 2.0, 0.0)
    force = np.array(hidden.body[0](snapshot(velocity_world=v, velocity=v))[0])
    assert force == pytest.approx([0, -0.8, 0], rel=0.08)


@shapes('propeller_gyroscopic_torque')
def test_gyroscopic_torque_is_the_change_of_angular_momentum(shape):
    robot, hidden, _ = put('propeller_gyroscopic_torque', 0.05, shape)
    f, rate, turn = robot.hover_thrust, np.array([0.4, -0.7, 0.3]), 2.0
    for i in range(4):
        arm = np.array([*robot.arms[i], 0.0])

        def momentum(t, i=i, arm=arm):
            body = Rotation.from_rotvec(rate * t)
            axis = Rotation.from_rotvec(arm * (0.3 + turn * t)).apply(UP)
            return robot.spin[i] * 0.05 * body.apply(axis)

        axis = Rotation.from_rotvec(arm * 0.3).apply(UP)
        s = snapshot(rate=tuple(rate), tilt_rate=[turn] * 4)
        torque = hidden.wrenches[0](i, s, f, tuple(axis), (0, 0, 0))[3:]
        change = (momentum(1e-5) - momentum(-1e-5)) / 2e-5
        assert torque == pytest.approx(-change, abs=1e-6)


@shapes('rotor_lag')
def test_rotor_lag_delays_thrust_by_its_time_constant(shape):
    robot, hidden, label = put('rotor_lag', 0.03, shape)
    delays = []
    for low, high in ((5.0, 6.0), (6.0, 5.0)):
        rotors = Rotors(robot, hidden, 0.001, [low] * 4)
        lost = sum(high - rotors.advance([high] * 4)[0] for _ in range(3000)) * 0.001
        delays.append(lost / (high - low))
    assert np.mean(delays) == pytest.approx(0.1242, abs=1e-3)
    assert label['time_constant'] == pytest.approx(0.1242)


@shapes('joint_backlash')
def test_backlash_has_the_width_of_its_gap(shape):
    _, hidden, label = put('joint_backlash', 0.04, shape)
    wave = 0.3 * np.sin(2 * np.pi * 2.0 * 0.001 * np.arange(1000))
    errors = np.array([hidden.tilt_errors[0](0, angle, 0.0, snapshot(t=0.001 * k))
                       for k, angle in enumerate(wave)])
    rising = errors[500:600]  # the shaft comes up through zero: the rotor lags below it
    assert rising[-1] == pytest.approx(-0.02, rel=0.12)
    assert np.ptp(errors[250:]) == pytest.approx(0.04, rel=0.12)
    assert label['gap'] == 0.04


def test_mass_and_centre_of_mass_change_the_specific_force():
    for name, size in (('mass', 0.3), ('centre_of_mass', 0.01)):
        robot, hidden, label = put(name, size)
        body = Plant(robot, hidden, multibody=False, position=(0, 0, 5), tilt=[0.0] * 4,
                     quaternion=(1, 0, 0, 0), thrust=[7.0] * 4)
        body.step()
        if name == 'mass':
            assert body.specific_force[2] == pytest.approx(28.0 / label['mass'], rel=1e-3)
    spin_up = body.data.qvel[3:6] / 0.001
    torque = np.cross(-np.array(label['offset']), [0, 0, 28.0])
    # the described rotors' own small asymmetry adds a constant
    torque += np.sum(np.cross(robot.positions, [0, 0, 7.0]), axis=0)
    assert spin_up == pytest.approx(torque / robot.inertia, rel=0.02, abs=0.01)
