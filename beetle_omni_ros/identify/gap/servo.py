"""
Tilt servos simulated from their commands, for many flights' windows and parameter sets at once.

The step is that of :mod:`beetle_omni_ros.robot.servo`, whose friction holds a joint that stands:
a fit must have that, and the smooth model of the controllers must not. Each window begins at the
measured state and has forgotten it when it counts, for a servo's memory is far shorter than the
run-in.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from beetle_omni_ros.identify.gap.keys import friction, MODULES
from beetle_omni_ros.identify.gap.signals import Signals
from beetle_omni_ros.robot.effects import CATALOGUE, ServoTerms
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.robot.servo import NUMPY, Servo, Step


@dataclass(frozen=True)
class Windows:
    """
    What happens to a flight's joints, cut into windows.

    Attributes:
        start: (W, 4) [rad] measured positions at the windows' begins.
        start_rate: (W, 4) [rad/s].
        thrust: (K, W, 4) [N] of each joint's rotor, a value for each step.
        load: (K, W, 4) [N m] torque that motion and gravity put on the joint, for share 1.
        spin: (K, W, 4) [rad/s] torque of the spinning rotor, for each N m s of its momentum.
        step: [s].
        skip: steps of run-in.
        every: steps from one sample to the next.
        undescribed: (K, W, 4) torques of modules that the file does not describe, for each kg m
            of their mass moment and each kg m^2 of their inertia, or nothing.

    """

    start: np.ndarray
    start_rate: np.ndarray
    thrust: np.ndarray
    load: np.ndarray
    spin: np.ndarray
    step: float
    skip: int
    every: int
    undescribed: tuple[np.ndarray, ...] = ()


def simulate(robot: RobotParameters, windows: Windows, targets: np.ndarray,
             sets: list[dict[str, float]], modules: float) -> np.ndarray:
    """
    Free runs.

    Args:
        robot: as believed; its effects count.
        windows: of one flight.
        targets: (P, K, W, 4) [rad] for each set.
        sets: of deviations by key name.
        modules: share of the file's tilting modules.

    Returns:
        (P, M, W, 4) positions [rad] after the run-in.

    """
    def column(name, made=lambda x: x):
        return np.array([made(values.get(name, 0.0)) for values in sets])[:, None, None]

    def each(name):
        return np.concatenate([column(f'{name}[{k}]', np.exp) for k in range(4)], axis=2)

    numbers, acting = _of_effects(robot, column)
    joint, hanging = robot.joints, robot.effects.get(MODULES, {})
    kp = joint.kp * numbers['kp'] * each('servo.kp')
    kd = joint.kd * numbers['kd'] * each('servo.kd')
    speed = joint.velocity_limit * numbers['velocity_limit']
    effort = joint.effort_limit * numbers['effort_limit']
    loads = _loads(windows, hanging, modules, column)

    def terms_at(k):
        made = ServoTerms(targets[:, k], windows.thrust[k], windows.spin[k])
        for act, values in acting:
            act(made, None, **values)
        for torque, size in loads:
            made.load = made.load + size * torque[k]
        return made

    # The clip of the torque matters only where the largest error could meet it.
    reach = kp * np.abs(targets - windows.start).max() * 1.5 + kd * speed
    first = terms_at(0)
    step = Step(NUMPY, Servo(
        joint.inertia * column('swing.ratio', np.exp), kp, kd, speed,
        effort if (effort < reach).any() else None, coulomb=first.coulomb,
        stiction=first.stiction), windows.step)
    q = np.broadcast_to(windows.start, (len(sets), *windows.start.shape)).copy()
    v = np.broadcast_to(windows.start_rate, q.shape).copy()
    shown = np.empty(((targets.shape[1] - windows.skip) // windows.every, *q.shape))
    for k in range(targets.shape[1]):
        if k >= windows.skip and (k - windows.skip) % windows.every == 0:
            index = (k - windows.skip) // windows.every
            if index < len(shown):
                shown[index] = q
        terms = terms_at(k)
        q, v = step(terms.target, q, v, None if np.isscalar(terms.load) else terms.load)
    return shown.transpose(1, 0, 2, 3)


def _of_effects(robot, column):
    """
    What the catalogue changes about servos.

    Returns:
        (name of a number of the joints -> its factors), and (servo equation, its parameters) of
        each effect that acts.

    """
    own = {'joint_friction': dict(zip(('coulomb', 'stiction'), friction(robot), strict=True))}
    numbers: dict[str, np.ndarray] = {}
    acting = []
    for name, effect in CATALOGUE.items():
        numbers |= {key.partition('.')[2]: column(f'{name}.{parameter}', np.exp)
                    for parameter, key in effect.settings.items() if key.startswith('joints.')}
        if effect.servo is None:
            continue
        base = {**robot.effects, **own}.get(name, {})
        values = {p: np.asarray(base.get(p, spec.neutral)) + column(f'{name}.{p}')
                  for p, spec in effect.parameters.items()}
        if effect.apply is None:    # the body's equations bear what a servo does not
            values = {p: np.maximum(x, effect.parameters[p].low) for p, x in values.items()}
        if any(values[p].any() for p in effect.numbers):
            acting.append((effect.servo, values))
    return numbers, acting


def _loads(windows, hanging, modules, column):
    """Torques of unit size on the joints with their sizes, of modules in the file or not."""
    loads = [(windows.load, modules + column('modules.share'))]
    loads += [(torque, hanging.get(name, 0.0) + column(f'{MODULES}.{name}')) for torque, name in
              zip(windows.undescribed, ('mass_moment', 'module_inertia'), strict=False)]
    return [(torque, size) for torque, size in loads if size.any()]


def module_load(signals: Signals, theta: dict[str, float]) -> np.ndarray:
    """Torque of gravity and motion on each joint, from the file's modules (N, 4) [N m]."""
    robot, tilt = signals.robot, signals.joints(theta)[0]
    load = np.zeros_like(tilt)
    parts = robot.multibody
    if parts is None or 'module_reaction' in robot.effects:
        return load
    module, turning = parts.module, signals.imu(theta)[2]
    outward, _, up = module.centre_of_mass
    for i, axis in enumerate(robot.tilt_axes):
        normal = _normal(axis, tilt[:, i:i + 1])
        place = robot.rotors.positions[i] + (outward - module.rotor_offset) * axis \
            + up * normal
        pull = -module.mass * up * np.cross(normal, _felt(signals, theta, place)) @ axis
        load[:, i] = pull - module.inertia[0] * turning @ axis
    return load


