"""
Rotor map from bench data: duty = c0 + c1 g + c2 g^2 + c3 g^3 with g = thrust / 10 N.

The measured thrust is noisy, the duty is exact. A regression of duty on noisy thrust would be
biased, so the inverse of the polynomial is fitted and residuals are thrusts.
"""

from dataclasses import dataclass

import numpy as np

from beetle_omni_ros.identify.inference.least_squares import differences, minimise, soft_l1, Steps
from beetle_omni_ros.identify.inference.prior import UNKNOWN
from beetle_omni_ros.identify.parameters import shipped
from beetle_omni_ros.identify.rotor_log import Plateau, RotorLog
from beetle_omni_ros.runs.csv_table import LogError

UNIT_THRUST = 10.0      # [N] for g = 1
NORMAL_95 = 1.96
GRID = 400


@dataclass(frozen=True)
class MapRow:
    """
    One fitted row of the map.

    Attributes:
        voltage: voltage [V].
        thrust_max: largest measured thrust [N].
        coefficients: (4,) c0 to c3 [%].
        intervals: (4, 2) 95 % intervals.
        rms: RMS of thrust minus fit [N].
        half_width: largest half width of the curve's 95 % band between 1 N and the maximum [N].
        inverse_error: largest relative error of thrust -> duty -> thrust over the range.
        rows: number of fitted rows.
        held: whether the bound on the slope was active.

    """

    voltage: float
    thrust_max: float
    coefficients: np.ndarray
    intervals: np.ndarray
    rms: float
    half_width: float
    inverse_error: float
    rows: int
    held: bool

    def duty(self, thrust: np.ndarray) -> np.ndarray:
        """Duty [%] for thrust [N]."""
        return np.polyval(self.coefficients[::-1], np.asarray(thrust) / UNIT_THRUST)

    def thrust(self, duty: np.ndarray) -> np.ndarray:
        """Thrust [N] at a duty [%], between 0 and the largest measured one."""
        return inverse(self.coefficients, duty, self.thrust_max)


@dataclass(frozen=True)
class Ratio:
    """Torque over thrust [m], its 95 % interval, offset of the stand [N m] and RMS [N m]."""

    value: float
    interval: tuple[float, float]
    tare: float
    rms: float


def inverse(coefficients: np.ndarray, duty: np.ndarray, thrust_max: float) -> np.ndarray:
    """Thrust [N] of a monotone polynomial at a duty [%]: table, then two Newton steps."""
    grid = np.linspace(0, thrust_max / UNIT_THRUST, GRID)
    g = np.interp(duty, np.polyval(coefficients[::-1], grid), grid)
    slope = np.polyder(coefficients[::-1])
    inside = (g > 0) & (g < grid[-1])
    for _ in range(2):
        step = (np.polyval(coefficients[::-1], g) - duty) / np.maximum(
            np.polyval(slope, g), shipped().rotor.least_slope / 10)
        g = np.where(inside, np.clip(g - step, 0, grid[-1]), g)
    return UNIT_THRUST * g


def fit_row(name: str, plateau: Plateau) -> MapRow:
    """
    Fit the map at one voltage.

    Raises:
        LogError: the sweep is too small, or thrust does not increase with duty.

    """
    used = plateau.duty > shipped().rotor.stop_duty
    duty, g = plateau.duty[used], plateau.force[used] / UNIT_THRUST
    if used.sum() < 12 or np.unique(np.round(duty, 1)).size < 5:
        raise LogError(f'{name}: at {plateau.voltage:.2f} V only {used.sum()} rows of '
                       f'{np.unique(np.round(duty, 1)).size} duties above stop; expected a sweep')
    if np.corrcoef(duty, g)[0, 1] < 0.8:
        raise LogError(f'{name}: at {plateau.voltage:.2f} V thrust does not rise with duty; '
                       'are the columns in the right units?')
    top = 1.3 * g.max()
    coefficients = _start(g, duty)
    weight = np.ones(len(g))
    for _ in range(3):
        scale = 3 * 1.4826 * np.median(np.abs(_error(coefficients, g, duty, weight)[:len(g)]))
        coefficients = _fitted(coefficients, g, duty, weight, scale + 1e-6)
        fitted = inverse(coefficients, duty, UNIT_THRUST * top) / UNIT_THRUST
        weight = _weights(fitted, fitted - g)
    slopes = np.polyval(np.polyder(coefficients[::-1]), np.linspace(0, g.max(), GRID))
    if slopes.min() <= 0:
        raise LogError(f'{name}: at {plateau.voltage:.2f} V no rising map fits the data')
    residual = fitted - g
    covariance = _covariance(coefficients, fitted, residual * weight, weight)
    size = NORMAL_95 * np.sqrt(np.diag(covariance))
    # The row ends at the largest duty, not at the largest noisy force.
    last = float(UNIT_THRUST * fitted.max())
    thrust = np.linspace(min(1.0, last / 2), last, GRID)
    band = _band(coefficients, covariance, thrust / UNIT_THRUST)
    row = MapRow(plateau.voltage, last, coefficients,
                 np.stack([coefficients - size, coefficients + size], axis=1),
                 float(UNIT_THRUST * np.sqrt(np.mean(residual**2))),
                 float(NORMAL_95 * UNIT_THRUST * band.max()), 0.0, int(used.sum()),
                 bool(slopes.min() < 1.5 * shipped().rotor.least_slope))
    back = row.thrust(row.duty(thrust))
    return MapRow(**{**row.__dict__, 'inverse_error': float(np.abs(back / thrust - 1).max())})


