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

from beetle_omni_ros.identify.gap.keys import GYROSCOPIC, MODULES
from beetle_omni_ros.robot.parameters import JointParameters
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


def simulate(joint: JointParameters, windows: Windows, targets: np.ndarray,
             sets: list[dict[str, float]], base: dict[str, float]) -> np.ndarray:
    """
    Free runs.

    Args:
        joint: the servo as believed.
        windows: of one flight.
        targets: (P, K, W, 4) [rad] for each set.
        sets: of deviations by key name.
        base: values of the robot file's own effects: coulomb, stiction, deflection, mass_moment,
            module_inertia, momentum and joint_share; share of its modules.

    Returns:
        (P, M, W, 4) positions [rad] after the run-in.

    """
    def column(name, made=lambda x: x):
        return np.array([made(values.get(name, 0.0)) for values in sets])[:, None, None]

    def each(name):
        return np.concatenate([column(f'{name}[{k}]', np.exp) for k in range(4)], axis=2)

    h = windows.step
    kp = joint.kp * column('joint_bandwidth.kp', np.exp) * each('servo.kp')
    kd = joint.kd * column('joint_bandwidth.kd', np.exp) * each('servo.kd')
    speed = joint.velocity_limit * column('joint_velocity_limit.velocity_limit', np.exp)
    effort = joint.effort_limit * column('joint_torque_limit.effort_limit', np.exp)
    coulomb = base['coulomb'] + column('joint_friction.coulomb', lambda x: max(x, 0.0))
    stiction = base['stiction'] + column('joint_friction.stiction', lambda x: max(x, 0.0))
    soft = base['deflection'] + column('joint_deflection.deflection_per_newton')
    share = base['modules'] + column('modules.share')
    momentum = (base['momentum'] + column(f'{GYROSCOPIC}.angular_momentum_at_hover')) * (
        base['joint_share'] + column(f'{GYROSCOPIC}.joint_share'))
    hanging = [(torque, base[name] + column(f'{MODULES}.{name}')) for torque, name in
               zip(windows.undescribed, ('mass_moment', 'module_inertia'), strict=False)]
    hanging = [(torque, size) for torque, size in hanging if size.any()]
    rubs, loaded = coulomb.any() or (stiction - coulomb).any(), share.any()
    # The clip of the torque matters only where the largest error could meet it.
    reach = kp * np.abs(targets - windows.start).max() * 1.5 + kd * speed
    step = Step(NUMPY, Servo(
        joint.inertia * column('swing.ratio', np.exp), kp, kd, speed,
        effort if (effort < reach).any() else None,
        coulomb=coulomb if rubs else None, stiction=stiction), h)
    loads = [(windows.load, share)] if loaded else []
    loads += hanging + ([(windows.spin, momentum)] if momentum.any() else [])
    count = targets.shape[1]
    q = np.broadcast_to(windows.start, (len(sets), *windows.start.shape)).copy()
    v = np.broadcast_to(windows.start_rate, q.shape).copy()
    shown = np.empty(((count - windows.skip) // windows.every, *q.shape))
    for k in range(count):
        if k >= windows.skip and (k - windows.skip) % windows.every == 0:
            index = (k - windows.skip) // windows.every
            if index < len(shown):
                shown[index] = q
        target = targets[:, k]
        if soft.any():
            target = target + soft * windows.thrust[k]
        load = sum((size * torque[k] for torque, size in loads[1:]),
                   loads[0][1] * loads[0][0][k]) if loads else None
        q, v = step(target, q, v, load)
    return shown.transpose(1, 0, 2, 3)