def undescribed_load(signals: Signals, theta: dict[str, float]) -> tuple[np.ndarray, ...]:
    """
    Torque on each joint of modules that the file does not describe.

    Returns:
        (N, 4) for each kg m of mass moment, (N, 4) for each kg m^2 of inertia about the joint's
        axis; nothing where the file describes them.

    """
    robot, tilt = signals.robot, signals.joints(theta)[0]
    if robot.multibody is not None:
        return ()
    hanging, turning = np.empty_like(tilt), -signals.imu(theta)[2] @ robot.tilt_axes.T
    for i, axis in enumerate(robot.tilt_axes):
        felt = _felt(signals, theta, robot.rotors.positions[i])
        hanging[:, i] = np.cross(_normal(axis, tilt[:, i:i + 1]), felt) @ axis
    return hanging, turning


def _felt(signals, theta, place):
    """Specific force (N, 3) at a place of the body, in its axes [m/s^2]."""
    force, rate, turning = signals.imu(theta)
    return force + np.cross(turning, place) + np.cross(rate, np.cross(rate, place))


def _normal(axis, tilt):
    """(N, 3) thrust direction of a rotor at tilts (N, 1)."""
    level = np.cross(axis, [0.0, 0.0, 1.0])
    return np.cos(tilt) * [0.0, 0.0, 1.0] + np.sin(tilt) * level


def spin_load(signals: Signals, theta: dict[str, float]) -> np.ndarray:
    """Torque of each rotor on its joint for each N m s of momentum in hover (N, 4) [rad/s]."""
    tilt, rate = signals.joints(theta)[0], signals.imu(theta)[1]
    thrust, robot = signals.thrust(theta)[0], signals.robot
    load = np.empty_like(tilt)
    for i, axis in enumerate(robot.tilt_axes):
        normal = _normal(axis, tilt[:, i:i + 1])
        speed = np.sqrt(np.maximum(thrust[:, i], 0) / robot.hover_thrust)
        load[:, i] = -robot.rotors.spin[i] * speed * (np.cross(rate, normal) @ axis)
    return load
