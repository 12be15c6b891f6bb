"""
Lag of thrust behind the command, and whether both belong together.

Thrust follows its static value with one time constant while it rises and another while it falls,
after a dead time. The static value is a gain times the command; in a log whose gain jumps, each
window of time has its own gain.
"""

from dataclasses import dataclass

import numpy as np
from scipy.stats import t as student

from beetle_omni_ros.identify.inference.least_squares import huber, minimise
from beetle_omni_ros.identify.inference.prior import Prior
from beetle_omni_ros.identify.inference.robust import consecutive, scatter
from beetle_omni_ros.identify.parameters import shipped
from beetle_omni_ros.identify.rotor.log import RotorLog

P = shipped().rotor
FIRST = 0.05            # [s] time constant of the first fit
DEAD = 0.01             # [s] unit of the dead time
STARTS = (0.0, 0.05, 0.15, 0.3)     # [s] dead times from which the fit begins
BLOCKS = 20             # of a log, whose scatter gives the intervals
LOOSE = 5.0             # ratio of interval's end and value, from which a log does not show a lag
LOW, HIGH = np.log(0.001), np.log(1.0)
STEP = 1e-4             # of differences
WEAK = 100.0            # deviation of a gain or ratio that a log does not show
PHASES = 10             # of the windows


@dataclass(frozen=True, eq=False)
class Lag:
    """
    Lag of one log; dictionaries have value, unit and interval, None: the log does not show it.

    Attributes:
        log: name of the log.
        both, up, down, dead_time: time constants (equal, rising, falling) and dead time [s].
        reason: why thrust and command do not belong together; empty: they do.
        rms: RMS error of thrust [N]; with one gain, and as fitted.
        gains: (K,) thrust over command of each window, if each has its own.
        from_rest: whether the rotor started from rest.
        fitted: (N,) thrust of the model [N].

    """

    log: str
    both: dict | None
    up: dict | None
    down: dict | None
    dead_time: dict | None
    reason: str
    rms: tuple[float, float]
    gains: np.ndarray
    from_rest: bool
    fitted: np.ndarray

    def result(self) -> dict:
        """Plain data."""
        return {'log': self.log, **(self.both or {}), 'up': self.up, 'down': self.down, 'dead_time': self.dead_time,
                'from_rest': self.from_rest, 'rms_N': self.rms[1], 'one_gain_rms_N': self.rms[0],
                'window_gains': self.gains.tolist(), 'reason': self.reason or None}


def respond(time, static, up, down):
    """(M, N) thrust of M models with time constants (M,) for held static thrusts (M, N)."""
    thrust = np.empty_like(static)
    thrust[:, 0] = level = static[:, 0]
    for k, step in enumerate(np.diff(time), start=1):
        error = static[:, k - 1] - level
        level = level + error * -np.expm1(-step / np.where(error > 0, up, down))
        thrust[:, k] = level
    return thrust


def fit_lag(log: RotorLog) -> Lag | None:
    """Fit a time series; None: it is too short, or its thrust does not move."""
    command = log.command
    raw = log.asked if log.duty is None else log.duty
    first = np.flatnonzero(raw != raw[0])   # before it, the thrust is the settled one
    if len(command) < P.least_rows or not first.size:
        return None
    held = np.arange(len(command)) < (first[0] if first[0] >= 3 else 0)
    command = np.where(held, 0, command)
    rest = float(np.median(log.thrust[held])) if held.any() else 0.0
    powers = min(3, np.unique(raw[~held].round(3)).size)
    one = np.stack([command**k / np.abs(command).max()**(k - 1) for k in range(1, powers + 1)])
    if log.duty is not None and powers == 3:
        one = one[:2]       # thrust over mean voltage has no further term
    base, own, reason, gains = one, False, '', np.zeros(0)
    (smooth, rms), (windowed, fine, index, scale) = _gains(log, one, rest * held), _windows(
        log, one, rest * held)
    if log.time[-1] > 6 * P.gain_window:
        reason, gains = _apart(log, command, smooth, rms, fine, index, scale)
        own = bool(reason)
        base = windowed if own else one
    return _fitted(log, base, rest * held, reason, gains, rms)


def _gains(log, basis, rest):
    """Static thrust with the least error behind a lag of FIRST, and its RMS."""
    lagged = _lagged(log, basis)
    residual = log.thrust - _lagged(log, rest[None])[0]
    gains = np.linalg.lstsq(lagged[:, log.fresh].T, residual[log.fresh], rcond=None)[0]
    error = (residual - gains @ lagged)[log.fresh]
    return gains @ basis + rest, float(np.sqrt(np.mean(error**2)))


def _lagged(log, rows):
    same = np.full(len(rows), FIRST)
    return respond(log.time, rows, same, same)


