"""
Kinds of faults of the simulated robot, its devices and the flight stack: the table KINDS.

A function of the table gets the state of an active fault, see :class:`.faults.Schedule`. Those of
the signals ``imu``, ``mocap``, ``joints``, ``rotors``, ``battery``, ``command`` (to actuators),
``request`` (of the active controller) and ``estimate`` also get the item that arrives, and return
the changed one, or None; of a ``late`` kind the list of due ones, also without an item. ``drive``
gets the Drive of this tick and changes it in place. The others return a value:

- ``charge``: largest charge of the battery; ``resistance``: added to it [ohm].
- ``wrench``: (6,) force in world [N] and torque in base_link [N m]; ``payload``: mass [kg].
- ``clock``: error of the flight computer's clock [s]; ``waits``: whether the supervisor is not
  scheduled; ``target``: position [m] and quaternion of another target; ``bridges``: bridge -> its
  reported state.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, Field, MISSING, replace
from math import exp, inf
from typing import Any

import numpy as np

from beetle_omni_ros.model import rotations
from beetle_omni_ros.model.schema import parameter

ROUNDING = 1e-9     # [s] bound of the rounding error of sums of ticks


class Kind:
    """The numbers of one kind of fault, and its functions by signal."""

    def __init__(self, numbers: Mapping[str, Field] = {}, *, late: bool = False,
                 **functions: Callable):
        self.numbers, self.late, self.functions = numbers, late, functions


@dataclass
class Drive:
    """Inputs of the actuators in one tick, each (4,); faults change arrays in place."""

    tilt: np.ndarray                                    # targets of the servos [rad]
    thrust: np.ndarray                                  # targets of the rotors [N]
    powered: np.ndarray | Sequence[bool] = (True,) * 4  # whether a servo has torque
    jammed: np.ndarray | Sequence[bool] = (False,) * 4  # whether a joint is jammed at its target
    wear: np.ndarray | Sequence[float] = (1.0,) * 4     # thrust relative to an intact propeller


# Functions of several kinds ---------------------------------------------------------------------

def lost(fault, item):
    return None


def dropped(fault, item):
    return None if fault.random.uniform() < fault.share else item


def frozen(fault, item):
    fault.memory = fault.memory or item
    return replace(fault.memory, stamp=item.stamp)


def delayed(fault, item, most=inf):
    queue = fault.memory = fault.memory or deque()
    if item is not None:
        queue.append((fault.now + fault.delay, item))
    due: list = []
    while len(due) < most and queue and queue[0][0] <= fault.now + ROUNDING:
        due.append(queue.popleft()[1])
    return due


def added(field, amount):
    """Function that adds ``amount(fault)`` to a field of a reading."""
    return lambda fault, item: replace(item, **{field: getattr(item, field) + amount(fault)})


def of_motion(change):
    """Function that applies ``change(fault, (6,) specific force and rate)`` to an IMU reading."""
    def changed(fault, reading):
        motion = change(fault, np.concatenate([reading.specific_force, reading.angular_velocity]))
        return replace(reading, specific_force=motion[:3], angular_velocity=motion[3:])
    return changed


def _axes(fault):
    return np.array([fault.x, fault.y, fault.z])


def _turn(fault):
    return rotations.from_rpy(fault.roll, fault.pitch, fault.yaw)


def _both(fault):
    return np.repeat([fault.specific_force, fault.rate], 3)


# Rotors and servos -----------------------------------------------------------------------------

def driven(field, change):
    """Function that sets ``field`` of a rotor or servo to ``change(fault, its present value)``."""
    def changed(fault, drive):
        values = getattr(drive, field)
        values[fault.k] = change(fault, values[fault.k])
    return changed


def propeller_broken(fault, drive):
    drive.thrust[fault.k] *= fault.share
    drive.wear[fault.k] *= max(fault.share, 1e-6)


def lagging(fault, command):
    if fault.memory is None:
        fault.memory = float(fault.truth.thrust[fault.k])
    gain = 1 - exp(-fault.tick / fault.time_constant)
    fault.memory += gain * (command - fault.memory)
    return fault.memory


def servo_jammed(fault, drive):
    angle, remaining = fault.memory or (float(fault.truth.tilt[fault.k]), fault.offset)
    step = float(np.clip(remaining, -fault.rate * fault.tick, fault.rate * fault.tick))
    fault.memory = angle + step, remaining - step
    drive.tilt[fault.k] = angle + step
    drive.jammed[fault.k] = True


def slow(fault, command):
    if fault.memory is None:
        fault.memory = float(fault.truth.tilt[fault.k])
    step = fault.rate * fault.tick
    fault.memory += float(np.clip(command - fault.memory, -step, step))
    return fault.memory


def encoder_frozen(fault, reading):
    if fault.memory is None:
        fault.memory = float(reading.position[fault.k])
    position, velocity = reading.position.copy(), reading.velocity.copy()
    position[fault.k], velocity[fault.k] = fault.memory, 0.0
    return replace(reading, position=position, velocity=velocity)


# Sensors, battery and processes ----------------------------------------------------------------

def mocap_turned(fault, pose):
    return replace(pose, quaternion=rotations.multiply(pose.quaternion, _turn(fault)))


def mocap_noisy(fault, pose):
    noise = fault.random.standard_normal(6)
    turn = rotations.exp(fault.orientation * noise[3:])
    return replace(pose, position=pose.position + fault.position * noise[:3],
                   quaternion=rotations.multiply(pose.quaternion, turn))


def mocap_lags(fault, pose):
    return [replace(late, stamp=late.stamp + fault.delay) for late in delayed(fault, pose, 1)]


def mocap_slow(fault, pose):
    if fault.memory is not None and fault.now < fault.memory - ROUNDING:
        return None
    fault.memory = fault.now + fault.period
    return pose


def imu_spikes(fault, motion):
    hit, *direction = fault.random.uniform(-1, 1, 7)
    hits = abs(hit) < fault.tick / fault.period
    return motion + _both(fault) * np.sign(direction) if hits else motion


def imu_axis_dead(fault, motion):
    motion[int(fault.axis) - 1] = 0.0
    return motion


def battery_charge(fault):
    first, fault.memory = fault.memory is None, True
    return fault.charge if first else 1.0


def estimator_diverges(fault, state):
    time = fault.memory = (fault.memory or 0.0) + fault.tick
    away = np.array([1.0, 0.0, 0.0])
    return replace(state, position=state.position + 0.5 * fault.acceleration * time ** 2 * away,
                   velocity=state.velocity + fault.acceleration * time * away)


def estimator_rubbish(fault, state):
    row = fault.random.standard_normal(13)
    return replace(state, position=3 * row[:3], velocity=3 * row[3:6],
                   quaternion=rotations.normalized(row[6:10]), angular_velocity=3 * row[10:])


def controller_rubbish(fault, command):
    return replace(command, tilt=fault.random.uniform(-3, 3, 4),
                   thrust=fault.random.uniform(0, 20, 4))


def controller_noisy(fault, command):
    tilt, thrust = fault.random.standard_normal((2, 4))
    return replace(command, tilt=command.tilt + fault.tilt * tilt,
                   thrust=np.maximum(command.thrust + fault.thrust * thrust, 0.0))


# The table -------------------------------------------------------------------------------------

def number(default: Any = MISSING, unit: str = '', low: float = -1e9, high: float = 1e9):
    """Declare a number; without a default it must be given."""
    return parameter(default, doc='', unit=unit, low=low, high=high)


def vector(unit: str, names: str = 'x y z', **defaults: float) -> dict[str, Field]:
    """Components of a vector, each 0 by default."""
    return {name: number(defaults.get(name, 0.0), unit) for name in names.split()}


RPY = 'roll pitch yaw'
ROTOR, SERVO = {'rotor': number(low=1, high=4)}, {'servo': number(low=1, high=4)}
SHARE = {'share': number(low=0, high=1)}
DELAY = {'delay': number(unit='s', low=0, high=5)}
STEP = {'step': number(unit='s', low=-100, high=100)}

# docs/faults.md describes each kind.
KINDS = {
    'rotor_stops': Kind(ROTOR, drive=driven('thrust', lambda fault, command: 0.0)),
    'rotor_weak': Kind(ROTOR | SHARE, drive=driven(
        'thrust', lambda fault, command: fault.share * command)),
    'propeller_broken': Kind(ROTOR | SHARE, drive=propeller_broken),
    'rotor_sticks': Kind(ROTOR, drive=driven(
        'thrust', lambda fault, _: fault.truth.thrust[fault.k])),
    'rotor_slow': Kind(ROTOR | {'time_constant': number(unit='s', low=0.005, high=10)},
                       drive=driven('thrust', lagging)),
    'servo_jammed': Kind(SERVO | {'offset': number(0.0, 'rad', -8, 8),
                                  'rate': number(10.0, 'rad/s', 0.1, 100)}, drive=servo_jammed),
    'servo_limp': Kind(SERVO, drive=driven('powered', lambda fault, _: False)),
    'servo_slow': Kind(SERVO | {'rate': number(unit='rad/s', low=0.01, high=100)},
                       drive=driven('tilt', slow)),
    'servo_deaf': Kind(SERVO, drive=driven('tilt', lambda fault, _: fault.held[fault.k])),
    'encoder_shifted': Kind(
        SERVO | {'angle': number(unit='rad', low=-8, high=8)},
        drive=driven('tilt', lambda fault, command: command - fault.angle),
        joints=added('position', lambda fault: fault.angle * np.eye(4)[fault.k])),
    'encoder_frozen': Kind(SERVO, joints=encoder_frozen),
    'joints_lost': Kind(joints=lost),
    'rotor_speed_lost': Kind(rotors=lost),

    'clock_jumps': Kind(STEP, clock=lambda fault: fault.step),
    'estimator_dead': Kind(estimate=lost),
    'estimator_diverges': Kind({'acceleration': number(1.0, 'm/s^2', 0, 1000)},
                               estimate=estimator_diverges),
    'estimator_nan': Kind(estimate=lambda fault, state: replace(
        state, position=np.full(3, np.nan))),
    'estimator_rubbish': Kind(estimate=estimator_rubbish),
    'estimator_frozen': Kind(estimate=frozen),
    'controller_silent': Kind(request=lost),
    'controller_nan': Kind(request=lambda fault, command: replace(
        command, thrust=np.full(4, np.nan))),
    'controller_rubbish': Kind(request=controller_rubbish),
    'controller_constant': Kind(request=frozen),
    'controller_noisy': Kind({'tilt': number(0.0, 'rad', 0, 3), 'thrust': number(0.0, 'N', 0, 20)},
                             request=controller_noisy),
    'controller_slow': Kind(DELAY, late=True, request=delayed),
    'supervisor_waits': Kind(waits=lambda fault: True),
    'target': Kind(vector('m', z=1.0) | vector('rad', RPY),
                   target=lambda fault: (_axes(fault), _turn(fault))),
    'motor_board_lost': Kind(bridges=lambda fault: {'rotor': 'lost: motor board silent'}),
    'joint_bridge_used': Kind(bridges=lambda fault: {'joint': 'ready'}),
    'servo_bus_lost': Kind(bridges=lambda fault: {'joint': 'lost: a servo is silent'}),

    'mocap_lost': Kind(mocap=lost),
    'mocap_drops': Kind(SHARE, mocap=dropped),
    'mocap_frozen': Kind(mocap=frozen),
    'mocap_jumps': Kind(vector('m'), mocap=added('position', _axes)),
    'mocap_turned': Kind(vector('rad', RPY), mocap=mocap_turned),
    'mocap_noisy': Kind({'position': number(0.0, 'm', 0, 10),
                         'orientation': number(0.0, 'rad', 0, 3)}, mocap=mocap_noisy),
    'mocap_delayed': Kind(DELAY, late=True, mocap=lambda fault, pose: delayed(fault, pose, 1)),
    'mocap_lags': Kind(DELAY, late=True, mocap=mocap_lags),
    'mocap_slow': Kind({'period': number(unit='s', low=0.01, high=5)}, mocap=mocap_slow),
    'mocap_clock': Kind(STEP, mocap=added('stamp', lambda fault: fault.step)),
    'imu_lost': Kind(imu=lost),
    'imu_frozen': Kind(imu=frozen),
    'imu_clock': Kind(STEP, imu=added('stamp', lambda fault: fault.step)),
    'gyroscope_bias': Kind(vector('rad/s'), imu=added('angular_velocity', _axes)),
    'accelerometer_bias': Kind(vector('m/s^2'), imu=added('specific_force', _axes)),
    'imu_saturated': Kind(
        {'specific_force': number(1000.0, 'm/s^2', 0, 1000),
         'rate': number(1000.0, 'rad/s', 0, 1000)},
        imu=of_motion(lambda fault, motion: np.clip(motion, -_both(fault), _both(fault)))),
    'imu_nan': Kind(imu=of_motion(lambda fault, motion: np.full(6, np.nan))),
    'imu_spikes': Kind(
        {'period': number(0.1, 's', 0.005, 100), 'rate': number(0.0, 'rad/s', 0, 1000),
         'specific_force': number(0.0, 'm/s^2', 0, 1000)}, imu=of_motion(imu_spikes)),
    'imu_axis_dead': Kind({'axis': number(low=1, high=6)}, imu=of_motion(imu_axis_dead)),

    'commands_lost': Kind(command=lost),
    'commands_drop': Kind(SHARE, command=dropped),
    'commands_delayed': Kind(DELAY, late=True, command=delayed),
    'battery_charge': Kind({'charge': number(low=0, high=1)}, charge=battery_charge),
    'battery_resistance': Kind({'resistance': number(unit='ohm', low=0, high=2)},
                               resistance=lambda fault: fault.resistance),
    'battery_unread': Kind(battery=lost),
    'payload': Kind({'mass': number(unit='kg', low=0, high=10)},
                    payload=lambda fault: fault.mass),
    'push': Kind(vector('N') | vector('N m', RPY), wrench=lambda fault: np.array(
        [fault.x, fault.y, fault.z, fault.roll, fault.pitch, fault.yaw])),
}
