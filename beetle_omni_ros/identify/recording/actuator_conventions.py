"""
Units, signs and orders of commands and encoders.

Encoders follow tilt commands, and thrust commands accelerate the body. The hypotheses are
weighted as in :mod:`~beetle_omni_ros.identify.recording.conventions`.
"""

from itertools import permutations, product

import numpy as np

from beetle_omni_ros.identify.gap.bags import Recording
from beetle_omni_ros.identify.recording.damage import (
    CERTAIN,
    columns_changed,
    Damage,
    FLOOR,
    MOST_CERTAIN,
    PRIOR,
)
from beetle_omni_ros.identify.recording.limits import RecordingLimits
from beetle_omni_ros.identify.recording.motion import Motion
from beetle_omni_ros.robot.parameters import RobotParameters

ANGLE_UNITS = {1.0: '', 180 / np.pi: 'in degrees, not radians',
               4096 / (2 * np.pi): 'in encoder counts, not radians',
               np.pi / 180: 'turned into radians twice', 1 / (2 * np.pi): 'in turns, not radians'}
THRUST_UNITS = {1e3: 'in millinewtons, not N', 1e3 / 9.80665: 'in grams, not N',
                1 / 9.80665: 'in kilograms, not N', 5.0: 'in percent of the largest thrust, not N',
                0.05: 'in parts of the largest thrust, not N'}


def joint_damages(recording: Recording, m: Motion, robot: RobotParameters,
                  limits: RecordingLimits) -> list[Damage]:
    """Contradictions between encoders and tilt commands."""
    commanded, read = (x - x.mean(axis=0) for x in (m.tilt_command, m.tilt))
    count, limit = 0.5 * len(m.t), robot.joints.position_limit
    rate = np.sqrt((np.gradient(commanded, m.t, axis=0)**2).mean(axis=0))
    moving = (rate > limits.least_motion[2]) | (np.ptp(read, axis=0) > 2 * limit)
    units, swaps, signs, unlike = [], [], [], []
    for i in np.flatnonzero(moving):
        total = (read[:, i]**2).sum()
        usual = ((read[:, i] - commanded[:, i])**2).sum()
        if usual < (1 - limits.least_agreement) * max(total, (commanded[:, i]**2).sum()):
            continue
        tried = []
        for j, (unit, sign) in product(range(4), product(
                {*ANGLE_UNITS, *(1 / u for u in ANGLE_UNITS)}, (1, -1))):
            left = ((read[:, i] - sign * unit * commanded[:, j])**2).sum() / max(total, 1e-12)
            price = PRIOR * ((j != i) + (unit != 1.0) + (sign < 0))
            tried.append((-0.5 * count * np.log(max(left, FLOOR)) - price, j, unit, sign, left))
        tried.sort(key=lambda one: -one[0])
        weight = np.exp(np.array([one[0] for one in tried]) - tried[0][0])
        sure = float(min(1 / weight.sum(), MOST_CERTAIN))
        _, j, unit, sign, left = tried[0]
        if left > 1 - limits.least_agreement:
            unlike.append((i, sure))
        elif unit != 1.0:
            units.append((i, unit, sure))
        elif j != i:
            swaps.append((i, j, sure))
        elif sign < 0:
            signs.append((i, sure))
    return _joint_damages_of(recording, m, robot, units, swaps, signs, unlike)


