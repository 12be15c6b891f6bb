"""
How a fit treats the effects of the catalogue: their sizes, what shows them, where it begins.

An effect without an entry here acts in every other program, and no fit searches it.
"""

from collections.abc import Sequence
from dataclasses import dataclass


@dataclass(frozen=True)
class Size:
    """Deviations of one number from its neutral value; fractions of a number of the robot file."""

    typical: float          # realistic
    smallest: float         # smallest relevant
    tolerance: str = ''     # between robots of one type: tolerance_... of params/gap.yaml
    step: float = 1e-3      # of derivatives; of the logarithm for the file's own numbers


@dataclass(frozen=True)
class Treatment:
    """How a fit treats one effect."""

    sizes: dict[str, Size]  # of the fitted parameters
    excited_by: str         # flight that shows it
    confused_with: tuple[str, ...]  # effects that poor data cannot distinguish from it
    separated_by: str       # experiment that distinguishes them
    # Affected measurements. B: forces and torques, J: joints, A: MoCap's acceleration, W: MoCap's
    # angular velocity; A and W against the IMU.
    channels: str = 'B'
    # Start values, if the effect has no slope at its neutral value. Those of a limit are fractions
    # of the largest 'tilt_rate', 'torque' or 'thrust' of a flight, and must be below a fraction of
    # the robot file's limit.
    starts: tuple[tuple[float, ...], ...] = ()
    limit: tuple[str, float] | None = None


