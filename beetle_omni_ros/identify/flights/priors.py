"""
Priors of the keys: of the robot, of each flight, and of a candidate.

A key always has a narrow prior about the robot file: its tolerance, or half of the smallest
relevant deviation. A candidate adds its typical deviation. Each flight deviates from the common
value by what sensors and vehicles differ from flight to flight.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from beetle_omni_ros.identify.gap.keys import all_keys, Key, names_of
from beetle_omni_ros.identify.gap.treatment import TREATMENTS
from beetle_omni_ros.model.effects import CATALOGUE
from beetle_omni_ros.model.parameters import RobotParameters

# Typical and smallest deviations of the catalogue are those of a robot of this size.
WEIGHT, ARM = 29.8, 0.2754      # [N], [m] params/robot.yaml
# Power of weight and of arm by which a deviation of a unit grows with the size of a robot.
SIZE = {'N': (1, 0), 'N s/m': (1, 0), 'N s^2/m^2': (1, 0), 'N m': (1, 1), 'N s': (1, 1),
        'N m s': (1, 1), 'm': (0, 1), 'kg m': (1, 1), 'kg m^2': (1, 2)}
# Standard deviations between the flights of one vehicle, by key.
FLIGHT = {'thrust_coefficient.scale': 0.017, 'rotor_thrust_coefficient.scale': 0.01,
          'imu_accelerometer_bias.bias': 0.05,
          'imu_gyroscope_bias.bias': 0.004, 'imu_misalignment.rotation': 0.002,
          'mocap_misalignment.rotation': 0.002, 'rotor_dead_time.delay': 0.002}
# Typical differences of sensors between the flights of a laboratory.
VARYING = {'mocap_time_offset.delay': 0.008, 'imu_filter_lag.delay': 0.008,
           'joint_feedback_delay.delay': 0.008, 'imu_accelerometer_bias.bias': 0.1,
           'imu_gyroscope_bias.bias': 0.008, 'imu_misalignment.rotation': 0.005,
           'mocap_misalignment.rotation': 0.005}
AIR = 0.3               # [m/s] moves in a hall; its force is that of a typical drag
FLIGHT_OFFSET = 0.0033          # share of the arm: centre of mass, repeats of one vehicle


@dataclass(frozen=True)
class Spread:
    """Prior standard deviations of one key: narrow, of a candidate, between flights."""

    narrow: float
    typical: float
    flight: float


@dataclass(frozen=True)
class Entry:
    """A catalogue entry, of one rotor where its parameters are one for each."""

    name: str
    keys: tuple[str, ...]
    member: int | None = None
    in_loop: bool = True        # on channels with noise that a controller answers
    varying: bool = False       # differs from flight to flight, with keys for each flight

    @property
    def label(self) -> str:
        """Name with the number of the rotor."""
        if self.varying:
            return f'{self.name} by flight'
        return self.name if self.member is None else f'{self.name}[{self.member}]'


def size_of(robot: RobotParameters, unit: str) -> float:
    """Factor of a typical deviation with this unit for a robot of another size."""
    weight, arm = SIZE.get(unit, (0, 0))
    length = float(np.linalg.norm(robot.rotors.positions[:, :2], axis=1).mean())
    return (robot.mass * robot.gravity / WEIGHT)**weight * (length / ARM)**arm


def keys_of(robot: RobotParameters, names: set[str]) -> dict[str, Key]:
    """Fitted keys of the named catalogue entries."""
    return {name: key for name, key in all_keys(robot).items()
            if key.effect in names and not key.form}


def spread(robot: RobotParameters, key: Key, tolerance: float, stamps: float) -> Spread:
    """Priors of a key; ``tolerance`` of robots (0: none), ``stamps`` of a clock [s]."""
    unit = CATALOGUE[key.effect].parameters[key.parameter].unit
    size = 1.0 if key.relative else size_of(robot, unit)
    plain = f'{key.effect}.{key.parameter}'
    flight = FLIGHT.get(plain, 0.0)
    if plain == 'centre_of_mass.offset':
        flight = FLIGHT_OFFSET * float(
            np.linalg.norm(robot.rotors.positions[:, :2], axis=1).mean())
    if plain == 'rotor_dead_time.delay':
        flight = max(flight, stamps)
    typical = AIR * TREATMENTS['rotor_drag'].sizes['coefficient'].typical if (
        plain == 'wind.force') else key.typical
    return Spread(tolerance or 0.5 * key.smallest * size, typical * size, flight)


def entries_of(keys: dict[str, Key]) -> list[Entry]:
    """Entries of the catalogue that these keys belong to."""
    result = []
    for name in dict.fromkeys(key.effect for key in keys.values()):
        effect = CATALOGUE[name]
        own = tuple(key for parameter in effect.numbers for key in names_of(name, parameter)
                    if key in keys)
        # noise of IMU and MoCap reaches the commands; servos are simulated from commands
        channels = TREATMENTS[name].channels
        body = channels[:1] in 'BAW' and 'J' not in channels
        result += [Entry(name, (key,), k + 1, body) for k, key in enumerate(own)] \
            if effect.each else [Entry(name, own, None, body)]
    return result
