"""
Checks of single topics: order of stamps, times of recording, lags, and impossible readings.

The age of a message is its time of recording minus its stamp. Computer load increases the age of
all topics, so each age is compared with the median age of the other topics at that time. Lags that
times of recording do not show are found by correlation of two motions. Both are series of lags,
which may be out of range, step or drift.
"""

from collections.abc import Container
from functools import partial

import numpy as np
from scipy.ndimage import median_filter

from beetle_omni_ros.identify.recording.bag import (
    changed,
    COMMAND,
    Damage,
    IMU,
    JOINTS,
    NEEDED,
    POSE,
    Recording,
)
from beetle_omni_ros.identify.recording.parameters import shipped
from beetle_omni_ros.identify.recording.relations import Relation, series_of, Smoothed, white_noise
from beetle_omni_ros.identify.recording.series import matrices, runs

OVERLAP = 6     # windows that share a sample; a motion counts once
NEIGHBOURS = 7          # readings of a running median
# Topic, first column, names of columns, unit. The rows have the order of ``scatter``.
SENSORS = (
    (IMU, 0, [f'linear_acceleration.{a}' for a in 'xyz'], 'm/s^2'),
    (IMU, 3, [f'angular_velocity.{a}' for a in 'xyz'], 'rad/s'),
    (POSE, 0, [f'position.{a}' for a in 'xyz'], 'm'),
    (POSE, 3, [f'orientation.{a}' for a in 'xyzw'], 'rad'),
    (JOINTS, 0, [f'gimbal{k}' for k in range(1, 5)], 'rad'))


def begin_of(recording: Recording) -> float:
    """First stamp of the IMU [s], the origin of stated times."""
    return float(recording.times[IMU][0]) if len(recording.times[IMU]) else 0.0


def clock_damages(recording: Recording) -> list[Damage]:
    """Damages by stamps alone, at most one for each topic."""
    ages = relative_ages(recording)
    found = (_clock_damage(recording, topic, *ages.get(topic, ((), ()))) for topic in NEEDED)
    return [damage for damage in found if damage]


def _clock_damage(recording, topic, at, ages):
    """Stamps that do not advance, in another unit, of another clock, back, or of two sources."""
    limits, t, damage = shipped(), recording.times[topic], partial(Damage, recording.name, topic)
    steps, (low, high) = np.diff(t), limits.period
    ahead = steps[steps > 0]
    if len(ahead) < limits.few * len(steps):
        return damage(f'{len(steps) - len(ahead)} of {len(steps)} stamps do not advance (first '
                      f'stamp {t[0]:.3f} s)')
    if not low <= (period := float(np.median(ahead))) <= high:
        return damage(f'stamps are {period:g} s apart; expected {low:g} to {high:g} s: another '
                      'unit taken for seconds, such as milliseconds or nanoseconds?')
    if judged := judge(at, ages, limits.clock_offset, limits.clock_step):
        cause, moment, late_at = judged
        received = recording.received[topic]
        late = late_at(received)
        if moment is not None:      # the message at the step
            near = np.flatnonzero(np.abs(received - moment) < 2 * limits.bin)
            k = near[np.argmax(np.abs(np.diff((received - t)[near])))] + 1
            moment, late = t[k], np.where(np.arange(len(t)) < k, late[0], late[-1])
        return damage(f'the clock {cause}, against the other topics recorded at the same time: '
                      'clocks of two computers differ, or another time base', moment,
                      fix='shift the stamps', repair=lambda r: changed(r, topic, times=t + late))
    if steps.min() < -high:
        return damage(f'the clock goes back by {-steps.min():.2f} s', t[np.argmin(steps)])
    order = np.argsort(t, kind='stable')
    rows = recording.values[topic][order]
    twice = (np.diff(t[order]) <= 0) & (rows[1:] != rows[:-1]).any(axis=1)
    if twice.mean() > limits.few:
        return damage(f'{twice.sum()} of {len(t)} stamps occur twice with other values: two '
                      'sources publish on one topic', t[order][np.argmax(twice)])
    return None


