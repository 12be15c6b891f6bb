"""
Lag of thrust behind the command, and whether both belong together.

Thrust follows its static value with one time constant while it rises and another while it falls,
after a dead time. The static value is a curve over the command. In a log whose gain jumps, it is
the command times a gain of each window of time.
"""

import numpy as np
from scipy.optimize import least_squares
from scipy.stats import t as student

from beetle_omni_ros.identify.inference.prior import Prior
from beetle_omni_ros.identify.inference.robust import consecutive, huber, scatter
from beetle_omni_ros.identify.parameters import shipped
from beetle_omni_ros.identify.rotor.log import RotorLog

FIRST = 0.05            # [s] time constant to start from
STARTS = (0.0, 0.05, 0.15, 0.3)     # [s] dead times to start from
LIMITS = np.log([0.001, 1.0])       # [log s] of a time constant
DEAD = 0.01             # [s] unit of the dead time
PHASE = 3.0             # units by which the windows may shift
BLOCKS = 20             # of a log, whose scatter gives the intervals
LOOSE = 5.0             # ratio of interval's end and value, from which a log does not show a lag
WEAK = 100.0            # deviation of a gain or ratio that a log does not show
STEP = 1e-4             # of differences
PHASES = 10             # of the windows
STRONG = 0.2            # share of the largest command, above which the gain of a window is used


def respond(time, static, up, down):
    """(M, N) thrust of M models with time constants (M,) for held static thrusts (M, N)."""
    thrust = np.empty_like(static)
    thrust[:, 0] = level = static[:, 0]
    for k, step in enumerate(np.diff(time), start=1):
        error = static[:, k - 1] - level
        level = level + error * -np.expm1(-step / np.where(error > 0, up, down))
        thrust[:, k] = level
    return thrust


def fit_lag(log: RotorLog) -> dict | None:
    """
    Fit a time series; None: settled rows, or a command that does not change.

    A lag that the log does not show is None. ``reason`` is why thrust and command do not belong
    together, or empty; ``fitted`` (N,) is the thrust of the model [N].
    """
    raw = command = log.columns[log.command]
    if not log.series or not np.ptp(raw) or raw.max() <= 0:
        return None
    if log.command == 'duty':
        command = raw * log.columns['voltage']      # mean voltage at the motor
    # Thrust before the first change of the command is the settled one, at rest 0.
    first = int(np.argmax(raw != raw[0]))
    held = np.arange(len(raw)) < (first if first >= 3 else 0)
    command = np.where(held, 0, command)
    rest = held * (float(np.median(log.columns['thrust'][held])) if held.any() else 0.0)
    powers = min(2 if log.command == 'duty' else 3, np.unique(raw[~held].round(3)).size)
    curve = np.array([(command / command.max())**k for k in range(1, powers + 1)])
    smooth, rms = _static(log, curve, rest)
    time, windows = log.columns['time'], []
    for phase in np.arange(PHASES) / PHASES:
        index = np.floor((time - time[0]) / shipped().rotor.gain_window + phase).astype(int)
        basis = curve[0] * (index == np.unique(index)[:, None])
        windows.append((*_static(log, basis, rest), basis, index))
    fine, least, basis, index = min(windows, key=lambda one: one[1])
    means = np.array([[values[index == k].mean() for values in (command, smooth, fine)]
                      for k in np.unique(index)]).T
    means = means[:, means[0] > STRONG * command.max()]
    ratio = means[2] / np.maximum(means[1], STRONG * smooth.max())
    p = shipped().rotor
    if ratio.size < 4 or ratio.std() < p.gain_scatter * ratio.mean() \
            or least > p.gain_share * rms:
        return _fitted(log, curve, rest, '')
    gains = means[2] / means[0] if log.command == 'target' else ratio
    return _fitted(log, basis[basis.any(axis=1)], rest, (
        f'thrust and command do not belong together: their ratio jumps about every '
        f'{p.gain_window:g} s ({gains.min():.2f} to {gains.max():.2f}); one curve leaves '
        f'{rms:.2f} N RMS, a gain for each window {least:.2f} N'))


