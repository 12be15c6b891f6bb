"""Impossible readings of one sensor: frozen, repeated, clipped, outliers, jumps, norms, noise."""

from collections.abc import Container

import numpy as np
from scipy.ndimage import median_filter

from beetle_omni_ros.identify.gap.bags import Recording
from beetle_omni_ros.identify.gap.series import matrices
from beetle_omni_ros.identify.recording.damage import changed, COMMAND, Damage, IMU, JOINTS, POSE
from beetle_omni_ros.identify.recording.limits import shipped
from beetle_omni_ros.identify.recording.signals import series_of, white_noise

NEIGHBOURS = 7          # readings of a running median
# Topic, first column, names of columns, unit. The rows have the order of ``scatter``.
SENSORS = (
    (IMU, 0, [f'linear_acceleration.{a}' for a in 'xyz'], 'm/s^2'),
    (IMU, 3, [f'angular_velocity.{a}' for a in 'xyz'], 'rad/s'),
    (POSE, 0, [f'position.{a}' for a in 'xyz'], 'm'),
    (POSE, 3, [f'orientation.{a}' for a in 'xyzw'], 'rad'),
    (JOINTS, 0, [f'gimbal{k}' for k in range(1, 5)], 'rad'))


def reading_damages(recording: Recording, unclocked: Container[str] = ()) -> list[Damage]:
    """
    Damages in the values of single topics in any unit, at most one for each topic.

    Topics with wrong stamps (``unclocked``) are ignored.
    """
    return _first(sensor.lost() or sensor.repeated() or sensor.outliers() for sensor in (
        _Sensor(recording, k) for k, (topic, *_) in enumerate(SENSORS)
        if topic != JOINTS and topic not in unclocked))


def sensor_damages(recording: Recording) -> list[Damage]:
    """Stuck encoders and sensors with unusually large noise, whose units must be correct."""
    sensors = [_Sensor(recording, k) for k in range(len(SENSORS))]
    return _first([sensors[-1].stuck(), sensors[-1].outliers(), *(s.noise() for s in sensors)])


def _first(found):
    """The first damage of each topic."""
    result: dict[str, Damage] = {}
    for damage in filter(None, found):
        result.setdefault(damage.topic, damage)
    return list(result.values())


