"""Motion from samples with gaps: derivatives, attitude, and the clocks of two sensors."""

import numpy as np
from scipy.fft import dct, idct
from scipy.spatial.transform import Rotation

from beetle_omni_ros.identify.gap.series import aligned

BRIDGED = 0.06      # [s] gaps of inputs that interpolation bridges, about a rotor lag
SMOOTH = 0.05       # [s] moving average of positions before their derivative
WINDOW = 2.0        # [s] in which one shift of two clocks is measured
REACH = 0.15        # [s] largest shift
LEAST = 3           # windows of which the scatter can be known


def poses(table, far):
    """
    Positions (N, 3) and quaternions (N, 4) or None, on the clock of the IMU.

    Two clocks are compared by the rates of quaternion and gyroscope, and the median of their
    shifts is taken out.

    Args:
        table: the flight.
        far: height without position [m].

    Returns:
        positions, quaternions, RMS deviation of the clocks [s].

    """
    v, signals, h = table.values, table.format.signals, table.period
    position = filled(v['position'], h)[0] if 'position' in v else np.tile(
        [0.0, 0.0, far], (len(table), 1))
    if 'quaternion' not in v:
        return position, None, np.inf
    quaternion, seen = filled(aligned(v['quaternion']), h)
    deviation = table.format.clock_deviation
    imu = next((signals[name].clock for name in ('angular_velocity', 'specific_force')
                if name in v), None)
    if imu not in (None, signals['quaternion'].clock):
        late, deviation = np.nan, np.inf
        if 'angular_velocity' in v:
            felt, known = filled(v['angular_velocity'], h)
            late, deviation = wander(turning(quaternion, h), felt, seen & known, h)
        if np.isfinite(late):
            t = np.arange(len(table)) * h
            position, quaternion = (np.stack([np.interp(t + late, t, c) for c in x.T], axis=1)
                                    for x in (position, quaternion))
    return position, quaternion / np.linalg.norm(quaternion, axis=1, keepdims=True), deviation


def wander(seen, felt, known, period):
    """
    Shift of the clock of one series against that of another, by windows.

    Args:
        seen: (N, 3) rates of the attitude [rad/s].
        felt: (N, 3) rates of the gyroscope.
        known: (N,) samples that count.
        period: of the samples [s].

    Returns:
        by how much ``seen`` is late in the median, and the RMS deviation of the windows from it
        [s]; NaN and infinity if too few windows show it.

    """
    reach, length = int(REACH / period), int(WINDOW / period)
    steps, found = np.arange(-reach, reach + 1), []
    for first in range(reach, len(seen) - length - reach, length):
        rows = first + np.flatnonzero(known[first:first + length])
        cost = np.array([((seen[rows + k] - felt[rows])**2).sum() for k in steps])
        best = int(cost.argmin())
        if len(rows) > length / 2 and 0 < best < len(steps) - 1:
            before, here, after = cost[best - 1:best + 2]
            found.append((steps[best] + 0.5 * (before - after) / (before - 2 * here + after))
                         * period)
    if len(found) < LEAST:
        return np.nan, np.inf
    return float(np.median(found)), float(np.sqrt(np.mean((found - np.median(found))**2)))


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
