"""Sensor models: noise, bias, resolution and latency."""

from collections import deque

import numpy as np

from beetle_omni_ros.robot import rotations
from beetle_omni_ros.robot.effects import SensorErrors
from beetle_omni_ros.robot.readings import (
    BatteryReading,
    ImuReading,
    JointReading,
    PoseReading,
    RotorReading,
)
from beetle_omni_ros.robot.schema import ParameterError
from beetle_omni_ros.sim.parameters import Conditions, RPM_AT_1_NEWTON, SimulatorParameters
from beetle_omni_ros.sim.plant import Plant
from beetle_omni_ros.sim.readings import Truth

BLOCK = 1024            # readings whose noise is drawn at once, for speed
RESOLUTION = 2 * np.pi / 4096       # [rad] of the servos' positions
RATE_RESOLUTION = 0.02398           # [rad/s] 0.229 rev/min, of their velocities
BATTERY_PERIOD = 0.1                # [s] between two readings
VOLTAGE_NOISE, CURRENT_NOISE = 0.01, 0.1    # [V], [A] standard deviations, chosen
ROTOR_PERIOD = 0.02                 # [s] 50 Hz: ESC telemetry of a motor board
ROTOR_LATENCY = 0.01                # [s] from capture to arrival, chosen
ROTOR_NOISE = 0.01                  # [-] standard deviation relative to the speed, chosen


class Noise:
    """Rows of bias + normal + uniform noise from one generator; arguments are arrays of a row."""

    def __init__(self, generator: np.random.Generator, bias: np.ndarray, deviation: np.ndarray,
                 half_width: np.ndarray | float):
        self._generator = generator
        self._bias, self._deviation, self._half_width = bias, deviation, half_width
        self._rows = iter(())

    def next(self) -> np.ndarray:
        """The next row."""
        for row in self._rows:
            return row
        shape = (BLOCK, len(self._bias))
        rows = self._bias + self._deviation * self._generator.standard_normal(shape)
        rows += self._half_width * self._generator.uniform(-1.0, 1.0, shape)
        self._rows = iter(rows)
        return next(self._rows)


