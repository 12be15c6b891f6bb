"""Hidden effects of clocks and sensors; see :mod:`gap_data.effects`."""

from __future__ import annotations

from gap_data.effects_body import direction


def joint_feedback_delay(robot, hidden, size, shape, rng):
    """Encoder readings are ``size`` [s] older than their stamps."""
    hidden.joint_feedback_delay += size
    return {'delay': size}


def mocap_time_offset(robot, hidden, size, shape, rng):
    """MoCap poses are ``size`` [s] older than their stamps."""
    hidden.mocap_delay += size
    return {'delay': size}


def imu_filter_lag(robot, hidden, size, shape, rng):
    """The IMU's output went through a second-order low-pass with ``size`` [s] of group delay."""
    hidden.imu_delay += size
    return {'delay': size}


def imu_accelerometer_bias(robot, hidden, size, shape, rng):
    """Offset of ``size`` [m/s^2] in some direction of the sensor."""
    hidden.accelerometer_bias = hidden.accelerometer_bias + size * direction(rng)
    return {'bias': hidden.accelerometer_bias}


def imu_gyroscope_bias(robot, hidden, size, shape, rng):
    """Offset of ``size`` [rad/s] in some direction of the sensor."""
    hidden.gyroscope_bias = hidden.gyroscope_bias + size * direction(rng)
    return {'bias': hidden.gyroscope_bias}


def imu_misalignment(robot, hidden, size, shape, rng):
    """The IMU is mounted ``size`` [rad] askew."""
    hidden.imu_rotation = hidden.imu_rotation + size * direction(rng)
    return {'rotation': hidden.imu_rotation}


def imu_lever_arm(robot, hidden, size, shape, rng):
    """The IMU sits ``size`` [m] from base_link's origin."""
    hidden.imu_position = hidden.imu_position + size * direction(rng)
    return {'lever_arm': hidden.imu_position}


def mocap_misalignment(robot, hidden, size, shape, rng):
    """The MoCap body's axes stand ``size`` [rad] askew on base_link."""
    hidden.mocap_rotation = hidden.mocap_rotation + size * direction(rng)
    return {'rotation': hidden.mocap_rotation}