class _Sensor:
    """Finite readings of one sensor in the order of their stamps, see ``SENSORS``."""

    def __init__(self, recording, k):
        self.recording, self.limits, self.scatter = recording, shipped(), shipped().scatter[k]
        self.topic, first, self.names, self.unit = SENSORS[k]
        self.t, everything = series_of(recording, self.topic)
        self.same = (np.diff(everything, axis=0) == 0).all(axis=1)
        self.raw = everything[:, first:first + len(self.names)]
        self.turned = self.topic == POSE and first > 0
        # Rotation matrices have no jumps of a sign, and [rad] of small turns.
        self.values = matrices(self.raw).reshape(-1, 9) if self.turned else self.raw

    def damage(self, cause, at=None, bad=None):
        """A damage; ``bad`` (n,) marks readings that the repair drops."""
        topic, fix, repair = self.topic, None, None
        if bad is not None:
            fix, good = 'drop these readings', self.t[~bad]
            repair = lambda r: changed(r, topic, keep=np.isin(r.times[topic], good))  # noqa: E731
        return Damage(self.recording.name, topic, cause, at, fix=fix, repair=repair)

    def lost(self):
        """Quaternions without a direction."""
        size = np.abs(self.raw).sum(axis=1)
        zero = size < 0.1 * np.median(size)
        return self.damage(f'{int(zero.sum())} of {len(zero)} orientations are zero quaternions: '
                           'the body was not tracked', self.t[np.argmax(zero)],
                           zero if zero.mean() < self.limits.few else None) \
            if self.turned and zero.any() else None

    def repeated(self):
        """Equal readings one after the other: clipped, stale, frozen."""
        same = np.diff(self.raw, axis=0) == 0
        for column, name, values in zip(same.T, self.names, self.raw.T, strict=True):
            for at in (values == values.max(), values == values.min()):
                if (at[1:] & column).sum() > self._longest(column) and at.mean() < 0.5:
                    return self.damage(
                        f'{name} is clipped: {int(at.sum())} readings are exactly '
                        f'{values[at][0]:.4g}: the range of the sensor is too small',
                        self.t[np.argmax(at)])
        for column, name in ((self.same, 'all axes'), *zip(same.T, self.names, strict=True)):
            longest = self._longest(column)
            long = [(n, k) for k, n in _runs(column) if n > longest]
            lasting = sum(n for n, _ in long)
            if name == 'all axes' and self.same.sum() - lasting > self.limits.stale * len(same):
                return self.damage(
                    f'{column.mean():.0%} of the readings repeat the one before: the driver '
                    'publishes stale readings, faster than the sensor measures', None,
                    np.concatenate([[False], column]))
            if long:
                return self.damage(f'{name} frozen: the same reading for '
                                   f'{lasting * np.median(np.diff(self.t)):.1f} s',
                                   self.t[max(long)[1]])
        return None

    def _longest(self, same):
        """Longest run of repeats that chance makes, but for one of many recordings."""
        share = (len(_runs(same)) - 1) / max((~same).sum(), 1)      # of readings that begin one
        share = np.clip(share, self.limits.stale, 1 - 1 / len(same))
        return np.log(len(same) / (1 - self.limits.certain)) / -np.log(share)

    def outliers(self):
        """Readings far from the median of their neighbours, and poses that jump and stay."""
        values, spans = self.values, np.diff(self.t, prepend=self.t[0])
        steps = np.abs(np.diff(values, axis=0, prepend=values[:1]))
        steps[spans > 3 * np.median(spans)] = 0.0
        off = np.abs(values - median_filter(values, (NEIGHBOURS, 1), mode='nearest'))
        for size, what in ((off, 'are spikes or outliers, such as markers mistaken for others'),
                           (steps, 'are jumps: markers were swapped, or the origin was set')):
            bad = (size > self._far(size, steps)).any(axis=1)
            if bad.any() and (size is off or self.topic == POSE):
                k = int(np.argmax(bad))
                return self.damage(
                    f'{int(bad.sum())} readings {what} ({self.names[0].split(".")[0]}: '
                    f'{size[k].max():.3g} {self.unit})', self.t[k],
                    bad if size is off and bad.mean() < self.limits.few else None)
        return None

    def _far(self, size, steps):
        """Least outliers; also relative to the motion, because a unit may be wrong."""
        here = median_filter(steps, (2 * NEIGHBOURS + 1, 1), mode='nearest')
        usual = np.quantile(size, 1 - self.limits.few, axis=0)
        return self.limits.outlier * np.maximum(np.maximum(here, usual), self.scatter)

    def stuck(self):
        """
        An encoder at rest while its command moves.

        It is frozen only if it rests longer than a servo with any valid lag: a command that moved
        just before the first changed reading has not arrived yet.
        """
        t, commands = series_of(self.recording, COMMAND)
        low, high = self.limits.servo_lag
        for k, column in enumerate((np.diff(self.raw, axis=0) == 0).T):
            for first, count in _runs(column):
                begin, end = self.t[first], self.t[first + count]
                told = commands[(t > begin - low) & (t < end - high), k]
                if np.ptp(told if len(told) else [0.0]) > self.limits.frozen_command:
                    return self.damage(
                        f'{self.names[k]} is frozen: the same reading for {end - begin:.1f} s '
                        f'while its command turns by {np.ptp(told):.2f} rad: encoder, or a jammed '
                        'servo', begin)
        return None

    def noise(self):
        """More white noise than such a sensor has."""
        scatter = white_noise(self.values)
        k = int(np.argmax(scatter))
        if scatter[k] <= self.scatter:
            return None
        mixed = scatter[k]**2 > (1 - self.limits.agreement) * self.values[:, k].var()
        why = 'two sources or two recordings are interleaved' if mixed else \
            'a noisy sensor, a wrong calibration, or a bad view of the markers'
        return self.damage(f'{self.names[0].split(".")[0]} scatters by {scatter[k]:.2g} '
                           f'{self.unit}, and such a sensor by {self.scatter:.2g} at most: {why}')


def _runs(mask):
    """(first index, length) of each run of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], mask.astype(int), [0]])))
    return [(int(a), int(b - a)) for a, b in zip(edges[::2], edges[1::2], strict=True)]