def relative_ages(recording: Recording) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Topic -> times of recording (n,) [s], and ages (n,) relative to the other topics [s]."""
    known = {topic: recording.received[topic] for topic in NEEDED
             if len(recording.received.get(topic, ())) == len(recording.times[topic]) > 1}
    if len(known) < 3:
        return {}
    edges = np.arange(max(r.min() for r in known.values()), min(r.max() for r in known.values()),
                      shipped().bin)
    medians, result = {}, {}
    for topic, received in known.items():
        age, cuts = received - recording.times[topic], np.searchsorted(received, edges)
        medians[topic] = np.array([np.median(age[a:b]) if b > a else np.nan
                                   for a, b in zip(cuts[:-1], cuts[1:], strict=True)])
    for topic, own in medians.items():
        age = own - np.nanmedian([m for name, m in medians.items() if name != topic], axis=0)
        result[topic] = edges[:-1][np.isfinite(age)], age[np.isfinite(age)]
    return result


def lag_damage(name: str, relation: Relation, signals: Smoothed) -> Damage | None:
    """A lag of two motions that is out of range, steps or drifts."""
    late, early = (np.linalg.norm(x, axis=1) for x in relation.pair(signals))
    at, lags = window_lags(signals.t, late, early, signals.silent)
    # the lag of a servo depends on its motion, so that windows of one motion are one observation
    judged = judge(at, lags, getattr(shipped(), relation.lag), shipped().lag_step,
                   OVERLAP if relation.early == COMMAND else 1)
    return Damage(name, relation.late, f'the clock of {relation.late} or of {relation.early} '
                  f'{judged[0]}, by {relation.words}', judged[1]) if judged else None


def judge(at: np.ndarray, lags: np.ndarray, allowed: np.ndarray, least: float, shared: int = 1
          ) -> list | None:
    """
    Whether lags (n,) [s] at times (n,) are out of range, step or drift; None if they are valid.

    Step and drift are compared with a constant lag by the likelihood of Laplace's distribution,
    which bears single wrong lags. They must also exceed the change ``least`` [s]. ``shared``
    neighbours are of one motion and count as one.

    Returns:
        cause in words, time of a step or None, function from times to lags.

    """
    n = len(lags)
    if n < 4:
        return None
    middle, usual = float(np.median(lags)), np.abs(lags - np.median(lags)).sum()
    # Largest difference of means, weighted by their numbers of values, of two or more values.
    total, counts = np.cumsum(lags - lags.mean())[:-1], np.arange(1, n)
    split = int(np.argmax((total**2 * (1 / counts + 1 / (n - counts)))[1:-1])) + 2
    before, after = float(np.median(lags[:split])), float(np.median(lags[split:]))
    slope, start = np.polyfit(at - at[0], lags, 1)
    drift, moment = slope * (at[-1] - at[0]), 0.5 * (at[split - 1] + at[split])
    models = (
        (after - before, f'steps by {after - before:.2f} s: its lag is {before:.2f} s before and '
         f'{after:.2f} s after', moment, lambda t: np.where(t < moment, before, after)),
        (drift, f'drifts by {slope:.2%}: its lag is {start:.2f} s at first and '
         f'{start + drift:.2f} s at the end', None, lambda t: start + slope * (t - at[0])))
    rests = [np.abs(lags - late(at)).sum() for *_, late in models]
    change, *result = models[int(np.argmin(rests))]
    if abs(change) > least \
            and usual - min(rests) > shared * shipped().prior * max(min(rests) / n, least / 10):
        return result
    if allowed[0] <= middle <= allowed[1]:
        return None
    return [f'is {abs(middle):.2f} s {"behind" if middle > 0 else "ahead"}, expected '
            f'{allowed[0]:g} to {allowed[1]:g} s', None, lambda t: np.full(len(t), middle)]


def window_lags(t: np.ndarray, late: np.ndarray, early: np.ndarray, gaps: np.ndarray
                ) -> tuple[np.ndarray, np.ndarray]:
    """
    Time shifts between two similar series, by windows.

    Args:
        t: (N,) times [s].
        late: (N,) delayed magnitude.
        early: (N,) leading magnitude.
        gaps: (N,) mask of times in a gap, whose windows are ignored.

    Returns:
        times (W,) of the motion in these windows [s], and shifts (W,) [s].

    """
    limits, period, at, lags = shipped(), float(t[1] - t[0]), [-np.inf], list[float]()
    length, reach, apart = (round(x / period) for x in (
        limits.window, limits.lag_reach, 1 / limits.edge))
    for first in range(0, len(t) - length + 1, length // OVERLAP):
        part, begin = slice(first, first + length), max(0, first - reach)
        own = late[part] - late[part].mean()
        views = np.lib.stride_tricks.sliding_window_view(early[begin:part.stop + reach], length)
        views = views - views.mean(axis=1, keepdims=True)
        alike = views @ own / (np.sqrt((views**2).sum(axis=1) * (own**2).sum()) + 1e-12)
        k = int(np.argmax(alike))
        # Evidence against no correlation, or against the best distant shift.
        other = alike[np.abs(np.arange(len(alike)) - k) > apart].max(initial=0.0)
        evidence = 0.5 * limits.edge * limits.window * np.log(
            (1 - other**2) / (1 - min(alike[k], 1 - 1e-9)**2))
        moment = np.average(t[part], weights=own**2)
        if evidence > limits.prior and 0 < k < len(alike) - 1 and not gaps[part].any() \
                and moment > at[-1] + limits.window / OVERLAP:
            a, b, c = alike[k - 1:k + 2]
            at.append(moment)
            lags.append(period * (first - begin - k - 0.5 * (a - c) / min(a - 2 * b + c, -1e-12)))
    return np.array(at[1:]), np.array(lags)


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
        whole = self._frozen(self.same)
        if self.same.sum() - sum(whole.values()) > self.limits.stale * len(same):
            return self.damage(
                f'{self.same.mean():.0%} of the readings repeat the one before: the driver '
                'publishes stale readings, faster than the sensor measures', None,
                np.concatenate([[False], self.same]))
        for name, frozen in (('all axes', whole), *zip(
                self.names, map(self._frozen, same.T), strict=True)):
            if frozen:
                return self.damage(
                    f'{name} frozen: the same reading for '
                    f'{sum(frozen.values()) * np.median(np.diff(self.t)):.1f} s',
                    self.t[max(frozen, key=lambda k: (frozen[k], k))])
        return None

    def _frozen(self, same):
        """First row -> length of each run of repeats that chance does not make."""
        longest = self._longest(same)
        return {k: n for k, n in runs(same) if n > longest}

    def _longest(self, same):
        """Longest run of repeats that chance makes, but for one of many recordings."""
        share = (len(runs(same)) - 1) / max((~same).sum(), 1)      # of readings that begin one
        share = np.clip(share, self.limits.stale, 1 - 1 / len(same))
        return np.log(len(same) / (1 - self.limits.certain)) / -np.log(share)

    def outliers(self):
        """Readings far from the median of their neighbours, and poses that jump and stay."""
        values, spans = self.values, np.diff(self.t, prepend=self.t[0])
        steps = np.abs(np.diff(values, axis=0, prepend=values[:1]))
        steps[spans > 3 * np.median(spans)] = 0.0
        off = np.abs(values - median_filter(values, (NEIGHBOURS, 1), mode='nearest'))
        # Relative to the motion, too, because a unit may be wrong.
        here = median_filter(steps, (2 * NEIGHBOURS + 1, 1), mode='nearest')
        for size, what in ((off, 'are spikes or outliers, such as markers mistaken for others'),
                           (steps, 'are jumps: markers were swapped, or the origin was set')):
            usual = np.quantile(size, 1 - self.limits.few, axis=0)
            bad = (size > self.limits.outlier * np.maximum(
                np.maximum(here, usual), self.scatter)).any(axis=1)
            if bad.any() and (size is off or self.topic == POSE):
                k = int(np.argmax(bad))
                return self.damage(
                    f'{int(bad.sum())} readings {what} ({self.names[0].split(".")[0]}: '
                    f'{size[k].max():.3g} {self.unit})', self.t[k],
                    bad if size is off and bad.mean() < self.limits.few else None)
        return None

    def stuck(self):
        """
        An encoder at rest while its command moves.

        It is frozen only if it rests longer than a servo with any valid lag: a command that moved
        just before the first changed reading has not arrived yet.
        """
        t, commands = series_of(self.recording, COMMAND)
        low, high = self.limits.servo_lag
        for k, column in enumerate((np.diff(self.raw, axis=0) == 0).T):
            for first, count in runs(column):
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
