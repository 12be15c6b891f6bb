"""
Units and axes of IMU and MoCap, from the motion that both measure.

Gyroscope and MoCap measure the same rate. The accelerometer measures MoCap's second derivative
minus gravity. Each hypothesis is a combination of common mistakes. Its weight is the likelihood
with Gaussian errors of unknown size, times a prior against each deviation from the convention.
"""

from dataclasses import dataclass
from itertools import permutations, product

import numpy as np

from beetle_omni_ros.identify.gap.bags import Recording
from beetle_omni_ros.identify.recording.clocks import begin_of
from beetle_omni_ros.identify.recording.damage import (
    CERTAIN,
    columns_changed,
    Damage,
    FLOOR,
    MOST_CERTAIN,
    PRIOR,
)
from beetle_omni_ros.identify.recording.limits import RecordingLimits
from beetle_omni_ros.identify.recording.motion import Motion, QUATERNIONS
from beetle_omni_ros.robot.parameters import RobotParameters

RATE_UNITS = {1.0: '', 180 / np.pi: 'in degrees per second, not rad/s',
              np.pi / 180: 'turned into radians twice'}
FORCE_UNITS = {1.0: '', 1 / 9.80665: 'in units of g', 1e3 / 9.80665: 'in milli-g',
               100.0: 'in cm/s^2', 1e3: 'in mm/s^2'}
LENGTH_UNITS = {1.0: '', 1e3: 'in millimetres, not metres', 100.0: 'in centimetres, not metres',
                1e-3: 'in kilometres, not metres', 1 / 0.3048: 'in feet, not metres',
                1 / 0.0254: 'in inches, not metres'}
AXES = 'xyz'
ALL_AXES = np.array([[[sign * (place == column) for column in range(3)]
                      for sign, place in zip(signs, order, strict=True)]
                     for order in permutations(range(3))
                     for signs in product((1, -1), repeat=3)], dtype=float)
UPS = [np.eye(3)[k] * sign for k in (2, 1, 0) for sign in (1, -1)]      # (0, 0, 1) first
ONE = np.eye(3)


@dataclass(frozen=True)
class Convention:
    """
    One hypothesis about the conventions of IMU and MoCap.

    Attributes:
        quaternion: key of QUATERNIONS.
        rate_axes: (3, 3) signed permutation from MoCap's rate to the gyroscope's.
        rate_unit: key of RATE_UNITS, or another factor.
        force_axes: (3, 3) signed permutation of the accelerometer.
        force_unit: key of FORCE_UNITS.
        up: (3,) upward axis of MoCap.
        length_unit: key of LENGTH_UNITS.
        position_axes: (3, 3) signed permutation of MoCap's positions alone.

    """

    quaternion: str
    rate_axes: np.ndarray
    rate_unit: float
    force_axes: np.ndarray
    force_unit: float
    up: np.ndarray
    length_unit: float
    position_axes: np.ndarray

    def rate(self, m: Motion) -> np.ndarray:
        """(N, 3) expected readings of the gyroscope."""
        return self.rate_unit * m.seen_rate[self.quaternion] @ self.rate_axes.T

    def force(self, m: Motion, gravity: float) -> np.ndarray:
        """(N, 3) expected readings of the accelerometer."""
        push = _acceleration(m, self.quaternion, self.position_axes) / self.length_unit
        up = np.einsum('i,nij->nj', self.up, m.seen_up[self.quaternion])
        return self.force_unit * (push + gravity * up) @ self.force_axes.T


USUAL = Convention('', ONE, 1.0, ONE, 1.0, UPS[0], 1.0, ONE)


def _acceleration(m, convention, axes):
    """MoCap's acceleration (N, 3) in body axes, with exchanged axes of the positions."""
    if axes is ONE:
        return m.seen_acceleration[convention].sum(axis=1)
    # Row i of seen_push is acceleration component i times world axis i.
    result = np.zeros_like(m.seen_acceleration[convention][:, 0])
    for i in range(3):
        j = int(np.argmax(np.abs(axes[i])))
        result += axes[i, j] * _along(m, convention, j, i)
    return result


