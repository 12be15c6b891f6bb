"""Impossible readings: frozen, repeated, clipped, spikes, quaternions of wrong norm, noise."""

from collections.abc import Container
from functools import partial

import numpy as np
from scipy.ndimage import median_filter

from beetle_omni_ros.identify.gap.bags import Recording
from beetle_omni_ros.identify.gap.keys import friction
from beetle_omni_ros.identify.gap.series import aligned
from beetle_omni_ros.identify.recording.clocks import begin_of, NORMAL
from beetle_omni_ros.identify.recording.damage import changed, Damage
from beetle_omni_ros.identify.recording.limits import RecordingLimits
from beetle_omni_ros.identify.recording.motion import GRID
from beetle_omni_ros.identify.servo.model import LONGEST_STEP
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.robot.servo import NUMPY, Servo, Step

AXES = {'imu/data_raw': [f'linear_acceleration.{a}' for a in 'xyz']
        + [f'angular_velocity.{a}' for a in 'xyz'],
        'mocap/pose': [f'position.{a}' for a in 'xyz'] + [f'orientation.{a}' for a in 'xyzw'],
        'joint_states': [f'position of gimbal{k}' for k in range(1, 5)]}
LEAST_CLIPPED = 10      # readings
DIFFERENCED = 20**0.5   # deviation of the third difference of white noise: 1 + 9 + 9 + 1
MOST_REPAIRED = 0.02    # largest share of a topic's readings that a repair drops


def reading_damages(recording: Recording, limits: RecordingLimits, robot: RobotParameters,
                    unclocked: Container[str] = ()) -> list[Damage]:
    """
    Damages in the values of single topics, at most one for each topic.

    Topics with wrong stamps (``unclocked``) are ignored.
    """
    found = {}
    for topic, checks in (('imu/data_raw', (_beyond, _clipped, _outliers, _stale, _frozen)),
                          ('mocap/pose', (_beyond, _norms, _alternating, _outliers, _stale,
                                          _frozen, _jumps)),
                          ('joint_states', (_beyond, _outliers, partial(_stuck, robot=robot))),
                          ('command', (_beyond,))):
        if topic in unclocked:
            continue
        series = _Series(recording, topic)
        for check in checks:
            damage = check(series, limits)
            if damage:
                found[topic] = damage
                break
    return list(found.values())


def noise_damages(recording: Recording, limits: RecordingLimits) -> list[Damage]:
    """
    Sensors with unusually large noise, at most one damage for each topic.

    The third difference of equidistant readings removes smooth motion. Its variance is 20 times
    that of white noise, and its median is robust against single steps. Units must be correct.
    """
    force, rate, place, turn, tilt = limits.scatter
    found = []
    for topic, most, units in (
            ('imu/data_raw', [force] * 3 + [rate] * 3, ['m/s^2'] * 3 + ['rad/s'] * 3),
            ('mocap/pose', [place] * 3 + [turn] * 4, ['m'] * 3 + ['rad'] * 4),
            ('joint_states', [tilt] * 4, ['rad'] * 4)):
        series = _Series(recording, topic)
        values = series.values.copy()
        if topic == 'mocap/pose':
            values[:, 3:] = 2 * aligned(values[:, 3:])     # [rad] of small turns
        if len(values) < 20:
            continue
        scatter = NORMAL * np.median(np.abs(np.diff(values, 3, axis=0)), axis=0) / DIFFERENCED
        k = int(np.argmax(scatter / most))
        if scatter[k] > most[k]:
            found.append(series.damage(
                f'{AXES[topic][k]} scatters by {scatter[k]:.2g} {units[k]}, and such a sensor by '
                f'{most[k]:.2g} at most: a noisy sensor, a wrong calibration, or a bad view of '
                'the markers'))
    return found


