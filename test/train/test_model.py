"""One control period of the training's model, against finer integration and against MuJoCo."""

from dataclasses import replace

from learning import ROBOT
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from sim_robots import plant, WORLD

from beetle_omni_ros.control.policy_file import robot_hash, TRAINED_FOR
from beetle_omni_ros.model import dynamics
from beetle_omni_ros.model.allocation import Allocator
from beetle_omni_ros.train import model

PERIOD, SUBSTEPS = 0.01, 4
RIGID = replace(ROBOT, multibody=None)
UNITS = {'position': slice(0, 3), 'velocity': slice(3, 6), 'quaternion': slice(6, 10),
         'rate': slice(10, 13), 'tilt': slice(13, 17), 'tilt_rate': slice(17, 21),
         'thrust': slice(21, 25)}


def states(count, seed, *, tilt_step, joint_rate=0.0):
    """Random flight states and commands: tilt targets within a step from the tilts."""
    rng = np.random.default_rng(seed)
    tilt = rng.uniform(-3.8, 3.8, (count, 4))
    x = np.hstack([rng.normal(size=(count, 6)), Rotation.random(count, rng).as_quat(),
                   rng.normal(size=(count, 3)), tilt,
                   joint_rate * rng.uniform(-1, 1, (count, 4)), rng.uniform(1, 19, (count, 4))])
    u = np.hstack([tilt + tilt_step * rng.uniform(-1, 1, (count, 4)),
                   rng.uniform(-2, 22, (count, 4))])
    return x, u


def trained(robot, x, u, duration=PERIOD, wrench=None):
    """As the environment steps it."""
    step = model.substep(robot, PERIOD / SUBSTEPS).map(len(x))
    wrench = np.zeros((len(x), 6)) if wrench is None else wrench
    body = np.tile(model.nominal_body(robot), (len(x), 1))
    for _ in range(round(duration / PERIOD * SUBSTEPS)):
        x = np.array(step(x.T, u.T, wrench.T, body.T)).T
    return x


def assert_close(ours, theirs, **tolerances):
    for name, tolerance in tolerances.items():
        difference = np.abs(ours[:, UNITS[name]] - theirs[:, UNITS[name]]).max()
        assert difference <= tolerance, f'{name}: {difference:.2g}, more than {tolerance}'


def test_one_period_agrees_with_the_dynamics_away_from_servo_limits():
    x, u = states(100, 0, tilt_step=0.05)
    fine = np.array(dynamics.integrator(RIGID, 200).map(100)(
        x.T, u.T, np.zeros((10, 100)), PERIOD)).T
    assert np.abs(fine[:, UNITS['tilt_rate']]).max() < 0.5 * ROBOT.joints.velocity_limit
    assert_close(trained(RIGID, x, u), fine, position=5e-6, velocity=1e-3, quaternion=1e-5,
                 rate=4e-3, tilt=1e-3, tilt_rate=0.1, thrust=1e-9)


def test_a_wrench_and_another_mass_agree_with_newton():
    x, u = states(20, 5, tilt_step=0.0)
    x[:, UNITS['rate']] = 0
    step = model.substep(RIGID, 0.001).map(20)
    body = np.tile(model.nominal_body(RIGID), (20, 1))
    force, torque = np.array([3.0, -2.0, 1.0]), np.array([0.05, 0.02, -0.03])
    wrench = np.tile(np.r_[force, torque], (20, 1))

    def after(wrench, body):
        return np.array(step(x.T, u.T, wrench.T, body.T)).T

    change = after(wrench, body) - after(0 * wrench, body)
    np.testing.assert_allclose(change[:, 3:6], np.tile(1e-3 * force / ROBOT.mass, (20, 1)),
                               rtol=1e-9)
    np.testing.assert_allclose(change[:, 10:13], np.tile(1e-3 * torque / ROBOT.inertia, (20, 1)),
                               rtol=1e-6)
    heavy = body.copy()
    heavy[:, 0] *= 2
    gravity = np.array([0, 0, -ROBOT.gravity])
    np.testing.assert_allclose(
        2 * (after(0 * wrench, heavy)[:, 3:6] - x[:, 3:6] - 1e-3 * gravity),
        after(0 * wrench, body)[:, 3:6] - x[:, 3:6] - 1e-3 * gravity, atol=1e-12)