def _along(m, convention, source, target):
    """MoCap's acceleration component ``source`` along world axis ``target``, in body axes."""
    up = m.seen_up[convention]
    size = np.einsum('nj,nj->n', m.seen_acceleration[convention][:, source], up[:, source])
    return size[:, None] * up[:, target]


def body_damages(recording: Recording, m: Motion, robot: RobotParameters,
                 limits: RecordingLimits) -> list[Damage]:
    """Contradictions between IMU and MoCap."""
    usual_rate, usual_force = _errors(m, USUAL, robot)
    moving = np.sqrt((m.rate**2).sum(axis=1).mean()) > limits.least_motion[0]
    fine = 1 - limits.least_agreement
    far = limits.unit_factor**2
    rate_size, seen_size = (np.sqrt((x**2).sum(axis=1).mean())
                            for x in (m.rate, m.seen_rate['']))
    moving |= bool(seen_size > limits.least_motion[0])
    rate_bad = moving and (usual_rate.sum() > fine * (m.rate**2).sum()
                           or not 1 / far < (rate_size / seen_size)**2 < far)
    force_bad = usual_force.sum() > 0.25 * fine * (m.force**2).sum()
    parts = _parts(len(m.t), limits.blocks)
    parted = moving and any(
        usual_rate[k].sum() > 2 * fine * (m.rate[k]**2).sum()
        and (m.rate[k]**2).sum() > limits.least_motion[0]**2 * len(usual_rate[k])
        or usual_force[k].sum() > fine * (m.force[k]**2).sum() for k in parts)
    if not (rate_bad or force_bad or parted):
        return _position_axes(recording, m, robot, limits)
    whole, sure = _most_likely(m, robot, slice(None), moving)
    if _explains(m, whole, robot, moving, limits):
        return _damages_of(recording, m, whole, sure, None, robot, limits)
    return _position_axes(recording, m, robot, limits) or _in_a_part(
        recording, m, robot, limits, parts, moving, usual_rate, usual_force)


def _errors(m, convention, robot):
    """Squared errors (N,) of rates and of forces."""
    return (((m.rate - convention.rate(m))**2).sum(axis=1),
            ((m.force - convention.force(m, robot.gravity))**2).sum(axis=1))


def _parts(count, blocks):
    edges = np.linspace(0, count, blocks + 1).astype(int)
    return [slice(a, b) for a, b in zip(edges[:-1], edges[1:], strict=True)]


def _explains(m, convention, robot, moving, limits, part=slice(None)):
    rate, force = _errors(m, convention, robot)
    good = force[part].sum() < 0.25 * (1 - limits.least_agreement) * (m.force[part]**2).sum()
    return good and (not moving or rate[part].sum() < (1 - limits.least_agreement)
                     * (m.rate[part]**2).sum())


def _most_likely(m, robot, part, moving):
    """The most likely hypothesis for a part of the flight, and its probability."""
    count = 0.5 * len(m.t[part])    # independent samples of an axis, at twice the edge
    tried = []
    for quaternion in QUATERNIONS:
        seen = m.seen_rate[quaternion][part]
        rates = _matched(m.rate[part], seen, RATE_UNITS, count) if moving else [(0.0, ONE, 1.0)]
        forces = []
        for up in UPS:
            lifted = np.einsum('i,nij->nj', up, m.seen_up[quaternion][part])
            push = m.seen_acceleration[quaternion][part].sum(axis=1)
            for length in LENGTH_UNITS:
                expected = push / length + robot.gravity * lifted
                price = PRIOR * ((length != 1.0) + (up is not UPS[0]))
                forces += [(score - price, axes, unit, up, length) for score, axes, unit
                           in _matched(m.force[part], expected, FORCE_UNITS, count)]
        forces.sort(key=lambda f: -f[0])
        for score, axes, unit in rates:
            for other, force_axes, force_unit, up, length in forces[:40]:
                price = PRIOR * (bool(quaternion) + (quaternion.startswith('inverse (')))
                tried.append((score + other - price - _price(axes, force_axes), Convention(
                    quaternion, axes, unit, force_axes, force_unit, up, length, ONE)))
    tried.sort(key=lambda pair: -pair[0])
    scores = np.array([score for score, _ in tried])
    weight = np.exp(scores - scores[0])
    return tried[0][1], float(min(weight[0] / weight.sum(), MOST_CERTAIN))