class _Series:
    """One topic in the order of its stamps, with finite readings only."""

    def __init__(self, recording, topic):
        self.recording, self.topic = recording, topic
        t, values = recording.times[topic], recording.values[topic]
        fine = np.isfinite(t) & np.isfinite(values).all(axis=1)
        order = np.argsort(t, kind='stable')
        self.index = order[fine[order]]
        self.t, self.values = t[self.index], values[self.index]

    @property
    def period(self):
        """Median time between readings with different stamps [s]."""
        steps = np.diff(self.t)
        return float(np.median(steps[steps > 0])) if (steps > 0).any() else np.inf

    def damage(self, cause, at=None, bad=None, fix=None):
        """A damage; ``bad`` (n,) marks readings that the repair drops."""
        moment = None if at is None else max(0.0, float(at) - begin_of(self.recording))
        repair = None
        if bad is not None and fix:
            keep = np.sort(self.index[~bad])
            topic = self.topic
            repair = lambda r: changed(r, topic, keep=keep)     # noqa: E731
        return Damage(self.recording.name, self.topic, cause, moment,
                      fix=fix if repair else None, repair=repair)


def _beyond(series, limits):
    """Values out of any sensor's range."""
    scale = {'imu/data_raw': [limits.full_scale[0]] * 3 + [limits.full_scale[1]] * 3,
             'mocap/pose': [limits.room] * 3 + [np.inf] * 4,
             'joint_states': [np.inf] * 4, 'command': [np.inf] * 8}[series.topic]
    size = np.abs(series.values)
    bad = (size > scale).any(axis=1) & ~_at_floor(series, limits) | (size > 1e5).any(axis=1)
    if not bad.any() or bad.mean() > MOST_REPAIRED:
        return None         # if all are too large, the unit is wrong
    k = int(np.argmax(bad))
    count = int(bad.sum())
    return series.damage(f'{count} spike{"s" if count > 1 else ""} beyond what the sensor can '
                         'measure, such as '
                         f'{np.abs(series.values[k]).max():.3g}', series.t[k], bad,
                         'drop these readings')


def _at_floor(series, limits):
    """(n,) IMU readings that an impact on the ground may explain."""
    if series.topic != 'imu/data_raw':
        return np.zeros(len(series.t), dtype=bool)
    pose = _Series(series.recording, 'mocap/pose')
    return np.interp(series.t, pose.t, pose.values[:, 2]) < limits.contact


def _norms(series, limits):
    """Quaternions whose norm is not 1."""
    norm = np.linalg.norm(series.values[:, 3:], axis=1)
    zero = norm < 0.1
    if zero.any():
        few = zero.mean() < MOST_REPAIRED
        return series.damage(f'{int(zero.sum())} of {len(zero)} orientations are zero quaternions:'
                             ' the body was not tracked', series.t[np.argmax(zero)], zero,
                             'drop these readings' if few else None)
    off = np.abs(norm - 1) > limits.unit_length
    if off.mean() > 0.01:
        result = series.recording.values[series.topic].copy()
        result[:, 3:] /= np.linalg.norm(result[:, 3:], axis=1, keepdims=True)
        at = None if off.mean() > 0.9 else series.t[np.argmax(off)]
        damage = series.damage(f'the orientation is no unit quaternion: its norm is '
                               f'{np.median(norm[off]):.3g}, expected 1', at)
        topic = series.topic
        return Damage(damage.run, topic, damage.cause, damage.at_s, 0.99, 'normalise',
                      lambda r: changed(r, topic, values=result))
    return None