TREATMENTS: dict[str, Treatment] = {
    'joint_offset': Treatment(
        {'offset': Size(0.03, 0.008, 'angle')}, 'several attitudes',
        ('joint_offset', 'torque_coefficient', 'imu_misalignment'),
        'attitudes with different sets of tilts; a jig'),
    'mass': Treatment(
        {'mass': Size(0.05, 0.01, 'mass')}, 'any flight',
        ('thrust_coefficient', 'voltage_sag', 'wind'),
        'weigh the robot, or fly fast turns: thrust scales torques too, mass does not'),
    'inertia': Treatment(
        {'inertia': Size(0.2, 0.05, 'inertia')}, 'fast turns about every axis',
        ('rotor_lag', 'propeller_gyroscopic_torque', 'thrust_coefficient'),
        'flips by 90 and 180 deg about each axis'),
    'centre_of_mass': Treatment(
        {'offset': Size(0.005, 0.0015)}, 'hover in several attitudes',
        ('rotor_thrust_coefficient', 'module_reaction'),
        'hover at roll 0, 90, 180 deg and pitch 90 deg'),
    'module_reaction': Treatment(
        {'module_inertia': Size(1e-4, 2e-5, step=2e-5),
         'mass_moment': Size(2e-3, 3e-4, step=2e-4)}, 'fast tilting, turned attitudes',
        ('centre_of_mass', 'inertia'), 'the same attitude with tilts turned by 180 deg', 'BJ'),
    'thrust_coefficient': Treatment(
        {'scale': Size(0.05, 0.01, 'thrust')}, 'any flight',
        ('mass', 'voltage_sag', 'tilt_thrust_loss'),
        'weigh the robot; flights at two states of charge'),
    'rotor_thrust_coefficient': Treatment(
        {'scale': Size(0.08, 0.015, 'thrust')}, 'hover in several attitudes',
        ('centre_of_mass', 'rotor_thrust_coefficient'),
        'tilted attitudes; exchange propellers 1 and 2'),
    'torque_coefficient': Treatment(
        {'torque_to_thrust_ratio': Size(0.2, 0.03, 'torque_ratio')},
        'yaw steps, differential thrust', ('joint_offset', 'rotor_acceleration_torque'),
        'yaw steps at zero tilt'),
    'ground_effect': Treatment(
        {'gain_at_0.25m': Size(0.08, 0.01)}, 'hover below 0.6 m',
        ('thrust_coefficient', 'mass', 'tilt_thrust_loss'),
        'hover ladder at 0.2, 0.3, 0.5, 1.0 and 1.5 m at one state of charge'),
    'rotor_drag': Treatment(
        {'coefficient': Size(0.4, 0.06)}, 'translation above 1 m/s', ('body_drag', 'wind'),
        'passes at three speeds with two rotor tilts'),
    'rotor_hub_moment': Treatment(
        {'coefficient': Size(0.1, 0.015)}, 'translation above 0.5 m/s',
        ('centre_of_mass', 'inertia', 'rotor_drag'),
        'passes at three speeds, forwards and sideways'),
    'body_drag': Treatment(
        {'coefficient': Size(0.05, 0.02)}, 'translation above 2 m/s', ('rotor_drag', 'wind'),
        'passes above 4 m/s'),
    'axial_inflow': Treatment(
        {'per_rotor': Size(0.4, 0.04)}, 'climb and descent', ('rotor_lag', 'rotor_drag'),
        'steady climb and descent at 1 m/s beside thrust steps'),
    'translational_lift': Treatment(
        {'per_rotor': Size(0.03, 0.01)}, 'fast passes', ('thrust_coefficient', 'axial_inflow'),
        'level passes at 1, 2 and 3 m/s'),
    'tilt_thrust_loss': Treatment(
        {'loss_at_60deg': Size(0.06, 0.01)}, 'large tilts',
        ('thrust_coefficient', 'mass', 'ground_effect'),
        'one attitude with tilts changed by internal force'),
    'wind': Treatment(
        {'force': Size(1.0, 0.1)}, 'any flight; yaw turns',
        ('mass', 'imu_misalignment', 'mocap_misalignment'),
        'hover at yaw 0 and 180 deg; fan off'),
    'wind_velocity': Treatment(
        {'velocity': Size(2.0, 0.2)}, 'any flight; yaw turns', ('wind', 'mocap_misalignment'),
        'hover at yaw 0 and 180 deg; fan off'),
    'propeller_gyroscopic_torque': Treatment(
        # its part about the tilt axes loads the servos, which the model leaves out
        {'angular_momentum_at_hover': Size(0.066, 0.008, step=5e-3)},
        'fast turns and fast tilting', ('inertia', 'rotor_acceleration_torque', 'rotor_lag'),
        'fast tilting by internal force at rest', 'BJ'),
    'rotor_acceleration_torque': Treatment(
        {'angular_momentum_at_hover': Size(0.066, 0.008)}, 'thrust steps',
        ('torque_coefficient', 'propeller_gyroscopic_torque', 'rotor_lag'),
        'differential thrust chirp'),
    'voltage_sag': Treatment(
        {'exponent': Size(1.0, 0.15)}, 'flights at several states of charge',
        ('thrust_coefficient', 'mass'),
        'three flights at different charge; thrust steps by internal force'),
    'formula': Treatment(
        # in typical sizes of each term
        {'coefficients': Size(1.0, 0.2)}, 'motion as in the flights that it was found in', (),
        'motion in which its terms differ'),
    'rotor_lag': Treatment(
        {'time_constant': Size(0.4, 0.12, 'lag', step=0.02)}, 'thrust steps',
        ('rotor_dead_time', 'axial_inflow', 'command_latency'),
        'thrust chirp 0.5 to 8 Hz: a lag reduces the amplitude, a delay shifts the phase only'),
    'rotor_dead_time': Treatment(
        {'delay': Size(0.015, 0.003)}, 'thrust steps', ('rotor_lag', 'command_latency'),
        'thrust chirp 0.5 to 8 Hz'),
    'thrust_saturation': Treatment(
        {'thrust_max': Size(0.3, 0.02, step=0.01)}, 'commands at the limit',
        ('voltage_sag', 'thrust_coefficient'), 'climb at full thrust',
        starts=((0.95,), (0.8,)), limit=('thrust', 1.2)),
    'command_latency': Treatment(
        {'delay': Size(0.02, 0.003, 'delay')}, 'fast tilting and thrust steps',
        ('joint_command_latency', 'rotor_dead_time', 'joint_bandwidth'),
        'sine sweep of the tilts 0.5 to 6 Hz with thrust steps', 'BJ'),
    'joint_command_latency': Treatment(
        {'delay': Size(0.02, 0.003, 'delay')}, 'fast tilting',
        ('joint_bandwidth', 'command_latency', 'joint_feedback_delay'),
        'sine sweep of the tilts 0.5 to 6 Hz', 'J'),
    'joint_bandwidth': Treatment(
        dict.fromkeys(('kp', 'kd'), Size(0.3, 0.1, 'lag', step=0.01)), 'fast tilting',
        ('joint_command_latency', 'joint_torque_limit'),
        'sine sweep of the tilts 0.5 to 6 Hz with two amplitudes', 'J'),
    'joint_velocity_limit': Treatment(
        {'velocity_limit': Size(0.5, 0.05, 'speed', step=0.01)}, 'large tilt steps',
        ('joint_torque_limit', 'joint_bandwidth'), 'tilt steps of 30, 90 and 180 deg', 'J',
        starts=((0.95,), (0.8,)), limit=('tilt_rate', 0.95)),
    'joint_torque_limit': Treatment(
        # The file's 3 N m is 60 times the demand of quick poses; the real limit may be lower.
        {'effort_limit': Size(0.8, 0.05, step=0.01)}, 'large tilt steps',
        ('joint_velocity_limit', 'joint_bandwidth'), 'tilt steps of 30, 90 and 180 deg', 'J',
        starts=((1.1,), (0.8,), (0.5,)), limit=('torque', 0.98)),
    'joint_friction': Treatment(
        dict.fromkeys(('coulomb', 'stiction'), Size(0.01, 0.002, step=5e-4)),
        'slow reversals of the tilts', ('joint_backlash', 'joint_bandwidth'),
        'triangle of 2 deg at 0.1 Hz', 'J', starts=((0.003, 0.003), (0.008, 0.008), (0.02, 0.02))),
    'joint_backlash': Treatment(
        {'gap': Size(0.01, 0.003)}, 'reversals of the tilts',
        ('joint_friction', 'joint_feedback_delay'), 'reversals loaded and unloaded',
        starts=((0.005,), (0.02,), (0.05,))),
    'joint_deflection': Treatment(
        {'deflection_per_newton': Size(0.002, 0.0004, step=1e-4)}, 'thrust steps',
        ('joint_friction', 'joint_offset'), 'internal force at rest, two levels', 'J'),
    'joint_encoder_error': Treatment(
        {'gain': Size(0.02, 0.005), 'sine': Size(0.02, 0.008), 'cosine': Size(0.02, 0.008)},
        'large tilts', ('joint_offset', 'joint_bandwidth'), 'tilts held over the whole travel',
        'J'),
    'joint_feedback_delay': Treatment(
        {'delay': Size(0.01, 0.003, 'delay')}, 'fast tilting',
        ('joint_command_latency', 'mocap_time_offset', 'joint_backlash'),
        'tilting by internal force with the body at rest', 'BJ'),
    'mocap_time_offset': Treatment(
        {'delay': Size(0.01, 0.002, 'delay')}, 'fast turns', ('imu_filter_lag',),
        'any turn above 1 rad/s', 'AW'),
    'imu_filter_lag': Treatment(
        {'delay': Size(0.01, 0.002, 'delay')}, 'fast turns',
        ('mocap_time_offset', 'rotor_dead_time'),
        'turns above 1 rad/s with thrust steps; log the raw gyroscope', 'BAW'),
    'imu_accelerometer_bias': Treatment(
        {'bias': Size(0.15, 0.03, 'bias_accelerometer')}, 'several attitudes',
        ('wind', 'imu_misalignment', 'joint_offset'),
        'at rest in three attitudes before take-off', 'BA'),
    'imu_gyroscope_bias': Treatment(
        {'bias': Size(0.02, 0.004, 'bias_gyroscope')}, 'any flight', (),
        'at rest before take-off', 'BW'),
    'imu_misalignment': Treatment(
        {'rotation': Size(0.02, 0.004, 'angle')}, 'several attitudes',
        ('mocap_misalignment', 'wind', 'joint_offset'), 'hover in three attitudes', 'BAW'),
    'imu_lever_arm': Treatment(
        {'offset': Size(0.02, 0.006)}, 'fast turns', ('centre_of_mass', 'inertia'),
        'flips by 180 deg', 'BA'),
    'mocap_misalignment': Treatment(
        {'rotation': Size(0.02, 0.004, 'angle')}, 'several attitudes',
        ('imu_misalignment', 'wind'), 'hover at yaw 0, 90, 180 and 270 deg', 'AW'),
}


def separating_experiment(names: Sequence[str]) -> str:
    """Experiment that distinguishes effects, from the one with most others as confused."""
    return TREATMENTS[max(names, key=lambda name: len(
        set(TREATMENTS[name].confused_with) & set(names) - {name}))].separated_by
