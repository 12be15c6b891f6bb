"""
Clock errors that stamps alone do not show, by correlation of two sensors in time windows.

The compared magnitudes of rate and tilt rate do not depend on axes, signs or units.
"""

import numpy as np

from beetle_omni_ros.identify.gap.bags import Recording
from beetle_omni_ros.identify.gap.series import low_pass, matrices
from beetle_omni_ros.identify.recording.clocks import begin_of, change_point
from beetle_omni_ros.identify.recording.damage import Damage
from beetle_omni_ros.identify.recording.limits import RecordingLimits
from beetle_omni_ros.identify.recording.motion import (
    _body_rate,
    _orientation,
    common_grid,
    GRID,
    held,
    series_of,
    silent,
)

LEAST_WINDOWS = 3       # to each side of a step
MOST_SILENT = 0.15      # largest share of silence in a window
LEAST_NOISE = 0.005     # [s] scatter of windows in any flight
SHARP = 0.9             # largest correlation of a second, distant shift, relative to the best


def lag_damages(recording: Recording, limits: RecordingLimits) -> list[Damage]:
    """Steps, drifts and offsets between MoCap and IMU, and between encoders and commands."""
    grid = common_grid(recording)
    if grid is None:
        return []
    kernel = low_pass(2 * limits.edge, 1, GRID)
    stamps, values = series_of(recording, 'mocap/pose')
    turned = _body_rate(matrices(_orientation(stamps, values[:, 3:], grid)))
    rate = held(recording, 'imu/data_raw', grid)[:, 3:]
    tilt, commanded = (kernel(held(recording, topic, grid)[:, :4], 1)
                       for topic in ('joint_states', 'command'))
    t = grid[kernel.margin:len(grid) - kernel.margin]
    pairs = (('mocap/pose', 'imu/data_raw', 'the pose', 'the gyroscope', limits.sensor_lag,
              np.linalg.norm(kernel(turned), axis=1), np.linalg.norm(kernel(rate), axis=1)),
             ('joint_states', 'command', 'encoders', 'commands', limits.servo_lag,
              np.linalg.norm(tilt, axis=1), np.linalg.norm(commanded, axis=1)))
    gaps = silent(recording, t, 0.0)
    result = []
    for topic, other, what, whose, allowed, late, early in pairs:
        at, lags = window_lags(t, late, early, limits, gaps)
        damage = _judged(recording, topic, other, what, whose, allowed, at, lags, limits)
        if damage:
            result.append(damage)
    return result


def window_lags(t, late, early, limits: RecordingLimits,
                gaps: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """
    Time shifts between two similar series, by windows.

    Args:
        t: (N,) times [s].
        late: (N,) delayed magnitude.
        early: (N,) leading magnitude.
        limits: window, largest shift and least correlation.
        gaps: (N,) mask of times in a gap, whose windows are ignored.

    Returns:
        middles (W,) of the windows [s], and shifts (W,) [s].

    """
    length, reach = (round(x / GRID) for x in (limits.lag_window, limits.lag_reach))
    at, lags = [], []
    for first in range(0, len(t) - length + 1, length // 3):
        if gaps is not None and gaps[first:first + length].mean() > MOST_SILENT:
            continue
        own = late[first:first + length]
        begin = max(0, first - reach)
        wide = early[begin:first + length + reach]
        shift = _shift(own, wide, first - begin, limits.lag_likeness)
        if shift is not None:
            at.append(t[first + length // 2])
            lags.append(GRID * shift)
    return np.array(at), np.array(lags)


def _shift(own, wide, place, likeness):
    """Samples by which ``own``, at ``place`` of ``wide``, follows it; None if ambiguous."""
    n = len(own)
    own = own - own.mean()
    size = np.sqrt((own**2).sum())
    sums = np.concatenate([[0.0], np.cumsum(wide)])
    squares = np.concatenate([[0.0], np.cumsum(wide**2)])
    mean = (sums[n:] - sums[:-n]) / n
    spread = np.sqrt(np.maximum((squares[n:] - squares[:-n]) - n * mean**2, 1e-12))
    cross = np.correlate(wide, own, 'valid')
    alike = cross / (spread * max(size, 1e-9))
    k = int(np.argmax(alike))
    if alike[k] < likeness or not 0 < k < len(alike) - 1:
        return None
    far = np.abs(np.arange(len(alike)) - k) > 60
    if far.any() and alike[far].max() > SHARP * alike[k]:
        return None
    a, b, c = alike[k - 1:k + 2]
    bend = a - 2 * b + c
    part = 0.5 * (a - c) / bend if bend < 0 else 0.0
    return place - (k + part)


def _judged(recording, topic, other, what, whose, allowed, at, lags, limits):
    """A step, a drift, or a lag out of range."""
    if len(lags) < LEAST_WINDOWS:
        return None

    def damage(cause, moment=None):
        return Damage(recording.name, topic, cause,
                      None if moment is None else float(moment) - begin_of(recording))

    if len(lags) >= 2 * LEAST_WINDOWS:
        split, before, after, noise = change_point(lags)
        step = after - before
        large = max(limits.lag_step, limits.lag_noise * max(noise, LEAST_NOISE))
        line = np.polyfit(at, lags, 1)
        from_line = lags - np.polyval(line, at)
        levels = np.where(np.arange(len(lags)) < split, before, after)
        straight, stepped = (from_line**2).sum(), ((lags - levels)**2).sum()
        drift = line[0] * (at[-1] - at[0])
        least = max(limits.lag_step, limits.lag_noise * max(from_line.std(), LEAST_NOISE))
        if abs(drift) > least and straight < 0.7 * stepped:
            first, last = np.polyval(line, at[[0, -1]])
            return damage(f'the clock drifts against {other}: {what} lag behind {whose} by '
                          f'{first:.2f} s at first and by {last:.2f} s at the end: a clock that '
                          'runs at another rate, or a delay that grows'.replace(
                              'pose lag', 'pose lags'))
        sides = min(split, len(lags) - split)
        if abs(step) > large and sides >= LEAST_WINDOWS:
            moment = _onset(recording, topic, 0.5 * (at[split - 1] + at[split]), step,
                            limits.lag_window)
            return damage(f'the clock steps against {other}: {what} follow {whose} by '
                          f'{before:.2f} s before and by {after:.2f} s after'.replace(
                              'pose follow', 'pose follows'), moment)
    middle = float(np.median(lags))
    low, high = allowed
    if not low <= middle <= high and len(lags) >= 3:
        word = 'behind' if middle > 0 else 'ahead of'
        return damage(f'{what} are {abs(middle):.2f} s {word} {whose}, expected {low:g} to '
                      f'{high:g} s: the clock of {topic} or of {other} is off'.replace(
                          'pose are', 'pose is'))
    return None


def _onset(recording, topic, near, step, reach):
    """Start of a gap as long as the step near the middle of two windows, else that middle [s]."""
    stamps = series_of(recording, topic)[0]
    silences = np.diff(stamps)
    fits = (np.abs(stamps[:-1] - near) < reach) & (np.abs(silences - abs(step)) < 0.3 * abs(step))
    return float(stamps[:-1][fits][np.argmax(silences[fits])]) if fits.any() else near
