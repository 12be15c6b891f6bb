"""
Thrust and torque of a rotor over duty and pack voltage, as one surface.

The motor sees the mean voltage u = duty x voltage. With the induced voltage proportional to speed
w and thrust ~ w^2, u = a w + b w^2, so thrust is a smooth function of u that begins with u and
u^2. Terms with a further duty describe losses of the inverter. The pack may sag.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from beetle_omni_ros.identify.inference.noise import consecutive, interval, jackknife, linear
from beetle_omni_ros.identify.rotor.log import LEAST_ROWS, RotorLog

FORMS: tuple[tuple[tuple[int, int], ...], ...] = (
    ((1, 0), (2, 0)), ((1, 0), (2, 0), (3, 0)),
    ((1, 0), (2, 0), (3, 0), (2, 1), (3, 1)))   # powers of u and of the duty
GROUPS = 5              # of rows with neighbouring voltages, if packs are not labelled
LEAST_SWEEP = 0.1       # of the duty from stop 0 to full 1
LEAST_HEATING = 5.0     # [K] that shows a drift with temperature
BLOCKS = 40             # at most, whose scatter gives the intervals
LEAST_PACKS = 5         # that serve as blocks; fewer do not show the scatter
MAP_ROWS = 5            # of a robot file
BELOW = 0.1             # share by which its lowest voltage is below the measured ones
GRID = (1 - np.cos(np.linspace(0, np.pi, 101)[1:])) / 2     # dense at the ends, as errors are
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
    block = label if len(names) >= LEAST_PACKS else consecutive(changes, BLOCKS)
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
    running, found = rows['voltage'][rows['duty'] > 0.01], []
    for voltage in np.linspace(
            running.max(), (1 - BELOW) * running.min(), MAP_ROWS):
        duty = GRID * min(top, u / voltage)
        levels = thrust.at(duty, voltage)
        cubics = np.array([np.polyfit(level / 10, 50 + 50 * duty, 3, w=np.maximum(
            np.gradient(level, duty), 1e-3)) for level in levels.T])    # least error of thrust
        error = np.gradient(levels[:, 0], 50 * duty) * (
            np.polyval(cubics[0], levels[:, 0] / 10) - 50 - 50 * duty)
        found.append({
            'voltage_V': float(voltage), 'thrust_max_N': float(min(levels[-1, 0], most)),
            'coefficients': {f'c{k}': estimate(cubics[:, 3 - k], '%') for k in range(4)},
            'rms_N': float(np.sqrt(np.mean(error**2))),
            'thrust_half_width_N': float(max(np.ptp(interval(one)) for one in levels) / 2)})
    return found
