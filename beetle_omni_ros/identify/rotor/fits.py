"""
Thrust and torque of a rotor over duty and pack voltage, as one surface, and the lag of thrust.

The motor sees the mean voltage u = duty x voltage. With the induced voltage proportional to speed
w and thrust ~ w^2, u = a w + b w^2, so thrust is a smooth function of u that begins with u and
u^2. Terms with a further duty describe losses of the inverter. The pack may sag.

Thrust follows its static value with one time constant while it rises and another while it falls,
after a dead time. The static value is a curve over the command. In a log whose gain jumps, thrust
and command do not belong together: it is the command times a gain of each window of time.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from beetle_omni_ros.identify.inference.hierarchy import design, solve, Spread, WIDTH
from beetle_omni_ros.identify.inference.noise import consecutive, interval, jackknife, linear
from beetle_omni_ros.identify.rotor.log import LEAST_ROWS, RotorLog

FORMS: tuple[tuple[tuple[int, int], ...], ...] = (
    ((1, 0), (2, 0)), ((1, 0), (2, 0), (3, 0)),
    ((1, 0), (2, 0), (3, 0), (2, 1), (3, 1)))   # powers of u and of the duty
GROUPS = 5              # of rows with neighbouring voltages, if packs are not labelled
LEAST_SWEEP = 0.1       # of the duty from stop 0 to full 1
LEAST_HEATING = 5.0     # [K] that shows a drift with temperature
SURFACE_BLOCKS = 40     # at most, whose scatter gives the intervals
LEAST_PACKS = 5         # that serve as blocks; fewer do not show the scatter
MAP_ROWS = 5            # of a robot file
BELOW = 0.1             # share by which its lowest voltage is below the measured ones
GRID = (1 - np.cos(np.linspace(0, np.pi, 101)[1:])) / 2     # dense at the ends, as errors are
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
Rows = dict[str, np.ndarray]


@dataclass(frozen=True, eq=False)
class Surface:
    """
    A quantity over duty and voltage.

    Attributes:
        form: (K,) powers of u and of the duty.
        every: (1 + B, K) coefficients of all rows, and without each block.
        rms: RMS over rows.
        left_out: RMS of the means of settled steps at a voltage left out.

    """

    form: tuple[tuple[int, int], ...]
    every: np.ndarray
    rms: float
    left_out: float

    def at(self, duty, voltage):
        """(..., 1 + B) values at ``duty`` (0 to 1) and ``voltage`` [V]."""
        return terms(self.form, duty, voltage) @ self.every.T


def terms(form, duty, voltage) -> np.ndarray:
    """(..., K) terms of a form."""
    return np.stack([(duty * voltage)**power * duty**more for power, more in form], axis=-1)


def settled_rows(logs: Sequence[RotorLog]) -> Rows | None:
    """
    Columns of the settled rows of logs with a duty; None: too few, or no sweep.

    ``step`` numbers held commands, ``block`` what intervals leave out, ``group`` the voltages.
    """
    logs = [log for log in logs if log.command == 'duty']
    shared = [name for name in ('duty', 'voltage', 'thrust', 'torque', 'temperature')
              if all(name in log.columns for log in logs)]
    if not logs or sum(log.settled.sum() for log in logs) < LEAST_ROWS:
        return None
    rows = {name: np.concatenate([log.columns[name][log.settled] for log in logs])
            for name in shared}
    if np.ptp(rows['duty']) < LEAST_SWEEP or np.unique(rows['duty'].round(2)).size < 5:
        return None
    # Without labels, each log has its own pack.
    pack = np.concatenate([log.columns.get('pack', np.full(len(log.settled), -k))[log.settled]
                           for k, log in enumerate(logs)])
    names, label = np.unique(pack, return_inverse=True)
    changes = np.append(True, (np.diff(rows['duty']) != 0) | (np.diff(label) != 0))
    block = label if len(names) >= LEAST_PACKS else consecutive(changes, SURFACE_BLOCKS)
    group = label if len(names) > 2 else np.digitize(rows['voltage'], np.quantile(
        rows['voltage'], np.arange(1, GROUPS) / GROUPS))
    return rows | {'step': np.cumsum(changes) - 1, 'block': block,
                   'group': group if np.ptp(group) else block}      # a supply of one voltage


def fit_surface(rows: Rows, name: str) -> Surface:
    """Fit thrust or torque by the form that predicts voltages left out best."""
    values, best, least = rows[name], FORMS[0], np.inf
    for form in FORMS:
        x, error = terms(form, rows['duty'], rows['voltage']), np.empty(len(values))
        for group in np.unique(rows['group']):
            out = rows['group'] == group
            error[out] = values[out] - x[out] @ linear(x[~out], values[~out])
        left_out = np.sqrt(np.mean(means(error, rows['step'])**2))
        if left_out < least:
            best, least = form, left_out
    x = terms(best, rows['duty'], rows['voltage'])
    every = jackknife(lambda m: linear(x[m], values[m]), rows['block'])
    return Surface(best, every, float(np.sqrt(np.mean((values - x @ every[0])**2))), float(least))


def means(values: np.ndarray, step: np.ndarray) -> np.ndarray:
    """Mean of the rows of each step."""
    return np.bincount(step, values) / np.bincount(step)


def estimate(every: np.ndarray, unit: str = '') -> dict:
    """Plain data of a value with interval; ``every`` (1 + B,) with the value of all rows first."""
    return {'value': float(every[0]), 'unit': unit, 'interval': interval(every).tolist()}


def torque_ratio(rows: Rows) -> dict:
    """
    Ratio of torque and thrust, by the means of settled steps, whose vibration has no effect.

    Torque is zero without thrust once the reading at rest is subtracted. A free offset would take
    up the larger ratio at small thrust, and lower the slope.
    """
    first = np.unique(rows['step'], return_index=True)[1]
    rest, block = rows['duty'][first] < 0.01, rows['block'][first]
    thrust, torque = (means(rows[name], rows['step']) for name in ('thrust', 'torque'))
    size = np.bincount(rows['step'])

    def fit(mask):
        still = rest & mask
        tare = np.average(torque[still], weights=size[still]) if still.any() else 0.0
        return np.array([linear(thrust[mask, None], torque[mask] - tare)[0], tare])

    every = jackknife(fit, block)
    offset = np.column_stack([thrust, np.ones(len(thrust))])
    return {**estimate(every[:, 0], 'm'),
            'at_rest_N_m': float(every[0, 1]) if rest.any() else None,
            'with_free_offset': float(linear(offset, torque)[0])}


def temperature_drift(rows: Rows, thrust: Surface) -> dict | None:
    """Relative change of thrust with temperature at equal duty and voltage; None: not shown."""
    if 'temperature' not in rows or np.ptp(rows['temperature']) < LEAST_HEATING:
        return None
    heat = rows['temperature'] - rows['temperature'].mean()
    x = np.column_stack([terms(thrust.form, rows['duty'], rows['voltage']),
                         thrust.at(rows['duty'], rows['voltage'])[:, 0] * heat])
    every = jackknife(lambda m: linear(x[m], rows['thrust'][m])[-1], rows['block'])
    return estimate(every, '1/K')


def map_rows(rows: Rows, thrust: Surface) -> list[dict]:
    """
    Rows of a robot file's map: cubics of the duty in thrust at measured voltages and below.

    A pack of a flight falls below those of a stand. Its u is smaller, so that u is in the range.

    A row ends at the largest measured duty, mean voltage or thrust, whichever it reaches first.
    """
    top, u = rows['duty'].max(), (rows['duty'] * rows['voltage']).max()
    most = means(rows['thrust'], rows['step']).max()
    running, plateaus = rows['voltage'][rows['duty'] > 0.01], []
    for voltage in np.linspace(
            running.max(), (1 - BELOW) * running.min(), MAP_ROWS):
        duty = GRID * min(top, u / voltage)
        levels = thrust.at(duty, voltage)
        cubics = np.array([np.polyfit(level / 10, 50 + 50 * duty, 3, w=np.maximum(
            np.gradient(level, duty), 1e-3)) for level in levels.T])    # least error of thrust
        error = np.gradient(levels[:, 0], 50 * duty) * (
            np.polyval(cubics[0], levels[:, 0] / 10) - 50 - 50 * duty)
        plateaus.append({
            'voltage_V': float(voltage), 'thrust_max_N': float(min(levels[-1, 0], most)),
            'coefficients': {f'c{k}': estimate(cubics[:, 3 - k], '%') for k in range(4)},
            'rms_N': float(np.sqrt(np.mean(error**2))),
            'thrust_half_width_N': float(max(np.ptp(interval(one)) for one in levels) / 2)})
    return plateaus


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
