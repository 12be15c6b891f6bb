"""Sensor models: noise, bias, resolution and latency. Times are seconds since reset."""

from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from beetle_omni_ros.model import readings, rotations
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.model.rotations import BodyState
from beetle_omni_ros.model.schema import ParameterError
from beetle_omni_ros.sim.parameters import Conditions, RPM_AT_1_NEWTON, SimulatorParameters
from beetle_omni_ros.sim.plant import Plant

BLOCK = 1024            # readings whose noise is drawn at once, for speed
RESOLUTION = 2 * np.pi / 4096       # [rad] of the servos' positions
RATE_RESOLUTION = 0.02398           # [rad/s] 0.229 rev/min, of their velocities
BATTERY_PERIOD = 0.1                # [s] between two readings
VOLTAGE_NOISE, CURRENT_NOISE = 0.01, 0.1    # [V], [A] standard deviations, chosen
ROTOR_PERIOD = 0.02                 # [s] 50 Hz: ESC telemetry of a motor board
ROTOR_LATENCY = 0.01                # [s] from capture to arrival, chosen
ROTOR_NOISE = 0.01                  # [-] standard deviation relative to the speed, chosen


@dataclass(slots=True)
class Impact:
    """Motion at a touchdown, the first contact with the floor after flight."""

    stamp: float
    speed: float                    # of base_link [m/s]
    inclination: float              # angle between base_link's z axis and the vertical [rad]


@dataclass(slots=True, eq=False)
class Truth(BodyState):
    """The true state."""

    tilt: np.ndarray                # (4,) [rad]
    tilt_velocity: np.ndarray       # (4,) [rad/s]
    thrust: np.ndarray              # (4,) present thrusts [N]
    contact: bool                   # whether any part touches the floor
    impact: Impact | None = None    # last touchdown
    broken: bool = False            # then rotors and servos do not work until reset


@dataclass(slots=True)
class Frame:
    """Readings that arrive in one tick, or None, and the true state."""

    time: float
    imu: readings.ImuReading | None
    mocap: readings.PoseReading | None
    joints: readings.JointReading | None
    battery: readings.BatteryReading | None
    truth: Truth
    rotors: readings.RotorReading | None = None


def noise(generator: np.random.Generator, bias: Sequence[float] | np.ndarray,
          deviation: Sequence[float] | np.ndarray,
          half_width: np.ndarray | float = 0.0) -> Iterator[np.ndarray]:
    """Rows of bias + normal + uniform noise; arguments are arrays of a row."""
    shape = BLOCK, len(bias)
    while True:
        rows = np.asarray(bias) + np.asarray(deviation) * generator.standard_normal(shape)
        yield from rows + half_width * generator.uniform(-1.0, 1.0, shape)