def _outliers(series, limits):
    """Readings far from the median of their neighbours."""
    width = limits.outlier_window
    values = series.values
    if series.topic == 'mocap/pose':
        values = values.copy()
        values[:, 3:] = aligned(values[:, 3:])
        floor = [limits.outlier_position] * 3 + [limits.outlier_angle / 2] * 4
    elif series.topic == 'imu/data_raw':
        floor = [limits.outlier_force] * 3 + [limits.outlier_rate] * 3
    else:
        moved = np.abs(np.diff(values, axis=0))
        count = moved[moved > 1e-6].min(initial=10.0)       # of the encoder, in its unit
        floor = [max(limits.outlier_joint, 3 * count)] * 4
    off = np.abs(values - median_filter(values, size=(width, 1), mode='nearest'))
    # Compared with the usual step there, so that a wrong unit does not make outliers.
    steps = np.abs(np.diff(values, axis=0, prepend=values[:1]))
    usual = median_filter(steps, size=(2 * width + 1, 1), mode='nearest')
    noise = NORMAL * np.maximum(np.median(off, axis=0), usual)
    bad = (off > np.maximum(floor, limits.outlier_noise * noise)).any(axis=1) \
        & ~_at_floor(series, limits)
    if bad.mean() > limits.alternating:
        return series.damage(f'{bad.mean():.0%} of the readings jump to and fro: two sources or '
                             'two recordings are interleaved', series.t[np.argmax(bad)])
    if bad.sum() == 0:
        return None
    k = int(np.argmax(bad))
    few = bad.mean() < MOST_REPAIRED
    what = 'outliers: the markers were mistaken for others, or swapped' \
        if series.topic == 'mocap/pose' else 'spikes'
    axis = AXES[series.topic][int(np.argmax((off / np.maximum(floor, 1e-9))[k]))]
    return series.damage(f'{int(bad.sum())} readings are {what} ({axis} is off by '
                         f'{off[k].max():.3g})', series.t[k], bad,
                         'drop these readings' if few else None)


def _alternating(series, limits):
    """Positions that jump to and fro between messages, farther than noise."""
    steps = np.diff(series.values[:, :3], axis=0)
    size = np.linalg.norm(steps, axis=1)
    cosine = (steps[1:] * steps[:-1]).sum(axis=1) / np.maximum(size[1:] * size[:-1], 1e-12)
    back = (cosine < -0.8) & (size[1:] > limits.outlier_position / 3)
    # Noise reverses direction in a third of its steps, motion hardly ever.
    if back.mean() < 0.6:
        return None
    return series.damage(f'{back.mean():.0%} of the positions jump to and fro by '
                         f'{np.median(size[1:][back]):.2f} m: two sources or two recordings are '
                         'interleaved', series.t[int(np.argmax(back))])


def _stale(series, limits):
    """Single readings equal to the previous one."""
    same = (np.diff(series.values, axis=0) == 0).all(axis=1)
    runs = _runs(same)
    short = sum(length for _, length in runs if length < 10)
    if short < limits.stale * len(same):
        return None
    bad = np.concatenate([[False], same])
    return series.damage(f'{short / len(same):.0%} of the readings repeat the one before: the '
                         'driver publishes stale readings, faster than the sensor measures',
                         series.t[np.argmax(bad)] if runs[0][0] > 20 else None, bad,
                         'drop repeated readings')


def _frozen(series, limits):
    """Equal readings for a long time, of all axes or of one."""
    same = np.diff(series.values, axis=0) == 0
    period = series.period
    for what, columns, longest in (
            ('', same.all(axis=1), limits.frozen),
            *((AXES[series.topic][k] + ' ', column, limits.frozen_axis)
              for k, column in enumerate(same.T))):
        runs = [(k, n) for k, n in _runs(columns) if n * period > longest]
        if runs:
            lasting = period * sum(n for _, n in runs)
            k = max(runs, key=lambda run: run[1])[0]
            return series.damage(f'{what}frozen: the same reading for {lasting:.1f} s',
                                 series.t[k])
    return None


