"""Operations on sampled series: filters, gaps, integrals, rotations."""

from dataclasses import dataclass
from functools import cache

import numpy as np
from scipy.fft import dct, idct
from scipy.signal import fftconvolve, firwin
from scipy.spatial.transform import Rotation

from beetle_omni_ros.model import rotations

SHARPNESS = 5.0     # number of taps times edge over sampling rate
THIN = 2            # decimation of the grid for the body equations
BRIDGED = 0.06      # [s] gaps of inputs that interpolation bridges, about a rotor lag
SMOOTH = 0.05       # [s] moving average of positions before their derivative
EDGE = 1.0          # [s] at both ends, for smoothing and history
WINDOW = 2.0        # [s] in which one shift of two clocks is measured
REACH = 0.15        # [s] largest shift
FASTEST = 8.0       # [Hz] of MoCap, whose noise grows with the square of frequency
LEAST = 3           # windows of which the scatter can be known
STENCILS = (1.0,), (0.5, 0.0, -0.5), (1.0, -2.0, 1.0)     # of derivatives


@dataclass(frozen=True)
class LowPass:
    """
    A symmetric FIR filter with decimation.

    Attributes:
        taps: (L,) taps.
        every: decimation.
        period: sampling period [s].

    """

    taps: np.ndarray
    every: int
    period: float

    @property
    def margin(self) -> int:
        """Samples lost at each end."""
        return (len(self.taps) - 1) // 2

    def __call__(self, x: np.ndarray, derivative: int = 0) -> np.ndarray:
        """Filtered x (N, ...), or its derivative of order 1 or 2, at ``centres(N)``: (M, ...)."""
        taps = np.convolve(self.taps, STENCILS[derivative], 'same') / self.period**derivative
        kernel = taps.reshape(-1, *(x.ndim - 1) * (1,))
        return fftconvolve(x, kernel, axes=0)[len(taps) - 1:len(x):self.every]

    def centres(self, count: int) -> np.ndarray:
        """Indices of the output samples for ``count`` input samples."""
        taps = len(self.taps) - 1
        last = (count - 1) // self.every
        return self.every * np.arange(taps // self.every, last + 1) - taps // 2


@cache
def low_pass(edge: float, every: int, period: float) -> LowPass:
    """Hann-window filter with the edge [Hz]; its length is a multiple of the decimation."""
    length = SHARPNESS / (edge * period)
    step = every * (1 if every % 2 == 0 else 2)
    count = step * max(1, round(length / step)) + 1
    # The end taps of a Hann window are zero, so derivatives of the taps are complete.
    return LowPass(firwin(count, edge, window='hann', fs=1 / period), every, period)


def matrices(q):
    """(N, 3, 3) rotations of unit quaternions (N, 4) xyzw."""
    unit = q / np.linalg.norm(q, axis=1, keepdims=True)
    return np.reshape(rotations.entries(*unit.T), (3, 3, -1)).transpose(2, 0, 1)


def derivatives(series, edge, period):
    """Smoothed series (N, n), its first and its second derivative."""
    kernel = low_pass(edge, 1, period)
    return tuple(within(kernel, series, k) for k in range(3))


def within(kernel, series, derivative):
    """Filtered series (N, n), padded with its end values."""
    ends = ((kernel.margin, kernel.margin), (0, 0))
    return kernel(np.pad(series, ends, mode='edge'), derivative)


def spread(t, values):
    """Samples at least a tenth of the usual step apart, so that splines do not overshoot."""
    usual = np.median(np.diff(t))
    keep, last = [], -np.inf
    for k, at in enumerate(t):
        if at - last > 0.1 * usual:
            keep.append(k)
            last = at
    return t[keep], values[keep]


def runs(mask):
    """(first index, length) of each run of True in a mask (N,)."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], mask.astype(int), [0]])))
    return [(int(a), int(b - a)) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def bridged(t, values):
    """Samples with linear interpolation across gaps, where a spline would overshoot."""
    usual = np.median(np.diff(t))
    gaps = np.flatnonzero(np.diff(t) > 2.5 * usual)
    if not len(gaps):
        return t, values
    more = np.concatenate([np.arange(t[k] + usual, t[k + 1] - usual / 2, usual) for k in gaps])
    at = np.sort(np.concatenate([t, more]))
    return at, np.stack([np.interp(at, t, column) for column in values.T], axis=1)


def integral(t, values):
    """Values (N, n) held between ``t`` (N,) [s], and their integral (N, n)."""
    steps = np.diff(t)[:, None] * values[:-1]
    return values, np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(steps, axis=0)])


def held_at(times, t, values, sums):
    """Integral (K, n) of held values at ``times`` (K,) [s]; see :func:`integral`."""
    row = np.clip(np.searchsorted(t, times, side='right') - 1, 0, len(t) - 1)
    return sums[row] + (times - t[row])[:, None] * values[row]


def turned(quaternion, vector):
    """Quaternions (N, 4) xyzw, each followed by a rotation vector of the body [rad]."""
    return np.stack(rotations.product(*quaternion.T, *rotations.exp_parts(*vector)), axis=1)


def aligned(quaternion):
    """Quaternions (N, 4) with continuous signs; rows without numbers stay."""
    out = np.array(quaternion)
    there = np.flatnonzero(np.isfinite(out).all(axis=1))
    flips = np.sign((out[there[1:]] * out[there[:-1]]).sum(axis=1))
    flips[flips == 0] = 1
    out[there] *= np.concatenate([[1.0], np.cumprod(flips)])[:, None]
    return out


def slow(values, period, highest):
    """Series (N, n) without its frequencies above ``highest`` [Hz]."""
    coefficients = dct(values, axis=0, norm='ortho')
    coefficients[int(2 * len(values) * period * min(highest, 0.5 / period)) + 1:] = 0
    return idct(coefficients, axis=0, norm='ortho')


def rising(values, period):
    """Derivatives (N, 3) of smoothed values."""
    width = max(int(round(SMOOTH / period)), 1)
    padded = np.pad(values, ((width, width), (0, 0)), mode='edge')
    smooth = np.stack([np.convolve(c, np.ones(width) / width, 'same') for c in padded.T], axis=1)
    return np.gradient(smooth, period, axis=0)[width:-width]


def turning(quaternion, period):
    """Body rates (N, 3) of quaternions (N, 4)."""
    turned = Rotation.from_quat(quaternion)
    return np.pad((turned[:-2].inv() * turned[2:]).as_rotvec() / (2 * period), ((1, 1), (0, 0)),
                  mode='edge')


def filled(values, period):
    """Values (N, n) with linear interpolation of missing ones, and (N,) where it is short."""
    t, filled = np.arange(len(values)), np.array(values)
    known = np.ones(len(values), dtype=bool)
    for k, column in enumerate(values.T):
        there = np.flatnonzero(np.isfinite(column))
        if not len(there):
            filled[:, k] = 0.0
            continue
        filled[:, k] = np.interp(t, there, column[there])
        after = np.clip(np.searchsorted(there, t), 0, len(there) - 1)
        before = np.clip(np.searchsorted(there, t, side='right') - 1, 0, None)
        gap = there[after] - there[before]
        known &= (gap * period <= BRIDGED) & (t >= there[0]) & (t <= there[-1])
    return filled, known


def derivative(values, period):
    """Fourth-order central differences (N, n), NaN beside missing samples and at the ends."""
    out = np.full(values.shape, np.nan)
    out[2:-2] = (8 * (values[3:-1] - values[1:-3]) - (values[4:] - values[:-4])) / (12 * period)
    return out


def along(thrust, yaw):
    """Quaternions (N, 4) whose z axis is along a vector (N, 3) in world, with this yaw (N,)."""
    z = thrust / np.linalg.norm(thrust, axis=1, keepdims=True)
    heading = np.stack([np.cos(yaw), np.sin(yaw), np.zeros(len(yaw))], axis=1)
    y = np.cross(z, heading)
    y /= np.linalg.norm(y, axis=1, keepdims=True)
    matrix = np.stack([np.cross(y, z), y, z], axis=2)
    matrix[~np.isfinite(matrix).all(axis=(1, 2))] = np.eye(3)
    return Rotation.from_matrix(matrix).as_quat()


def shifted(seen, felt, known, period):
    """
    Yield rows (R,) of each window, shifts in samples (S,), and squared differences by these (S,).

    Arguments are those of :func:`wander`; half of the samples of a window must count. The windows
    of a short flight are shorter.
    """
    reach = int(REACH / period)
    length = max(min(int(WINDOW / period), (len(seen) - 2 * reach) // LEAST), 1)
    steps = np.arange(-reach, reach + 1)
    for first in range(reach, len(seen) - length - reach + 1, length):
        rows = first + np.flatnonzero(known[first:first + length])
        if len(rows) > length / 2:
            yield rows, steps, np.array([((seen[rows + k] - felt[rows])**2).sum() for k in steps])


def wander(seen, felt, known, period):
    """
    Shift of the clock of one series against that of another, by windows.

    Each window counts by the information that its motion has of the shift, which is the curvature
    of the squared difference: a robot that hovers shows noise.

    Args:
        seen: (N, 3) rates of the attitude [rad/s].
        felt: (N, 3) rates of the gyroscope.
        known: (N,) samples that count.
        period: of the samples [s].

    Returns:
        by how much ``seen`` is late, and the RMS deviation of the windows from it [s]; NaN and
        infinity if too few windows show it.

    """
    found = []
    for _, steps, cost in shifted(seen, felt, known, period):
        best = int(cost.argmin())
        if 0 < best < len(steps) - 1:
            before, here, after = cost[best - 1:best + 2]
            curved = before - 2 * here + after
            found.append(((steps[best] + 0.5 * (before - after) / curved) * period, curved))
    if len(found) < LEAST:
        return np.nan, np.inf
    late, weight = np.array(found).T
    order = np.argsort(late)
    share = np.cumsum(weight[order]) / weight.sum()
    middle = late[order][np.searchsorted(share, 0.5)]
    return float(middle), float(np.sqrt(np.average((late - middle)**2, weights=weight)))
