"""
Tilt servos simulated from their commands, for many flights' windows and parameter sets at once.

    J q'' = clip(Kp (q* + c f - q) - Kd q', limit) + load - friction

The equations are the catalogue's; friction here holds a joint that stands, which a fit must have
and the smooth model of the controllers must not. Each window begins at the measured state and
has forgotten it when it counts, for a servo's memory is far shorter than the run-in.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from beetle_omni_ros.identify.gap.keys import GYROSCOPIC, MODULES
from beetle_omni_ros.robot.effects_actuator import SLIDING_RATE
from beetle_omni_ros.robot.parameters import JointParameters


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
    inertia = joint.inertia * column('swing.ratio', np.exp)
    damping = 0.5 * h * kd / inertia
    keep, gain = (1 - damping) / (1 + damping), h / inertia / (1 + damping)
    sliding, more = coulomb * gain, (stiction - coulomb) * gain
    rubs, bends, loaded = sliding.any() or more.any(), soft.any(), share.any()
    spins = momentum.any()
    # The clip of the torque matters only where the largest error could meet it.
    reach = kp * np.abs(targets - windows.start).max() * 1.5 + kd * speed
    weak, kick = bool((effort < reach).any()), h * effort / inertia
    count = targets.shape[1]
    q = np.broadcast_to(windows.start, (len(sets), *windows.start.shape)).copy()
    v = np.broadcast_to(windows.start_rate, q.shape).copy()
    shown = np.empty(((count - windows.skip) // windows.every, *q.shape))
    stiff = kp * gain
    for k in range(count):
        if k >= windows.skip and (k - windows.skip) % windows.every == 0:
            index = (k - windows.skip) // windows.every
            if index < len(shown):
                shown[index] = q
        q += 0.5 * h * v
        error = targets[:, k] - q
        if bends:
            error += soft * windows.thrust[k]
        force = stiff * error
        if loaded:
            force += gain * share * windows.load[k]
        for torque, size in hanging:
            force += gain * size * torque[k]
        if spins:
            force += gain * momentum * windows.spin[k]
        if weak:
            change = (keep - 1) * v + force
            new = v + np.minimum(np.maximum(change, -kick), kick)
        else:
            new = keep * v + force
        if rubs:
            friction = sliding + more * np.exp(-(v / SLIDING_RATE)**2)
            new -= np.minimum(np.maximum(new, -friction), friction)
        v = np.minimum(np.maximum(new, -speed), speed)
        q += 0.5 * h * v
    return shown.transpose(1, 0, 2, 3)