def test_reaction_parameters_are_those_of_the_modules():
    module = replace(ROBOT.multibody.module, mass=0.4, inertia=np.array([2e-4, 9.0, 9.0]),
                     centre_of_mass=np.array([0.1, 0.0, -0.03]))
    robot = replace(ROBOT, multibody=replace(ROBOT.multibody, module=module))
    found = model.module_reaction(robot)
    assert found['module_inertia'] == pytest.approx(2e-4 + 0.4 * 0.03 ** 2)    # Steiner
    assert found['mass_moment'] == pytest.approx(0.4 * 0.03)


def hovering(count, seed, tilt_step, thrust_step):
    """States near hover at random attitudes, and commands near those that hover."""
    x, _ = states(count, seed, tilt_step=0.0)
    rng = np.random.default_rng(seed)
    pull = Rotation.from_quat(x[:, 6:10]).inv().apply([0, 0, ROBOT.mass * ROBOT.gravity])
    parts = (pull @ Allocator(ROBOT).inverse[:, :3].T).reshape(count, 4, 2)
    x[:, :3] = 0
    x[:, 3:6] *= 0.3
    x[:, 10:13] *= 0.3
    x[:, 13:17] = np.arctan2(parts[:, :, 1], parts[:, :, 0])
    x[:, 21:25] = np.linalg.norm(parts, axis=2)
    u = np.hstack([x[:, 13:17] + tilt_step * rng.uniform(-1, 1, (count, 4)),
                   np.clip(x[:, 21:25] + thrust_step * rng.uniform(-1, 1, (count, 4)), 0, 20)])
    return x, u


def flown(x, u, duration):
    """MuJoCo's multibody plant from the same states under the same commands."""
    height, made, after = np.array([0.0, 0.0, 20.0]), plant(), np.empty_like(x)
    for k, (state, command) in enumerate(zip(x, u)):
        made.reset(height, state[6:10])
        data = made.data
        data.qvel[:] = np.r_[state[3:6], state[10:13], state[17:21]]
        data.qpos[7:], data.act[:] = state[13:17], state[21:25]
        made.set_targets(command[:4], command[4:])
        made._update()
        for _ in range(round(duration / WORLD.tick)):
            made.step()
        q, v = made.state
        after[k] = np.r_[q[:3] - height, v[:3], q[[4, 5, 6, 3]], v[3:6], q[7:], v[6:], made.thrust]
    return after


def angle(a, b):
    """Angle between quaternions."""
    return (Rotation.from_quat(a).inv() * Rotation.from_quat(b)).magnitude()


def rms(values):
    return np.sqrt((values ** 2).mean())


@pytest.mark.parametrize(('tilt_step', 'thrust_step'), [(0.0, 0.0), (0.3, 2.0)])
def test_training_physics_are_those_of_the_multibody_plant(tilt_step, thrust_step):
    x, u = hovering(40, 6, tilt_step, thrust_step)
    true = flown(x, u, 0.05)
    with_modules, without = (trained(robot, x, u, 0.05) for robot in (ROBOT, RIGID))
    # In MuJoCo the motion of the body also loads the servos, which changes tilts by a degree.
    assert_close(with_modules, true, position=1e-3, velocity=0.01, rate=0.1, tilt=0.05,
                 thrust=1e-6)
    assert angle(with_modules[:, 6:10], true[:, 6:10]).max() < 0.01
    rate = UNITS['rate']
    assert rms(with_modules[:, rate] - true[:, rate]) < 0.5 * rms(without[:, rate] - true[:, rate])
    ours, theirs = (rms(angle(x[:, 6:10], true[:, 6:10])) for x in (with_modules, without))
    assert ours < theirs * (0.3 if tilt_step == 0 else 0.95)


def trained_with(robot):
    """Model of the training environment and its nominal quantities."""
    return model.substep(robot, 0.0025).serialize(), tuple(model.nominal_body(robot))


def with_value(part, path, change):
    """``part`` with the value at a dotted path changed."""
    name, _, rest = path.partition('.')
    old = getattr(part, name)
    return replace(part, **{name: with_value(old, rest, change) if rest else change(old)})


@pytest.mark.parametrize('key', [key for key in TRAINED_FOR if key != 'effects'] + [
    'battery.resistance', 'multibody.end_effector.mass', 'multibody.module.joint_height',
    'multibody.module.rotor_offset', 'rotors.map'])
def test_the_hash_of_a_policy_covers_what_its_training_environment_uses(key):
    changes = {'rotors.spin': lambda value: -value, 'rotors.map': lambda value: value[1:]}
    robot = with_value(ROBOT, key, changes.get(key, lambda value: value * 1.001 + 1e-6))
    assert (robot_hash(robot) != robot_hash(ROBOT)) == (key in TRAINED_FOR)
    assert (trained_with(robot) != trained_with(ROBOT)) == (key in TRAINED_FOR)