def _joint_damages_of(recording, m, robot, units, swaps, signs, unlike):
    def damage(topic, cause, sure, fix=None, repair=None):
        can = fix and sure >= CERTAIN
        return [Damage(recording.name, topic, cause, None, sure, fix if can else None,
                       repair if can else None)]

    if units:
        i, unit, sure = units[0]
        limit = 2 * robot.joints.position_limit
        odd = 'command' if np.ptp(m.tilt_command[:, i]) > limit else 'joint_states'
        topic = odd if unit != 1.0 else 'joint_states'
        ratio = unit if topic == 'joint_states' else 1 / unit
        words = ANGLE_UNITS.get(min(ANGLE_UNITS, key=lambda u: abs(np.log(u / ratio))), '')
        what = 'encoders turn' if topic == 'joint_states' else 'tilt commands turn'
        other = 'tilt commands' if topic == 'joint_states' else 'encoders'
        return damage(topic, f'{what} {ratio:.4g} times as far as the {other}: {words}?', sure,
                      'scale the angles', columns_changed(0, 4, lambda v: v / ratio, topic))
    if swaps:
        sure = min(s for *_, s in swaps)
        text = ', '.join(f'gimbal{i + 1} moves as gimbal{j + 1} is commanded'
                         for i, j, _ in swaps)
        order = np.arange(4)
        for i, j, _ in swaps:
            order[j] = i
        whole = sorted(order) == [0, 1, 2, 3]
        return damage('joint_states', f'joints are swapped: {text}', sure,
                      'exchange the joints' if whole else None,
                      columns_changed(0, 4, lambda v: v[:, order], 'joint_states'))
    if signs:
        sure = min(s for _, s in signs)
        names = ', '.join(f'gimbal{i + 1}' for i, _ in signs)
        flip = np.ones(4)
        flip[[i for i, _ in signs]] = -1
        return damage('joint_states', f'{names} turns against its command: the sign of the '
                      'encoder or of the command is reversed', sure, 'reverse the sign',
                      columns_changed(0, 4, lambda v: v * flip, 'joint_states'))
    if unlike:
        names = ', '.join(f'gimbal{i + 1}' for i, _ in unlike)
        return damage('joint_states', f'{names} does not follow its command: encoder, servo, or '
                      'the commands of another flight', 0.9)
    return []


def thrust_damages(recording: Recording, m: Motion, robot: RobotParameters,
                   limits: RecordingLimits) -> list[Damage]:
    """Contradictions between thrust commands and the accelerometer."""
    pushed, felt = (np.linalg.norm(x, axis=1) for x in (m.thrust_force, m.force))
    scale = float((pushed * felt).sum() / max((felt**2).sum(), 1e-12))
    unit = min(THRUST_UNITS, key=lambda u: abs(np.log(max(scale, 1e-9) / u)))
    # Thrusts and accelerometer agree within some per cent, unless the robot file is wrong.
    if not 1 / 3 < scale < 3 and 0.85 < scale / unit < 1.18:
        return [Damage(recording.name, 'command', f'commanded thrusts are {scale:.3g} times what '
                       f'the accelerometer feels: {THRUST_UNITS[unit]}?', None, 0.95)]
    # Means are subtracted. A constant force or torque is an error of the robot file, and in hover
    # another order of the rotors can have the same effect.
    measured = np.concatenate([m.force, 0.1 * m.turning], axis=1)
    measured -= measured.mean(axis=0)
    wrench = m.rotor_wrench * np.array([1, 1, 1, 0.1, 0.1, 0.1])[:, None]
    count, tried = 0.5 * len(m.t), []
    for order in permutations(range(4)):
        expected = np.einsum('nci,ni->nc', wrench, m.thrust[:, order])
        left = ((measured - expected + expected.mean(axis=0))**2).sum()
        tried.append((left, order))
    usual = tried[0][0]
    tried.sort()
    left, order = tried[0]
    if order == (0, 1, 2, 3) or left > limits.permuted * usual \
            or left > (1 - limits.least_agreement) * (measured**2).sum():
        return []
    sure = float(min(1 - np.exp(-count * np.log(usual / max(left, 1e-12))), MOST_CERTAIN))
    text = ', '.join(f'rotor{i + 1} gives what rotor{j + 1} is commanded'
                     for i, j in enumerate(order) if i != j)
    return [Damage(recording.name, 'command', f'the order of the thrusts is another one: {text}',
                   None, sure)]
