"""
Thrust and torque of a rotor over duty and pack voltage, as one surface.

The motor sees the mean voltage u = duty x voltage. With the induced voltage proportional to speed
w and thrust ~ w^2, u = a w + b w^2, so thrust is a smooth function of u that begins with u and u^2.
Terms with a further duty describe how the inverter's losses depend on it. The pack may sag.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from beetle_omni_ros.identify.inference.robust import consecutive, interval, jackknife, linear
from beetle_omni_ros.identify.parameters import shipped
from beetle_omni_ros.identify.rotor.log import RotorLog

P = shipped().rotor
FORMS = (((1, 0), (2, 0)), ((1, 0), (2, 0), (3, 0)),
         ((1, 0), (2, 0), (3, 0), (2, 1), (3, 1)))  # powers of u and of duty
GROUPS = 5              # of rows with neighbouring voltages, if packs are not labelled
GRID = (1 - np.cos(np.linspace(0, np.pi, 101)[1:])) / 2     # dense at the ends, as errors are


@dataclass(frozen=True, eq=False)
class Rows:
    """
    Settled rows (n,) of all logs; attributes as of :class:`RotorLog`.

    ``block`` is the block of each row for intervals, ``group`` what is left out together.
    """

    duty: np.ndarray
    voltage: np.ndarray
    thrust: np.ndarray
    torque: np.ndarray
    temperature: np.ndarray | None
    side: np.ndarray
    step: np.ndarray
    block: np.ndarray
    group: np.ndarray


@dataclass(frozen=True, eq=False)
class Surface:
    """
    A quantity over duty and voltage.

    Attributes:
        form: (K,) powers of u and of the duty.
        value: (K,) coefficients.
        left_out: (B, K) coefficients without each block.
        rms: RMS over rows.
        held_out: RMS of the means of settled steps at a voltage left out.

    """

    form: tuple[tuple[int, int], ...]
    value: np.ndarray
    left_out: np.ndarray
    rms: float
    held_out: float

    def at(self, duty, voltage, coefficients=None):
        """Value at ``duty`` (0 to 1) and ``voltage`` [V]."""
        return terms(self.form, duty, voltage) @ (
            self.value if coefficients is None else coefficients)


def terms(form, duty, voltage) -> np.ndarray:
    """(n, K) terms of a form."""
    return np.stack([(duty * voltage)**power * duty**more for power, more in form], axis=-1)


def settled_rows(logs: Sequence[RotorLog]) -> Rows | None:
    """Settled rows of the logs with a duty; None: too few, or no sweep."""
    parts = [log for log in logs if log.duty is not None]
    if sum(log.settled.sum() for log in parts) < P.least_rows:
        return None

    def joined(values):
        return np.concatenate([values(log)[log.settled] for log in parts])

    duty, voltage = joined(lambda log: log.duty), joined(lambda log: log.voltage)
    if np.ptp(duty) < P.least_sweep or np.unique(duty.round(2)).size < 5:
        return None
    several = not any(np.ptp(log.pack) for log in parts)
    pack = np.concatenate([log.pack[log.settled] + several * k for k, log in enumerate(parts)])
    names, label = np.unique(pack, return_inverse=True)
    changes = np.append(True, (np.diff(duty) != 0) | (np.diff(label) != 0))
    group = label if len(names) > 2 else np.digitize(
        voltage, np.quantile(voltage, np.arange(1, GROUPS) / GROUPS))
    with_heat = all(log.temperature is not None for log in parts)
    same_side = len({log.side.shape[1] for log in parts}) == 1
    return Rows(duty, voltage, joined(lambda log: log.thrust), joined(lambda log: log.torque),
                joined(lambda log: log.temperature) if with_heat else None,
                joined(lambda log: log.side if same_side else log.side[:, :0]),
                np.cumsum(changes),
                label if len(names) >= P.least_packs else consecutive(changes, P.blocks), group)


def fit_surface(rows: Rows, values: np.ndarray) -> Surface:
    """Fit thrust or torque; the form predicts voltages left out, the simplest one nearly best."""
    best, least = FORMS[0], np.inf
    for form in FORMS:
        x = terms(form, rows.duty, rows.voltage)
        error = np.empty(len(values))
        for group in np.unique(rows.group):
            out = rows.group == group
            error[out] = values[out] - x[out] @ linear(x[~out], values[~out])
        held_out = np.sqrt(np.mean(means(error, rows.step)**2))
        if held_out < P.simpler * least:
            best, least = form, held_out
    x = terms(best, rows.duty, rows.voltage)
    value = linear(x, values)
    return Surface(best, value, jackknife(lambda m: linear(x[m], values[m]), rows.block),
                   float(np.sqrt(np.mean((values - x @ value)**2))), float(least))


def means(values: np.ndarray, step: np.ndarray) -> np.ndarray:
    """Mean of the rows of each step."""
    return np.bincount(step, values)[np.unique(step)] / np.bincount(step)[np.unique(step)]


def torque_ratio(rows: Rows, thrust: Surface) -> dict:
    """
    Ratio of torque and thrust, and what could bias it.

    Torque is zero without thrust once the reading at rest is subtracted. A free offset would turn
    the larger ratio at small thrust into an offset and a smaller slope. The fitted thrust replaces
    the measured one, whose vibration would lower the ratio.
    """
    rest = rows.duty < 0.01
    tare = float(np.median(rows.torque[rest])) if rest.sum() >= 3 else 0.0
    fitted = thrust.at(rows.duty, rows.voltage)[:, None]
    value = linear(fitted, rows.torque - tare)[0]
    others = jackknife(lambda m: linear(fitted[m], rows.torque[m] - tare)[0], rows.block)
    result = {'value': float(value), 'unit': 'm', 'interval': interval(value, others).tolist(),
              'rms_N_m': float(np.sqrt(np.mean((rows.torque - tare - value * fitted[:, 0])**2))),
              'at_rest_N_m': tare if rest.sum() >= 3 else None,
              'with_free_offset': float(linear(np.append(fitted, 0 * fitted + 1, axis=1),
                                               rows.torque)[0]), 'cross_talk': None}
    if rows.side.shape[1]:
        x = np.append(fitted, rows.side, axis=1)
        corrected = linear(x, rows.torque - tare)
        rms = np.sqrt(np.mean((rows.torque - tare - x @ corrected)**2))
        result['cross_talk'] = {'value': float(corrected[0]), 'rms_N_m': float(rms)}
    return result


def temperature_drift(rows: Rows, thrust: Surface) -> dict | None:
    """Relative change of thrust with temperature at equal duty and voltage; None: not shown."""
    if rows.temperature is None or np.ptp(rows.temperature) < 5:
        return None
    x = terms(thrust.form, rows.duty, rows.voltage)
    middle = rows.temperature.mean()
    x = np.column_stack([x, (x @ thrust.value) * (rows.temperature - middle)])
    value = linear(x, rows.thrust)[-1]
    others = jackknife(lambda m: linear(x[m], rows.thrust[m])[-1], rows.block)
    return {'value': float(value), 'unit': '1/K', 'interval': interval(value, others).tolist(),
            'about_deg_C': float(middle),
            'range_deg_C': [float(rows.temperature.min()), float(rows.temperature.max())]}


def map_rows(rows: Rows, thrust: Surface, count: int = 5) -> list[dict]:
    """
    Rows of a robot file's map: cubics of the duty in thrust at voltages within the measured range.

    A row ends at the largest measured duty or mean voltage, whichever it reaches first.
    """
    top, u = rows.duty.max(), (rows.duty * rows.voltage).max()
    running = rows.voltage[rows.duty > 0.01]
    found = []
    for voltage in np.linspace(running.max(), running.min(), count):
        duty = GRID * min(top, u / voltage)
        levels = np.array([thrust.at(duty, voltage, c)
                           for c in (thrust.value, *thrust.left_out)])
        cubics = np.array([cubic(duty, level) for level in levels])
        last, slope = float(levels[0, -1]), np.gradient(levels[0], 50 * duty)
        error = (np.polyval(cubics[0], levels[0] / 10) - 50 - 50 * duty) * slope
        band = interval(levels[0], levels[1:])
        limits = interval(cubics[0], cubics[1:])
        rising = np.polyval(np.polyder(cubics[0]), np.linspace(0, last / 10, 100)).min() > 0
        found.append({
            'voltage_V': float(voltage), 'thrust_max_N': last,
            'coefficients': {f'c{k}': {'value': float(cubics[0][3 - k]), 'unit': '%',
                                       'interval': limits[3 - k].tolist()} for k in range(4)},
            'rms_N': float(np.sqrt(np.mean(error**2))),
            'thrust_half_width_N': float(np.diff(band).max() / 2), 'monotone': bool(rising)})
    return found


def cubic(duty: np.ndarray, thrust: np.ndarray) -> np.ndarray:
    """Cubic of the duty [% of 2000 us] in thrust / 10 N, with least error of thrust."""
    slope = np.maximum(np.gradient(thrust, duty), 1e-3)
    return np.polyfit(thrust / 10, 50 + 50 * duty, 3, w=slope)