def _static(log, basis, rest):
    """Static thrust with the least error behind a lag of FIRST, and the RMS error."""
    rows = np.append(basis, rest[None], axis=0)
    lagged = respond(log.columns['time'], rows, np.full(len(rows), FIRST), FIRST)
    target = log.columns['thrust'] - lagged[-1]
    gains = np.linalg.lstsq(lagged[:-1, log.fresh].T, target[log.fresh], rcond=None)[0]
    error = (target - gains @ lagged[:-1])[log.fresh]
    return gains @ basis + rest, float(np.sqrt(np.mean(error**2)))


def _fitted(log, base, rest, reason):
    """
    Time constants, dead time and gains together.

    Points: mean of the logarithms of both time constants, half their difference, dead time (in a
    log with windows also their phase), gains.
    """
    time, thrust = log.columns['time'], log.columns['thrust']
    count, size = len(base) + 3, np.abs(thrust).max()
    weak = Prior(np.append([np.inf, WEAK, np.inf], np.full(len(base), WEAK)))
    low = np.array([LIMITS[0], -3, -PHASE if reason else 0, *[-9] * len(base)])
    high = np.array([LIMITS[1], 3, 50, *[9] * len(base)])
    blocks = consecutive(np.ones(len(time), dtype=bool), BLOCKS)

    def model(points):
        lagged = respond(time, points[:, 3:] * size @ base + rest, *np.exp(
            [points[:, 0] + points[:, 1], points[:, 0] - points[:, 1]]))
        return np.array([np.interp(time - DEAD * dead, time, row)
                         for dead, row in zip(points[:, 2], lagged, strict=True)])

    def residual(points, _):
        return huber((thrust - model(points)) / noise)[0] * log.fresh

    def slopes(points, start, free):
        moved = residual((points[:, None] + STEP * np.eye(count)).reshape(-1, count), None)
        return (moved.reshape(len(points), count, -1) - start[:, None]) / STEP * free[:, None]

    def solve(points, fixed):
        free = ~np.isin(np.arange(count), fixed)

        def full(part):
            point = points[:1].copy()
            point[0, free] = part
            return point

        def errors(part):
            return np.append(residual(full(part), None), weak.residual(full(part))[0, free])

        def derivatives(part):
            point = full(part)
            moved = slopes(point, residual(point, None), free)[0, free]
            return np.vstack([moved.T, np.diag(weak.slope(point)[0, free])])

        fits = [least_squares(errors, start, derivatives, (low[free], high[free]), x_scale='jac',
                              max_nfev=60) for start in np.clip(points, low, high)[:, free]]
        best = full(min(fits, key=lambda one: one.cost).x)
        error = residual(best, None)
        return best, scatter(slopes(best, error, free)[0], error[0], weak.slope(best[0]), blocks)

    points = np.tile([np.log(FIRST), 0, 0, *np.full(len(base), 0.5)], (len(STARTS), 1))
    points[:, 2] = np.array(STARTS) / DEAD * (not reason)
    noise, fixed = np.std(thrust) / 5 + 1e-4, np.zeros(0)
    for _ in range(3):
        points, wide = solve(points, fixed)
        noise = np.std((thrust - model(points)[0])[log.fresh]) + 1e-4
    dead = None if reason else _shown(points[0, 2], wide, np.eye(count)[2], DEAD)
    if dead and dead['interval'][0] <= 0:       # not shown by the log: the lags without it
        dead['interval'][0], points[0, 2], fixed = 0.0, 0, np.array([2])
        points, wide = solve(points, fixed)
    same, wide_same = solve(points * np.array([1, 0, *np.ones(count - 2)]), [1, *fixed])
    mean, half = np.eye(count)[:2]
    return {'log': log.name, **(_shown(same[0, 0], wide_same, mean) or {}),
            'up': _shown(points[0] @ (mean + half), wide, mean + half),
            'down': _shown(points[0] @ (mean - half), wide, mean - half), 'dead_time': dead,
            'from_rest': bool(rest.any() and abs(rest[0]) < 0.05 * thrust.max()),
            'rms_N': float(noise), 'reason': reason, 'fitted': model(points)[0]}


def _shown(value, wide, direction, unit=None):
    """Value and interval along a direction; of a logarithm without ``unit``; None: not shown."""
    half = np.sqrt(np.max(direction @ wide @ direction)) * student.ppf(0.975, BLOCKS - 1)
    ends = np.array([value, value - half, value + half])
    if unit is None and half > np.log(LOOSE):
        return None
    value, *limits = map(float, np.exp(ends) if unit is None else ends * unit)
    return {'value': value, 'unit': 's', 'interval': limits}
