"""Hidden effects of clocks, sensors and delays of commands; see :mod:`gap_data.effects`."""

from gap_data.hidden import direction


def _late(*clocks):
    """Readings are older than their stamps, or commands take hold later, by ``size`` [s]."""
    def build(robot, hidden, size, shape, rng):
        for clock in clocks:
            setattr(hidden, clock, getattr(hidden, clock) + size)
        return {'delay': size}
    return build


def _vector(field, parameter):
    """A vector of the length ``size`` in some direction of the sensor or the body."""
    def build(robot, hidden, size, shape, rng):
        setattr(hidden, field, getattr(hidden, field) + size * direction(rng))
        return {parameter: getattr(hidden, field)}
    return build


joint_feedback_delay = _late('joint_feedback_delay')
mocap_time_offset = _late('mocap_delay')
imu_filter_lag = _late('imu_delay')     # group delay of a low-pass of second order
command_latency = _late('thrust_delay', 'tilt_delay')
joint_command_latency = _late('tilt_delay')
rotor_dead_time = _late('thrust_delay')
imu_accelerometer_bias = _vector('accelerometer_bias', 'bias')      # [m/s^2]
imu_gyroscope_bias = _vector('gyroscope_bias', 'bias')              # [rad/s]
imu_misalignment = _vector('imu_rotation', 'rotation')              # [rad]
imu_lever_arm = _vector('imu_position', 'lever_arm')                # [m] from base_link
mocap_misalignment = _vector('mocap_rotation', 'rotation')          # [rad]