def _windows(log, one, rest):
    """Commands of windows of the phase with the least error; RMS, window of each row, gains."""
    best = None
    for phase in np.arange(PHASES) / PHASES:
        index = np.floor(log.time / P.gain_window + phase).astype(int)
        basis = one[0] * (index == np.arange(index[-1] + 1)[:, None])
        basis = basis[np.abs(basis).sum(axis=1) > 0]
        static, rms = _gains(log, basis, rest)
        if best is None or rms < best[1]:
            best = basis, rms, index, static
    return best


def _apart(log, command, smooth, rms, fine, index, static):
    """Reason why thrust and command do not belong together, and gains of the windows."""
    means = np.array([[values[index == k].mean() for values in (command, smooth, static)]
                      for k in np.unique(index)]).T
    gains = means[2] / np.maximum(means[0], 1e-9)
    strong = means[0] > 0.2 * command.max()
    ratio = means[2][strong] / np.maximum(means[1][strong], 0.05 * smooth.max())
    scatter = ratio.std() / ratio.mean()
    if strong.sum() < 4 or scatter < P.gain_scatter or fine > P.gain_share * rms:
        return '', gains
    shown = gains[strong] if log.duty is None else ratio
    return (f'thrust and command do not belong together: their ratio jumps about every '
            f'{P.gain_window:g} s ({shown.min():.2f} to {shown.max():.2f}); one curve leaves '
            f'{rms:.2f} N RMS, a gain for each window {fine:.2f} N'), gains


def _fitted(log, base, rest, reason, gains, one_rms):
    """
    Time constants, dead time and gains together.

    Points: mean of the logarithms of both time constants, half their difference, dead time, gains.
    """
    # In a log with windows, the dead time also corrects the phase of the windows.
    first, fixed = (-3 if reason else 0), ()
    count, size = len(base) + 3, np.abs(log.thrust).max() / np.abs(base).max(axis=1)
    weak = Prior(np.append([np.inf, WEAK, np.inf], np.full(len(base), WEAK)))

    def model(points):
        thrust = respond(log.time, points[:, 3:] * size @ base + rest, *np.exp(
            [points[:, 0] + points[:, 1], points[:, 0] - points[:, 1]]))
        return np.stack([np.interp(log.time - DEAD * dead, log.time, row)
                         for dead, row in zip(points[:, 2], thrust, strict=True)])

    def residual(points, _):
        return huber((log.thrust - model(points)) / noise) * log.fresh

    def slopes(points, start):
        moved = residual((points[:, None] + STEP * np.eye(count)).reshape(-1, count), None)
        return (moved.reshape(len(points), count, -1) - start[:, None]) / STEP

    def solve(points, fixed):
        free = ~np.isin(np.arange(count), fixed)
        fits = minimise(points, np.tile(free, (len(points), 1)),
                        np.array([LOW, -3, first, *[-9] * len(base)]),
                        np.array([HIGH, 3, 50, *[9] * len(base)]), residual,
                        lambda here, _, start: slopes(here, start) * free[:, None], weak, 60)
        best = fits.points[[np.argmin(fits.chi2)]]
        error = residual(best, None)
        return best, scatter(slopes(best, error)[0] * free[:, None], error[0], weak.slope(best[0]),
                             consecutive(np.ones(len(base[0]), dtype=bool), BLOCKS))

    start = np.tile([np.log(FIRST), 0, 0, *np.full(len(base), 0.5)], (1 if reason else 4, 1))
    start[:, 2] = np.array(STARTS[:len(start)]) / DEAD
    noise = np.std(log.thrust) / 5 + 1e-4
    for _ in range(3):
        start, wide = solve(start, fixed)
        noise = np.std((log.thrust - model(start)[0])[log.fresh]) + 1e-4
    dead = None if reason else _shown(start[0, 2], wide, np.eye(count)[2], DEAD)
    if dead and dead['interval'][0] <= 0:       # not shown by the log: the lags without it
        dead['interval'][0], start[0, 2], fixed = 0.0, 0, (2,)
        start, wide = solve(start, fixed)
    same, wide_same = solve(start * np.array([1, 0, *np.ones(count - 2)]), (1, *fixed))
    pair = np.eye(count)[:2]
    lags = [_shown(same[0, 0], wide_same, pair[0]),
            *(_shown(start[0] @ way, wide, way) for way in (pair.sum(0), pair[0] - pair[1]))]
    fitted = model(start)[0]
    rms = float(np.sqrt(np.mean((log.thrust - fitted)[log.fresh]**2)))
    return Lag(log.name, *lags, dead, reason, (one_rms, rms), gains if reason else np.zeros(0),
               bool(rest.any() and abs(rest[0]) < 0.05 * log.thrust.max()), fitted)


def _shown(value, wide, direction, unit=None):
    """Value and interval along a direction; of a logarithm without ``unit``; None: not shown."""
    half = np.sqrt(np.max(direction @ wide @ direction)) * student.ppf(0.975, BLOCKS - 1)
    ends = np.array([value, value - half, value + half])
    if unit is None and half > np.log(LOOSE):
        return None
    value, *ends = map(float, np.exp(ends) if unit is None else ends * unit)
    return {'value': value, 'unit': 's', 'interval': ends}