def _start(g, duty):
    """Coefficients of an increasing polynomial near the data."""
    run = g > 0.02
    start = np.polyfit(g[run], duty[run], 3)[::-1]
    slope = np.polyval(np.polyder(start[::-1]), np.linspace(0, g.max(), 60))
    if slope.min() < shipped().rotor.least_slope:
        start = np.array([*np.polyfit(g[run], duty[run], 1)[::-1], 0.0, 0.0])
    return start


def _fitted(start, g, duty, weight, scale):
    """Coefficients of a fit with a soft L1 loss of this ``scale``."""
    def residual(points, _):
        return np.array([soft_l1(_error(point, g, duty, weight), scale) for point in points])

    end = np.full(len(start), np.inf)
    return minimise(start[None], np.full((1, len(start)), True), -end, end, residual,
                    differences(residual, 1e-7), UNKNOWN, 100, Steps(1e-12, np.inf)).points[0]


def _error(coefficients, g, duty, weight):
    """Weighted error of g, then the violation of the least slope."""
    slope = np.polyval(np.polyder(coefficients[::-1]), np.linspace(0, 1.05 * g.max(), 60))
    missing = np.minimum(slope - shipped().rotor.least_slope, 0)
    fitted = inverse(coefficients, duty, UNIT_THRUST * 1.3 * g.max()) / UNIT_THRUST
    return np.concatenate([weight * (fitted - g), 0.3 * missing])


def _weights(g, residual):
    """Weights for noise that is linear in thrust, from the residuals."""
    size = np.minimum(np.abs(residual), 4 * np.median(np.abs(residual)))
    slope, level = np.polyfit(g, size, 1)
    spread = np.maximum(level + slope * g, 0.15 * size.mean() + 1e-6)
    return spread.mean() / spread


def _slopes(coefficients, g):
    """(N, 4) derivative of g by each coefficient at constant duty."""
    slope = np.maximum(np.polyval(np.polyder(coefficients[::-1]), g),
                       shipped().rotor.least_slope / 10)
    return -np.stack([g**k for k in range(4)], axis=1) / slope[:, None]


def _covariance(coefficients, g, residual, weight):
    jacobian = _slopes(coefficients, g) * (weight * (g > 0))[:, None]
    variance = residual @ residual / max(len(g) - 4, 1)
    return variance * np.linalg.pinv(jacobian.T @ jacobian)


def _band(coefficients, covariance, g):
    jacobian = _slopes(coefficients, g)
    return np.sqrt(np.einsum('ni,ij,nj->n', jacobian, covariance, jacobian))


def fit_ratio(plateaus: list[Plateau]) -> Ratio:
    """
    Torque-to-thrust ratio of all plateaus together.

    The interval includes noise and the scatter between plateaus.
    """
    force = np.concatenate([plateau.force for plateau in plateaus])
    torque = np.concatenate([plateau.torque for plateau in plateaus])
    slope, tare, error, rms = _line(force, torque)
    if len(plateaus) > 2:
        each = [_line(plateau.force, plateau.torque)[0] for plateau in plateaus]
        error = max(error, np.std(each, ddof=1) / np.sqrt(len(each)))
    width = NORMAL_95 * error
    return Ratio(slope, (slope - width, slope + width), tare, rms)


def _line(x, y):
    """Slope, offset, standard error of the slope and RMS of a line, without outliers."""
    keep = np.ones(len(x), dtype=bool)
    for _ in range(4):
        slope, offset = np.polyfit(x[keep], y[keep], 1)
        residual = y - slope * x - offset
        spread = 1.4826 * np.median(np.abs(residual[keep])) + 1e-12
        keep = np.abs(residual) < 4 * spread
    rms = float(np.sqrt(np.mean(residual[keep]**2)))
    error = rms / (np.std(x[keep]) * np.sqrt(keep.sum()))
    return float(slope), float(offset), float(error), rms


def crossings(rows: list[MapRow]) -> list[str]:
    """Thrusts at which a lower voltage would need less duty, which is impossible."""
    found = []
    for high, low in zip(rows[:-1], rows[1:], strict=True):
        thrust = np.linspace(1.0, min(high.thrust_max, low.thrust_max), 100)
        bad = low.duty(thrust) < high.duty(thrust)
        if bad.any():
            found.append(f'at {thrust[np.argmax(bad)]:.1f} N the row of {low.voltage:.2f} V needs '
                         f'less duty than that of {high.voltage:.2f} V')
    return found


def identify_rotor(log: RotorLog) -> tuple[list[MapRow], Ratio]:
    """Map rows of every plateau, and the torque ratio."""
    return [fit_row(log.name, plateau) for plateau in log.plateaus], fit_ratio(log.plateaus)
