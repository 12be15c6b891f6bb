"""
Lag of thrust behind the command, and whether both belong together.

Thrust follows its static value with one time constant while it rises and another while it falls,
after a dead time. The static value is a curve over the command. In a log whose gain jumps, it is
the command times a gain of each window of time.
"""

import numpy as np

from beetle_omni_ros.identify.inference.hierarchy import design, solve, Spread, WIDTH
from beetle_omni_ros.identify.inference.noise import consecutive
from beetle_omni_ros.identify.rotor.log import RotorLog

FIRST = 0.05            # [s] time constant to start from
STARTS = (0.0, 0.05, 0.15, 0.3)     # [s] dead times to start from
LIMITS = np.log([0.001, 1.0])       # [log s] of a time constant
DEAD = 0.01             # [s] unit of the dead time
PHASE = 3.0             # units by which the windows may shift
BLOCKS = 20             # of a log, whose scatter gives the intervals
LOOSE = 5.0             # ratio of interval's end and value, from which a log does not show a lag
WIDE = (1.0, 1.0, 20.0, 1.0)    # prior standard deviations: time constants, dead time, gains
STEP = 1e-4             # of differences
GAIN_WINDOW = 0.5       # [s] with one gain between thrust and command
GAIN_SCATTER = 0.2      # between windows, beyond which both do not belong together ...
GAIN_SHARE = 0.7        # ... if the gains also lower the RMS error by this factor
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
        index = np.floor((time - time[0]) / GAIN_WINDOW + phase).astype(int)
        basis = curve[0] * (index == np.unique(index)[:, None])
        windows.append((*_static(log, basis, rest), basis, index))
    fine, least, basis, index = min(windows, key=lambda one: one[1])
    means = np.array([[values[index == k].mean() for values in (command, smooth, fine)]
                      for k in np.unique(index)]).T
    means = means[:, means[0] > STRONG * command.max()]
    ratio = means[2] / np.maximum(means[1], STRONG * smooth.max())
    if ratio.size < 4 or ratio.std() < GAIN_SCATTER * ratio.mean() \
            or least > GAIN_SHARE * rms:
        return _fitted(log, curve, rest, '')
    gains = means[2] / means[0] if log.command == 'target' else ratio
    return _fitted(log, basis[basis.any(axis=1)], rest, (
        f'thrust and command do not belong together: their ratio jumps about every '
        f'{GAIN_WINDOW:g} s ({gains.min():.2f} to {gains.max():.2f}); one curve leaves '
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

    Parameters: mean of the logarithms of both time constants, half their difference, dead time (in
    a log with windows their phase), gains in units of the largest thrust.
    """
    time, thrust = log.columns['time'], log.columns['thrust']
    count, size, noise = len(base) + 3, np.abs(thrust).max(), np.std(thrust) / 5 + 1e-4
    limits = [LIMITS, (-3, 3), (-PHASE, PHASE) if reason else (0, 50), *[(-9, 9)] * len(base)]
    low, high = np.array(limits).T
    centre = np.array([np.log(FIRST), 0, 0, *np.full(len(base), 0.5)])
    blocks = [consecutive(np.ones(log.fresh.sum(), dtype=bool), BLOCKS)]

    def predicted(points):
        lagged = respond(time, points[:, 3:] * size @ base + rest, *np.exp(
            [points[:, 0] + points[:, 1], points[:, 0] - points[:, 1]]))
        return np.array([np.interp(time - DEAD * dead, time, row)
                         for dead, row in zip(points[:, 2], lagged, strict=True)])

    def model(theta, active):
        moved = predicted(np.concatenate([theta, theta + STEP * np.eye(count)]))[:, log.fresh]
        return [(moved[0] - thrust[log.fresh]) / noise], [(moved[1:] - moved[0]) / STEP / noise]

    def fit(active, starts):
        s = design([Spread(wide, {}) for wide in WIDE[:3] + WIDE[3:] * len(base)],
                   {'log': (0,)}, active)
        tried = [solve(model, centre[None], s, (start - centre)[active] / s[0].sum(axis=1)[active],
                       blocks, low, high) for start in starts]
        return min(tried, key=lambda one: one.chi2 + one.x @ one.x)

    free = np.ones(count, dtype=bool)
    starts = np.tile(centre, (len(STARTS), 1))
    starts[:, 2] = np.array(STARTS) / DEAD * (not reason)
    for _ in range(3):
        best = fit(free, starts)
        starts = best.theta
        rms = noise = np.std((thrust - predicted(starts)[0])[log.fresh]) + 1e-4
    noise *= np.sqrt(best.inflation)
    best = fit(free, starts)
    dead = None if reason else _shown(best, np.eye(count)[2], DEAD)
    if dead and dead['interval'][0] <= 0:       # not shown by the log: the lags without it
        dead['interval'][0], free[2] = 0.0, False
        best = fit(free, best.theta)
    mean, half = np.eye(count)[:2]
    same = fit(free & (half == 0), best.theta)
    return {'log': log.name, **(_shown(same, mean) or {}), 'up': _shown(best, mean + half),
            'down': _shown(best, mean - half), 'dead_time': dead,
            'from_rest': bool(rest.any() and abs(rest[0]) < 0.05 * thrust.max()),
            'rms_N': float(rms), 'reason': reason, 'fitted': predicted(best.theta)[0]}


def _shown(fit, direction, unit=None):
    """Value and interval along a direction; of a logarithm without ``unit``; None: not shown."""
    value = fit.theta[0] @ direction
    half = WIDTH * np.sqrt(direction @ fit.spread()[0] @ direction)
    ends = np.array([value, value - half, value + half])
    if unit is None and half > np.log(LOOSE):
        return None
    value, *limits = map(float, np.exp(ends) if unit is None else ends * unit)
    return {'value': value, 'unit': 's', 'interval': limits}