class Sensors:
    """
    All sensors of one robot in one flight.

    Args:
        seeds: five seeds, for IMU, MoCap, encoders, battery and rotor speeds, so that the noise of
            a sensor does not depend on the rate of another one.
        first: state at reset, in which the robot has been at rest.
        effort: (4,) servo torques in this state [N m].

    Raises:
        ParameterError: a period or latency is not a multiple of the tick.

    """

    def __init__(self, parameters: SimulatorParameters, conditions: Conditions,
                 seeds: list[np.random.SeedSequence], first: Truth, effort: np.ndarray,
                 errors: SensorErrors = SensorErrors()):
        self._tick, self._errors = parameters.tick, errors
        self._to_imu = rotations.matrix(rotations.exp(errors.imu_rotation)) \
            if any(errors.imu_rotation) else None
        self._lever_arm = np.array(errors.imu_position) if any(errors.imu_position) else None
        generators = (np.random.Generator(np.random.PCG64(seed)) for seed in seeds)
        self._imu_noise = Noise(
            next(generators),
            conditions.imu_bias + np.array([*errors.accelerometer_bias, *errors.gyroscope_bias]),
            np.repeat([parameters.specific_force_noise, parameters.angular_velocity_noise], 3),
            conditions.imu_uniform_noise)
        self._mocap_noise = Noise(
            next(generators), np.concatenate([
                conditions.position_bias,
                conditions.orientation_bias + np.array(errors.mocap_rotation)]),
            np.repeat([parameters.position_noise, parameters.orientation_noise], 3),
            conditions.mocap_uniform_noise)
        self._tilt_noise = Noise(next(generators), conditions.tilt_bias, np.zeros(4),
                                 conditions.tilt_uniform_noise)
        self._battery_noise = Noise(next(generators), np.zeros(2),
                                    np.array([VOLTAGE_NOISE, CURRENT_NOISE]), 0.0)
        self._rotor_noise = Noise(next(generators), np.ones(4), np.full(4, ROTOR_NOISE), 0.0)
        self._rotor_period = self._ticks('rotor period', ROTOR_PERIOD, least=1)
        self._mocap_period = self._ticks('mocap_period', parameters.mocap_period, least=1)
        self._battery_period = self._ticks('battery period', BATTERY_PERIOD, least=1)
        self._rotors = self._line('rotor latency', ROTOR_LATENCY)
        self._imu = self._line('imu latency', conditions.imu_latency, errors.imu_delay)
        self._joints = self._line('encoder latency', conditions.tilt_latency,
                                  errors.encoder_delay)
        self._mocap = self._line('mocap_latency', parameters.mocap_latency, errors.mocap_delay)
        # The delay of the IMU is realised in whole ticks and corrected by the stamps.
        self._imu_shift = errors.imu_delay - self._tick * self._hidden_ticks(errors.imu_delay)
        for k in range(self._joints.maxlen):
            stamp = first.stamp - self._tick * (self._joints.maxlen - 1 - k)
            self._joints.append((stamp, first.tilt, first.tilt_velocity, effort))
        self._mocap.extend([None] * (self._mocap.maxlen - 1))
        self._mocap.append(self._capture(first))

    def _ticks(self, name, seconds, least=0):
        ticks = round(seconds / self._tick)
        if ticks < least or abs(ticks * self._tick - seconds) > 1e-6:
            raise ParameterError(f'{name}: {seconds:g} s must be a multiple of the simulator tick '
                                 f'{self._tick:g} s' + (', one or more' if least else ''))
        return ticks

    def _line(self, name, latency, hidden=0.0):
        """Queue whose first element is older than its last by both times, once it is full."""
        return deque(maxlen=1 + self._ticks(name, latency) + self._hidden_ticks(hidden))

    def _hidden_ticks(self, delay):
        """Additional latency in ticks of a reading whose stamp does not contain a delay [s]."""
        return max(0, int(np.ceil(delay / self._tick - 1e-9)))

    def _motion(self, before, truth, gravity):
        """(6,) specific force and angular rate at the place of the IMU, in its axes."""
        motion = mean_motion(before, truth, gravity)
        if self._lever_arm is not None:
            rate, arm = motion[3:], self._lever_arm
            acceleration = (truth.angular_velocity - before.angular_velocity) / self._tick
            motion[:3] += np.cross(acceleration, arm) + np.cross(rate, np.cross(rate, arm))
        return self._in_imu_axes(motion)

    def _in_imu_axes(self, motion):
        if self._to_imu is None:
            return motion
        return np.concatenate([motion[:3] @ self._to_imu, motion[3:] @ self._to_imu])

    def start_imu(self, truth: Truth, specific_force: np.ndarray) -> None:
        """Fill the delay line of the IMU with the reading at reset."""
        self._before = truth
        motion = self._in_imu_axes(np.concatenate([specific_force, truth.angular_velocity]))
        for _ in range(self._imu.maxlen):
            self._imu.append(motion)

    def read(self, tick: int, truth: Truth, plant: Plant, battery,
             devices: bool = False) -> tuple:
        """
        IMU, MoCap, joint and battery readings, or None, that arrive at ``truth.stamp``.

        ``tick`` is the number of the tick that ends then. With ``devices``, joints and battery
        are inputs of emulated devices, see :class:`.readings.Frame`.
        """
        self._imu.append(self._motion(self._before, truth, plant.gravity))
        self._before = truth
        imu = self._imu[0] + self._imu_noise.next()
        self._mocap.append(self._capture(truth) if tick % self._mocap_period == 0 else None)
        motion = ImuReading(truth.stamp + self._imu_shift, imu[:3], imu[3:])
        effort = plant.effort
        tilt = plant.encoder
        if self._errors.encoders_err:
            tilt = self._errors.encoders(tilt)
        self._joints.append((truth.stamp, tilt, truth.tilt_velocity, effort))
        if devices:
            tilt = tilt + self._tilt_noise.next()
            return (motion, self._mocap[0],
                    JointReading(truth.stamp, tilt, truth.tilt_velocity, effort),
                    self._pack_reading(truth.stamp, battery))
        return motion, self._mocap[0], self._joint_reading(), None if \
            tick % self._battery_period else self._pack_reading(truth.stamp, battery)

    def rotor_speeds(self, tick: int, truth: Truth, wear: np.ndarray) -> RotorReading | None:
        """
        Rotor speeds that arrive at the end of tick number ``tick``.

        ``wear`` (4,) is the thrust relative to that of an intact propeller at the same speed.
        """
        reading = None
        if tick % self._rotor_period == 0:
            speed = RPM_AT_1_NEWTON * np.pi / 30 * np.sqrt(np.maximum(truth.thrust, 0.0) / wear)
            reading = RotorReading(truth.stamp, speed * self._rotor_noise.next())
        self._rotors.append(reading)
        return self._rotors[0] if len(self._rotors) == self._rotors.maxlen else None

    def _capture(self, truth):
        noise = self._mocap_noise.next()
        return PoseReading(truth.stamp + self._errors.mocap_delay, truth.position + noise[:3],
                           np.array(rotations.product(*truth.quaternion.tolist(),
                                                      *rotations.exp_parts(*noise[3:].tolist()))))

    def _joint_reading(self):
        stamp, tilt, velocity, effort = self._joints[0]
        tilt = np.rint((tilt + self._tilt_noise.next()) / RESOLUTION) * RESOLUTION
        velocity = np.rint(velocity / RATE_RESOLUTION) * RATE_RESOLUTION
        return JointReading(stamp + self._errors.encoder_delay, tilt, velocity, effort)

    def _pack_reading(self, stamp, battery):
        voltage, current = self._battery_noise.next().tolist()
        return BatteryReading(stamp, battery.voltage + voltage, -(battery.current + current))


def mean_motion(before: Truth, after: Truth, gravity: float) -> np.ndarray:
    """
    Mean specific force [m/s^2] and angular rate [rad/s] (6,) in base_link between two states.

    A MEMS IMU samples at several kHz and filters before it decimates to 200 Hz. A sample of one
    instant would alias the fast accelerations of a tilting module into velocity errors.
    """
    dt = after.stamp - before.stamp
    x, y, z, w = own = before.quaternion.tolist()
    turn = rotations.log(rotations.product(-x, -y, -z, w, *after.quaternion.tolist()))
    middle = rotations.product(*own, *rotations.exp_parts(*(0.5 * turn).tolist()))
    acceleration = (after.velocity - before.velocity) / dt
    acceleration[2] += gravity
    motion = np.empty(6)
    motion[:3] = acceleration.dot(rotations.matrix(middle))
    motion[3:] = turn / dt
    return motion