def _runs(mask):
    """(first index, length) of each run of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], mask.astype(int), [0]])))
    return [(int(a), int(b - a)) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def _clipped(series, limits):
    """An extreme value that occurs repeatedly."""
    for k, column in enumerate(series.values.T):
        for word, extreme in (('largest', column.max()), ('smallest', column.min())):
            at = column == extreme
            pairs = (at[1:] & at[:-1]).sum()
            if pairs >= LEAST_CLIPPED and abs(extreme) > 0.1 and not at.all():
                return series.damage(
                    f'{AXES[series.topic][k]} is clipped: {int(at.sum())} readings are exactly '
                    f'the {word}, {extreme:.4g}: the range of the sensor is too small',
                    series.t[np.argmax(at)])
    return None


def _jumps(series, limits):
    """Poses that jump and stay, without a rate of the gyroscope."""
    position = series.values[:, :3]
    q = series.values[:, 3:] / np.linalg.norm(series.values[:, 3:], axis=1, keepdims=True)
    angle = 2 * np.arccos(np.clip(np.abs((q[1:] * q[:-1]).sum(axis=1)), 0, 1))
    leap = np.linalg.norm(np.diff(position, axis=0), axis=1)
    steps = np.diff(series.t)
    usual = steps < 3 * np.median(steps)
    imu = _Series(series.recording, 'imu/data_raw')
    rate = np.linalg.norm(imu.values[:, 3:], axis=1)
    between = 0.5 * (series.t[1:] + series.t[:-1])
    turned = np.interp(between, imu.t, rate) * steps
    # A gyroscope in degrees per second reads too much, never too little.
    jump = usual & (angle > limits.jump_angle) & (turned < 0.5 * angle)
    spread = float(np.median(leap[usual])) if usual.any() else 0.0
    # Relative to the usual step, because in millimetres every step is large.
    far = usual & (leap > max(limits.jump_position, 20 * spread))
    bad = jump | far
    if not bad.any() or bad.mean() > limits.alternating:
        return None
    k = int(np.argmax(bad))
    size = f'{angle[k]:.2f} rad' if jump[k] else f'{leap[k]:.2f} m'
    return series.damage(f'the pose jumps by {size} between two readings, {int(bad.sum())} times, '
                         'and the gyroscope does not show it: the markers were swapped',
                         series.t[k])


def _stuck(series, limits, robot):
    """
    An encoder at rest while its command moves.

    It is frozen only if the robot's servo would have turned, with every lag that is valid: a
    command that moved just before the first changed reading has not arrived yet.
    """
    command = _Series(series.recording, 'command')
    if len(command.t) < 2 or np.abs(command.values[:, :4]).max() > 4 * np.pi:
        return None         # not in radians, which a later check reports
    low, high = limits.servo_lag
    for k in range(4):
        for first, length in _runs(np.diff(series.values[:, k]) == 0):
            t = series.t[first:first + length + 1]
            span = slice(*np.searchsorted(command.t, (t[0] - high, t[-1] - low)))
            if t[-1] - t[0] <= high or not len(command.t[span]) \
                    or np.ptp(command.values[span, k]) <= limits.frozen_command:
                continue
            times, tilts = _servo(robot, k, command, t[0] - 2 * high, t[-1] - low)
            turned = min(np.ptp(np.interp(t - lag, times, tilts))
                         for lag in np.arange(low, high + GRID / 2, GRID))
            if turned > limits.frozen_command:
                return series.damage(
                    f'gimbal{k + 1} is frozen: the same reading for {t[-1] - t[0]:.1f} s while '
                    f'its command turns the servo by {turned:.2f} rad: encoder, or a jammed '
                    'servo', t[0])
    return None


def _servo(robot, k, command, begin, end):
    """Times (N,) [s] and angles (N,) [rad] of joint ``k`` by the robot file, without delay."""
    times = np.arange(begin, end, LONGEST_STEP)
    limit, (coulomb, stiction) = robot.joints.position_limit, friction(robot)
    index = np.maximum(np.searchsorted(command.t, times, side='right') - 1, 0)
    targets = np.clip(command.values[index, k], -limit, limit)
    step = Step(NUMPY, Servo.of(robot.joints.of(k), coulomb=coulomb[k], stiction=stiction[k]),
                LONGEST_STEP)
    tilts, rate = targets.copy(), 0.0       # at rest at the first target
    for i in range(len(times) - 1):
        tilts[i + 1], rate = step(targets[i], tilts[i], rate)
    return times, tilts