class Sensors:
    """
    All sensors of one robot in one flight, which begins at rest in the state ``first``.

    IMU, MoCap, encoders, battery and rotor speeds have each its seed, so that the noise of a
    sensor does not depend on the rate of another one. A ParameterError reports a period or latency
    that is not a multiple of the tick.
    """

    def __init__(self, parameters: SimulatorParameters, conditions: Conditions,
                 seeds: list[np.random.SeedSequence], first: Truth, plant: Plant,
                 robot: RobotParameters):
        self._tick, self._plant, self._gravity = parameters.tick, plant, robot.gravity
        self._errors = errors = robot.sensors
        self._to_imu = np.kron(np.eye(2), rotations.matrix(rotations.exp(errors.imu_rotation))).T
        self._lever_arm = np.array(errors.imu_position) if any(errors.imu_position) else None
        imu, mocap, tilt, pack, rotors = (np.random.Generator(np.random.PCG64(seed))
                                          for seed in seeds)
        self._imu_noise = noise(
            imu,
            conditions.imu_bias + np.array([*errors.accelerometer_bias, *errors.gyroscope_bias]),
            np.repeat([parameters.specific_force_noise, parameters.angular_velocity_noise], 3),
            conditions.imu_uniform_noise)
        self._mocap_noise = noise(
            mocap, np.concatenate([
                conditions.position_bias,
                conditions.orientation_bias + np.array(errors.mocap_rotation)]),
            np.repeat([parameters.position_noise, parameters.orientation_noise], 3),
            conditions.mocap_uniform_noise)
        self._tilt_noise = noise(tilt, conditions.tilt_bias, np.zeros(4),
                                 conditions.tilt_uniform_noise)
        self._battery_noise = noise(pack, [0.0, 0.0], [VOLTAGE_NOISE, CURRENT_NOISE])
        self._rotor_noise = noise(rotors, np.ones(4), np.full(4, ROTOR_NOISE))
        self._rotor_period = self._ticks('rotor period', ROTOR_PERIOD)
        self._mocap_period = self._ticks('mocap_period', parameters.mocap_period)
        self._battery_period = self._ticks('battery period', BATTERY_PERIOD)
        # Queues, whose first reading arrives when the last is captured. A delay that the stamp
        # does not contain makes them longer; the IMU's is realised in whole ticks, its stamps are
        # corrected by the rest.
        imu_delay, encoder_delay, mocap_delay = (
            max(0, int(np.ceil(delay / self._tick - 1e-9)))
            for delay in (errors.imu_delay, errors.encoder_delay, errors.mocap_delay))
        self._imu_shift = errors.imu_delay - self._tick * imu_delay
        self._before = first
        length = 1 + self._ticks('imu latency', conditions.imu_latency) + imu_delay
        self._imu = deque([self._to_imu.dot(np.concatenate(
            [plant.specific_force, first.angular_velocity]))] * length, length)
        length = 1 + self._ticks('rotor latency', ROTOR_LATENCY)
        self._rotors: deque = deque([None] * length, length)
        length = 1 + self._ticks('encoder latency', conditions.tilt_latency) + encoder_delay
        self._joints = deque([(first.stamp - self._tick * age, first.tilt, first.tilt_velocity,
                               plant.effort) for age in reversed(range(length))], length)
        length = 1 + self._ticks('mocap_latency', parameters.mocap_latency) + mocap_delay
        self._mocap = deque([*[None] * (length - 1), self._capture(first)], length)

    def _ticks(self, name, seconds):
        ticks = round(seconds / self._tick)
        if abs(ticks * self._tick - seconds) > 1e-6:
            raise ParameterError(f'{name}: {seconds:g} s must be a multiple of the simulator tick '
                                 f'{self._tick:g} s')
        return ticks

    def _motion(self, before, after):
        """Mean specific force [m/s^2] and rate [rad/s] (6,) of the IMU between two states."""
        # A MEMS IMU samples at several kHz and filters before it decimates to 200 Hz. A sample of
        # one instant would alias the fast accelerations of a tilting module into velocity errors.
        x, y, z, w = own = before.quaternion.tolist()
        turn = rotations.log(rotations.product(-x, -y, -z, w, *after.quaternion.tolist()))
        middle = rotations.product(*own, *rotations.exp_parts(*(0.5 * turn).tolist()))
        acceleration = (after.velocity - before.velocity) / self._tick
        acceleration[2] += self._gravity
        motion = np.empty(6)
        motion[:3] = acceleration.dot(rotations.matrix(middle))
        motion[3:] = rate = turn / self._tick
        if (arm := self._lever_arm) is not None:
            turning = (after.angular_velocity - before.angular_velocity) / self._tick
            motion[:3] += np.cross(turning, arm) + np.cross(rate, np.cross(rate, arm))
        return self._to_imu.dot(motion)

    def read(self, tick: int, truth: Truth, battery, wear: np.ndarray,
             devices: bool = False) -> Frame:
        """
        Readings that arrive at ``truth.stamp``, the end of the tick number ``tick``.

        ``wear`` is that of :class:`.faults.Drive`. With emulated ``devices``, joints are inputs of
        their sensors: with bias and noise, without latency and rounding, which the devices add.
        """
        self._imu.append(self._motion(self._before, truth))
        self._before = truth
        imu = self._imu[0] + next(self._imu_noise)
        self._mocap.append(self._capture(truth) if tick % self._mocap_period == 0 else None)
        tilt, effort = self._plant.encoder, self._plant.effort
        if self._errors.encoders_err:
            tilt = self._errors.encoders(tilt)
        self._joints.append((truth.stamp, tilt, truth.tilt_velocity, effort))
        error = next(self._tilt_noise)
        if devices:
            joints = readings.JointReading(truth.stamp, tilt + error, truth.tilt_velocity, effort)
        else:
            stamp, tilt, velocity, effort = self._joints[0]
            joints = readings.JointReading(
                stamp + self._errors.encoder_delay, np.rint((tilt + error) / RESOLUTION)
                * RESOLUTION, np.rint(velocity / RATE_RESOLUTION) * RATE_RESOLUTION, effort)
        rotors = pack = None
        if tick % self._battery_period == 0:
            voltage, current = next(self._battery_noise).tolist()
            pack = readings.BatteryReading(truth.stamp, battery.voltage + voltage,
                                  -(battery.current + current))
        if tick % self._rotor_period == 0:
            speed = RPM_AT_1_NEWTON * np.pi / 30 * np.sqrt(np.maximum(truth.thrust, 0.0) / wear)
            rotors = readings.RotorReading(truth.stamp, speed * next(self._rotor_noise))
        self._rotors.append(rotors)
        sample = readings.ImuReading(truth.stamp + self._imu_shift, imu[:3], imu[3:])
        return Frame(truth.stamp, sample, self._mocap[0], joints, pack, truth, self._rotors[0])

    def _capture(self, truth):
        row = next(self._mocap_noise)
        return readings.PoseReading(
            truth.stamp + self._errors.mocap_delay, truth.position + row[:3],
            np.array(rotations.product(*truth.quaternion.tolist(),
                                       *rotations.exp_parts(*row[3:].tolist()))))