def _matched(measured, seen, units, count):
    """(log likelihood, axes, unit) of the ten best signed permutations and units."""
    cross, size, total = measured.T @ seen, (seen**2).sum(), (measured**2).sum()
    common = (ALL_AXES * cross).reshape(len(ALL_AXES), -1).sum(axis=1)
    scores = np.concatenate([
        -1.5 * count * np.log(np.maximum((total - 2 * unit * common + unit**2 * size)
                                         / max(total, 1e-12), FLOOR)) - PRIOR * (unit != 1.0)
        for unit in units])
    best = []
    for index in np.argsort(-scores, kind='stable')[:10]:
        unit, axes = tuple(units)[index // len(ALL_AXES)], ALL_AXES[index % len(ALL_AXES)]
        best.append((scores[index], ONE if (axes == ONE).all() else axes, unit))
    return best


def _price(rate_axes, force_axes):
    """Prior cost of one rotated or mirrored frame, or of two mistakes."""
    if rate_axes is ONE and force_axes is ONE:
        return 0.0
    if rate_axes is ONE or force_axes is ONE:
        return PRIOR
    same = (rate_axes == np.linalg.det(force_axes) * force_axes).all()
    return PRIOR * (1 if same else 2)


def _in_a_part(recording, m, robot, limits, parts, moving, usual_rate, usual_force):
    """A hypothesis for a part of the flight only, or a contradiction without explanation."""
    best = None
    for part in parts:
        convention, sure = _most_likely(m, robot, part, moving)
        if _same(convention, USUAL) or not _explains(m, convention, robot, moving, limits, part):
            continue
        rate, force = _errors(m, convention, robot)
        gain = sum((usual - new) / max(size, 1e-9) for usual, new, size in (
            (usual_rate, rate, (m.rate**2).sum()), (usual_force, force, (m.force**2).sum())))
        after = np.cumsum(gain[::-1])[::-1]     # gain of the hypothesis from each sample on
        k = int(np.argmax(after))
        if best is None or after[k] > best[0]:
            best = float(after[k]), k, convention, sure
    if best:
        _, k, convention, sure = best
        later = slice(k, len(m.t))
        if _explains(m, convention, robot, moving, limits, later):
            return _damages_of(recording, m, convention, sure, m.t[k], robot, limits, repair=False)
    scaled = _without_gravity(recording, m, robot) or _scaled(recording, m, robot, limits, moving)
    if scaled:
        return scaled
    rate_part = usual_rate.sum() / max((m.rate**2).sum(), 1e-12)
    force_part = usual_force.sum() / max((m.force**2).sum(), 1e-12)
    return [Damage(recording.name, 'mocap/pose', 'contradicts imu/data_raw under every convention '
                   f"that was tried: {min(rate_part, 9.99):.0%} of the gyroscope's and "
                   f"{min(force_part, 9.99):.0%} of the accelerometer's signal remain "
                   'unexplained by the pose', None, 0.9)]


def _without_gravity(recording, m, robot):
    """An accelerometer whose driver subtracts gravity."""
    without = ((m.force - _acceleration(m, '', ONE))**2).sum()
    usual = _errors(m, USUAL, robot)[1].sum()
    share = robot.gravity**2 * len(m.t)     # part of the sum of squares by gravity
    # A tenth is left for vibration and the noise of a second derivative.
    if without > 0.1 * share or not 0.5 * share < usual < 2 * share:
        return []
    felt = float(np.median(np.linalg.norm(m.force, axis=1)))
    return [Damage(recording.name, 'imu/data_raw', f'linear acceleration is without gravity: '
                   f'{felt:.2g} m/s^2 in the median, near {robot.gravity:.2f} m/s^2 expected; '
                   'the driver takes gravity off', None, 0.9)]


def _scaled(recording, m, robot, limits, moving):
    """A factor of no known unit: a wrong range or gain."""
    result = []
    expected = (('angular velocity', m.rate, USUAL.rate(m)) if moving else None,
                ('linear acceleration', m.force, USUAL.force(m, robot.gravity)))
    for what, measured, seen in filter(None, expected):
        factor = float((measured * seen).sum() / max((seen**2).sum(), 1e-12))
        left = ((measured - factor * seen)**2).sum() / max((measured**2).sum(), 1e-12)
        if left < 1 - limits.least_agreement and not (
                1 / limits.unit_factor < factor < limits.unit_factor):
            result.append(Damage(recording.name, 'imu/data_raw', f'{what} is {factor:.3g} times '
                                 'what the pose shows: a wrong range or gain?', None, 0.9))
    return result


def _same(a, b):
    return a.quaternion == b.quaternion and a.rate_unit == b.rate_unit \
        and a.force_unit == b.force_unit and a.length_unit == b.length_unit \
        and all(np.array_equal(x, y) for x, y in (
            (a.rate_axes, b.rate_axes), (a.force_axes, b.force_axes), (a.up, b.up)))


def _damages_of(recording, m, convention, sure, at, robot, limits, repair=True):
    """Deviations of a hypothesis from the conventions, as damages."""
    result = []
    moment = None if at is None else float(at) - begin_of(recording)

    def add(topic, cause, fix=None, change=None):
        can = fix and repair and sure >= CERTAIN and at is None
        result.append(Damage(recording.name, topic, cause, moment, sure, fix if can else None,
                             change if can else None))

    if convention.quaternion:
        order, sign = QUATERNIONS[convention.quaternion]
        add('mocap/pose', 'the quaternion is stored as ' + (
            convention.quaternion if convention.quaternion.startswith('(')
            else f'the {convention.quaternion}, world seen from the body') +
            '; expected (x, y, z, w), the body seen from the world',
            'reorder the quaternion', columns_changed(3, 7, lambda v: v[:, order] * [sign] * 1.0
                                                  if sign > 0 else v[:, order] * [-1, -1, -1, 1]))
    if convention.length_unit != 1.0:
        unit = convention.length_unit
        add('mocap/pose', f'positions accelerate {unit:.4g} times as much as the IMU measures: '
            f'{LENGTH_UNITS[unit]}?', 'scale the positions',
            columns_changed(0, 3, lambda v: v / unit))
    if convention.up is not UPS[0]:
        k = int(np.argmax(np.abs(convention.up)))
        axis = f'{"-" if convention.up[k] < 0 else ""}{AXES[k]}'
        add('mocap/pose', f'the {axis} axis points up, against gravity as the accelerometer '
            'measures it; expected z up')
    if convention.rate_unit != 1.0:
        unit = convention.rate_unit
        add('imu/data_raw', f"angular velocity is {unit:.3g} times the MoCap's: "
            f'{RATE_UNITS[unit]}?', 'scale the angular velocity',
            columns_changed(3, 6, lambda v: v / unit, 'imu/data_raw'))
    if convention.force_unit != 1.0:
        unit = convention.force_unit
        add('imu/data_raw', f'linear acceleration is {unit:.3g} times what MoCap and gravity '
            f'make: {FORCE_UNITS[unit]}?', 'scale the linear acceleration',
            columns_changed(0, 3, lambda v: v / unit, 'imu/data_raw'))
    _add_axes(add, m, convention, slice(None) if at is None else m.t >= at)
    return result or [Damage(recording.name, 'imu/data_raw', 'angular velocity and linear '
                             'acceleration contradict mocap/pose', moment, sure)]


def _add_axes(add, m, convention, part):
    """Rotated or mirrored frames, and signs."""
    rate, force = convention.rate_axes, convention.force_axes
    if rate is ONE and force is ONE:
        return
    # An accelerometer with the wrong sign looks like a frame with all axes reversed.
    if np.allclose(rate, np.linalg.det(force) * force) and not np.array_equal(force, -ONE):
        turned = np.linalg.det(force) > 0
        topic = 'mocap/pose' if _thrust_agrees(m, convention, part) else 'imu/data_raw'
        how = f'axes are turned: {_axes_text(force)}' if turned else \
            f'the frame is left-handed: {_axes_text(force)}'
        whose = "the IMU's axes in those of the MoCap's body"
        fix = topic == 'imu/data_raw'
        add(topic, f'{how} ({whose})', 'turn the axes back' if fix else None, columns_changed(
            0, 6, lambda v: np.concatenate([v[:, :3] @ force, v[:, 3:] @ rate], axis=1),
            'imu/data_raw'))
        return
    for what, axes, columns in (('angular velocity', rate, (3, 6)),
                                ('linear acceleration', force, (0, 3))):
        if axes is ONE:
            continue
        if np.array_equal(axes, -ONE):
            how = 'has the opposite sign' + (
                ': gravity is meant to be measured upwards at rest, +9.81 m/s^2 (REP-145)'
                if columns[0] == 0 else '')
        elif np.linalg.det(axes) < 0:
            how = 'has axes that are left-handed, swapped or of the wrong sign: ' \
                + _axes_text(axes)
        else:
            how = f'has axes that are turned: {_axes_text(axes)}'
        add('imu/data_raw', f'{what} {how}', 'exchange the axes', columns_changed(
            *columns, lambda v, axes=axes: v @ axes, 'imu/data_raw'))


def _axes_text(axes):
    """Text such as 'x is y, y is -x, z is z'."""
    parts = []
    for k in range(3):
        j = int(np.argmax(np.abs(axes[k])))
        parts.append(f'{AXES[k]} is {"-" if axes[k, j] < 0 else ""}{AXES[j]}')
    return ', '.join(parts)


def _thrust_agrees(m, convention, part):
    """Whether the accelerometer's axes agree with the direction of commanded thrusts."""
    force, pushed = m.force[part] / convention.force_unit, m.thrust_force[part]
    usual = (force * pushed).sum()
    turned = (force * (pushed @ convention.force_axes.T)).sum()
    return usual > turned


def _position_axes(recording, m, robot, limits):
    """Exchanged or mirrored axes of the positions alone."""
    up = robot.gravity * m.seen_up[''][:, 2]
    push = m.force - up
    seen = _acceleration(m, '', ONE)
    size = (seen**2).sum(axis=1).mean()
    if np.sqrt(size) < limits.least_motion[1]:
        return []
    usual = ((push - seen)**2).sum()
    if usual < (1 - limits.least_agreement) * (push**2).sum():
        return []
    count, tried = 0.5 * len(m.t), []
    for axes in ALL_AXES:
        left = ((push - _acceleration(m, '', ONE if (axes == ONE).all() else axes))**2).sum()
        tried.append((-1.5 * count * np.log(max(left / max((push**2).sum(), 1e-12), FLOOR))
                      - PRIOR * (not (axes == ONE).all()), axes, left))
    tried.sort(key=lambda one: -one[0])
    score, axes, left = tried[0]
    if (axes == ONE).all() or left > (1 - limits.least_agreement) * (push**2).sum():
        return []
    weight = np.exp(np.array([other for other, _, _ in tried]) - score)
    sure = float(min(1 / weight.sum(), MOST_CERTAIN))
    kind = 'left-handed' if np.linalg.det(axes) < 0 else 'exchanged'
    return [Damage(recording.name, 'mocap/pose', f'the axes of positions are {kind} against those '
                   f'of the orientation and of the accelerometer: {_axes_text(axes)}', None, sure,
                   'exchange the axes of positions' if sure >= CERTAIN else None,
                   columns_changed(0, 3, lambda v: v @ axes.T) if sure >= CERTAIN else None)]
