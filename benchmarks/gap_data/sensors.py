"""From truth to what the sensors report, with the stamps that they put on it."""

import numpy as np
from scipy.signal import bessel, butter, lfilter, lfilter_zi
from scipy.spatial.transform import Rotation

from gap_data.flight import Truth
from gap_data.hidden import Hidden


def measure(truth: Truth, hidden: Hidden, numbers: dict, rng: np.random.Generator, *,
            noise: dict[str, float], shape: str = 'plain') -> dict[str, np.ndarray]:
    """
    Sample one flight.

    Args:
        truth: of the flight.
        hidden: sensor and timing effects.
        numbers: see ``numbers.yaml``.
        rng: of the noise.
        noise: standard deviations: accelerometer, gyroscope, position, orientation, tilt.
        shape: of the IMU's filter: 'plain' Bessel, 'butterworth'.

    Returns:
        Tables with the stamp [s] since the flight began in the first column: ``imu`` specific
        force and rate, ``mocap`` position and quaternion x y z w, ``joints`` positions,
        ``battery`` voltage and current (negative when discharging), ``commands`` tilts and
        thrusts.

    """
    settings = numbers['sensors']
    return {
        'imu': _imu(truth, hidden, settings, rng, noise, shape),
        'mocap': _mocap(truth, hidden, settings, rng, noise),
        'joints': _joints(truth, hidden, settings, rng, noise),
        'battery': _battery(truth, numbers['battery'], rng),
        'commands': np.column_stack([truth.command_t, truth.command_tilt, truth.command_thrust])}


def _rows(truth, period, delay=0.0):
    """Stamps, and the rows of the truth at these times less a delay."""
    step = truth.t[1] - truth.t[0]
    rows = np.arange(0, len(truth.t), int(round(period / step)))
    return truth.t[rows], np.maximum(rows - int(round(delay / step)), 0)


def _imu(truth, hidden, settings, rng, noise, shape):
    stamps, rows = _rows(truth, settings['imu_period'])
    readings = np.hstack([truth.columns['specific_force'], truth.columns['rate']])
    if hidden.imu_delay > 0:
        readings = low_pass(readings, hidden.imu_delay, truth.t[1] - truth.t[0], shape)
    readings = readings[rows]
    turn = Rotation.from_rotvec(hidden.imu_rotation).as_matrix()
    force, rate = readings[:, :3] @ turn, readings[:, 3:] @ turn
    force = force + hidden.accelerometer_bias + noise['accelerometer'] * rng.standard_normal(
        force.shape)
    rate = rate + hidden.gyroscope_bias + noise['gyroscope'] * rng.standard_normal(rate.shape)
    return np.column_stack([stamps, force, rate])


def low_pass(signal: np.ndarray, delay: float, step: float, shape: str) -> np.ndarray:
    """
    Second-order filter along time with a given group delay at low frequency.

    Args:
        signal: (N, k).
        delay: [s].
        step: [s] between rows.
        shape: 'plain' Bessel (nearly the same delay at all frequencies) or 'butterworth'.

    """
    if shape == 'butterworth':
        cut = np.sqrt(2) / delay
        b, a = butter(2, min(cut / np.pi * step, 0.95))
    else:
        b, a = bessel(2, min(1 / delay / np.pi * step, 0.95), norm='delay')
    start = lfilter_zi(b, a)[:, None] * signal[0]
    return lfilter(b, a, signal, axis=0, zi=start)[0]


def _mocap(truth, hidden, settings, rng, noise):
    stamps, seen = _rows(truth, settings['mocap_period'], hidden.mocap_delay)
    position = truth.columns['position'][seen]
    w, x, y, z = truth.columns['quaternion'][seen].T
    turn = (Rotation.from_quat(np.column_stack([x, y, z, w]))
            * Rotation.from_rotvec(hidden.mocap_rotation)
            * Rotation.from_rotvec(noise['orientation'] * rng.standard_normal((len(seen), 3))))
    position = position + noise['position'] * rng.standard_normal(position.shape)
    return np.column_stack([stamps, position, turn.as_quat()])


def _joints(truth, hidden, settings, rng, noise):
    stamps, seen = _rows(truth, settings['joint_period'], hidden.joint_feedback_delay)
    count = 2 * np.pi / settings['counts_per_turn']
    tilt = truth.columns['tilt'][seen]
    tilt = tilt + noise['tilt'] * rng.standard_normal(tilt.shape)
    return np.column_stack([stamps, np.round(tilt / count) * count])


def _battery(truth, settings, rng):
    stamps, rows = _rows(truth, settings['period'])
    voltage, current = truth.columns['voltage'][rows], truth.columns['current'][rows]
    return np.column_stack([
        stamps, voltage + settings['voltage_noise'] * rng.standard_normal(voltage.shape),
        -current + settings['current_noise'] * rng.standard_normal(current.shape)])
