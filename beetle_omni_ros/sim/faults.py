"""
Faults of the simulated robot, its devices and the flight stack, as one table KINDS.

An example is ``Fault('rotor_weak', at=3.0, duration=1.0, rotor=2, share=0.5)``. Faults of robot
and devices go to ``Simulator.set_faults``, those of processes to the in-process loop.

A function of the table gets an active fault with the numbers of its kind and the attributes that
:meth:`Schedule.update` sets. What else it gets and returns depends on its signal:

- ``imu``, ``mocap``, ``joints``, ``rotors``, ``battery``: the reading that arrives; returns the
  changed one, or None. ``command`` and ``request`` do the same for the commands to the actuators
  and of the active controller, ``estimate`` for the state.
- ``drive``: the Actuation of this tick, changed in place.
- ``switch``: the Battery and whether the fault begins or ends.
- ``wrench``: (6,) force in world [N] and torque in base_link [N m]; ``payload``: mass [kg].
- ``clock``: error of the flight computer's clock [s]; ``waits``: whether the supervisor is not
  scheduled; ``target``: position [m] and quaternion of another target; ``bridges``: bridge -> its
  reported state.

The function of a ``late`` kind is also called without an item, and returns the list of due ones.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from math import exp, inf
from types import SimpleNamespace
from typing import Any

import numpy as np

from beetle_omni_ros.robot import rotations
from beetle_omni_ros.robot.schema import ParameterError, quoted

ROUNDING = 1e-9     # [s] bound of the rounding error of sums of ticks
LARGEST = 1e9       # bound of any number, against typing errors
READINGS = 'imu', 'mocap', 'joints', 'rotors', 'battery'        # attributes of a Frame
OF_PROCESSES = {'estimate', 'request', 'clock', 'waits', 'target', 'bridges'}


@dataclass(frozen=True)
class Number:
    """Meaning, SI unit, default (None: it must be given) and legal values of a number."""

    doc: str
    unit: str = ''
    default: float | None = None
    low: float = -LARGEST
    high: float = LARGEST
    whole: bool = False

    def checked(self, value: Any, at: str) -> float:
        """Return a legal value as a float, else raise a ParameterError that starts with ``at``."""
        if isinstance(value, bool) or not isinstance(value, (int, float, np.number)) \
                or not -inf < value < inf or (self.whole and value != int(value)):
            kind = 'a whole number' if self.whole else 'a number'
            raise ParameterError(f"{at}: expected {kind}{f' [{self.unit}]' if self.unit else ''}, "
                                 f'found {quoted(value)}')
        if not self.low <= value <= self.high:
            raise ParameterError(f'{at}: {quoted(value)} is outside {self.low:g} to '
                                 f'{self.high:g} {self.unit}'.rstrip())
        return float(value)


class Kind:
    """What happens, the functions by signal, and the numbers of one kind of fault."""

    def __init__(self, doc: str, numbers: Mapping[str, Number] = {}, *, late: bool = False,
                 **functions: Callable):
        self.doc, self.numbers, self.late, self.functions = doc, numbers, late, functions


@dataclass
class Actuation:
    """Inputs of the actuators in one tick; faults change them in place."""

    tilt: np.ndarray        # (4,) targets of the servos [rad]
    thrust: np.ndarray      # (4,) targets of the rotors [N]
    powered: np.ndarray     # (4,) whether a servo has torque
    jammed: np.ndarray      # (4,) whether a joint is jammed at its target
    wear: np.ndarray        # (4,) thrust relative to an intact propeller at the same speed


# Functions of several kinds ---------------------------------------------------------------------

def lost(fault, item):
    return None


def dropped(fault, item):
    return None if fault.random.uniform() < fault.share else item


def frozen(fault, item):
    fault.memory = fault.memory or item
    return replace(fault.memory, stamp=item.stamp)


def stamped_wrongly(fault, item):
    return replace(item, stamp=item.stamp + fault.step)


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

def rotor_weak(fault, drive):
    drive.thrust[fault.k] *= fault.share


def propeller_broken(fault, drive):
    drive.thrust[fault.k] *= fault.share
    drive.wear[fault.k] *= max(fault.share, 1e-6)


def rotor_stops(fault, drive):
    drive.thrust[fault.k] = 0.0


def rotor_sticks(fault, drive):
    drive.thrust[fault.k] = fault.truth.thrust[fault.k]


def rotor_slow(fault, drive):
    if fault.memory is None:
        fault.memory = float(fault.truth.thrust[fault.k])
    gain = 1 - exp(-fault.tick / fault.time_constant)
    fault.memory += gain * (drive.thrust[fault.k] - fault.memory)
    drive.thrust[fault.k] = fault.memory


def servo_jammed(fault, drive):
    angle, remaining = fault.memory or (float(fault.truth.tilt[fault.k]), fault.offset)
    step = float(np.clip(remaining, -fault.rate * fault.tick, fault.rate * fault.tick))
    fault.memory = angle + step, remaining - step
    drive.tilt[fault.k] = angle + step
    drive.jammed[fault.k] = True


def servo_limp(fault, drive):
    drive.powered[fault.k] = False


def servo_slow(fault, drive):
    if fault.memory is None:
        fault.memory = float(fault.truth.tilt[fault.k])
    step = fault.rate * fault.tick
    fault.memory += float(np.clip(drive.tilt[fault.k] - fault.memory, -step, step))
    drive.tilt[fault.k] = fault.memory


def servo_deaf(fault, drive):
    drive.tilt[fault.k] = fault.held[fault.k]


def servo_misled(fault, drive):
    drive.tilt[fault.k] -= fault.angle


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


def battery_charge(fault, battery, begins):
    if begins:
        battery.charge = min(battery.charge, fault.charge)


def battery_resistance(fault, battery, begins):
    battery.extra_resistance += fault.resistance if begins else -fault.resistance


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

def _vector(unit: str, what: str, **defaults: float) -> dict[str, Number]:
    return {key: Number(f'{key} {what}', unit, default) for key, default in defaults.items()}


XYZ, RPY = dict.fromkeys('xyz', 0.0), dict.fromkeys(('roll', 'pitch', 'yaw'), 0.0)
ROTOR = {'rotor': Number('number of the rotor', '', None, 1, 4, whole=True)}
SERVO = {'servo': Number('number of the servo', '', None, 1, 4, whole=True)}
DELAY = {'delay': Number('additional delay', 's', low=0, high=5)}
STEP = {'step': Number('error of the stamps', 's', low=-100, high=100)}


def _share(doc: str) -> dict[str, Number]:
    return {'share': Number(doc, low=0.0, high=1.0)}


def _imu_sizes(doc: str, default: float) -> dict[str, Number]:
    return {'specific_force': Number(doc, 'm/s^2', default, 0, 1000),
            'rate': Number(doc, 'rad/s', default, 0, 1000)}


KINDS = {
    'rotor_stops': Kind('a rotor stops; its thrust fades with the rotor lag', ROTOR,
                        drive=rotor_stops),
    'rotor_weak': Kind('a rotor turns slower and gives only a share of the commanded thrust',
                       ROTOR | _share('share of the commanded thrust'), drive=rotor_weak),
    'propeller_broken': Kind(
        'a rotor turns at the commanded speed, but its propeller gives only a share of the thrust',
        ROTOR | _share('share of the thrust at that speed'), drive=propeller_broken),
    'rotor_sticks': Kind('a rotor keeps its present thrust', ROTOR, drive=rotor_sticks),
    'rotor_slow': Kind('a rotor has an additional first-order lag', ROTOR | {
        'time_constant': Number('time constant of the second lag', 's', low=0.005, high=10)},
        drive=rotor_slow),
    'servo_jammed': Kind(
        'a joint jams at its present angle, or after it has slipped by an angle', SERVO | {
            'offset': Number('angle of the slip', 'rad', 0.0, -8, 8),
            'rate': Number('rate of the slip', 'rad/s', 10.0, 0.1, 100)}, drive=servo_jammed),
    'servo_limp': Kind('a servo loses its torque, the joint swings freely', SERVO,
                       drive=servo_limp),
    'servo_slow': Kind('the rate of a servo is limited', SERVO | {
        'rate': Number('largest rate', 'rad/s', low=0.01, high=100)}, drive=servo_slow),
    'servo_deaf': Kind('a servo keeps its last target', SERVO, drive=servo_deaf),
    'encoder_shifted': Kind(
        'an encoder reads too much by an angle, and its servo uses this reading', SERVO | {
            'angle': Number('reading minus true tilt', 'rad', low=-8, high=8)},
        drive=servo_misled,
        joints=added('position', lambda fault: fault.angle * np.eye(4)[fault.k])),
    'encoder_frozen': Kind('the reported angle of a servo is frozen, the servo works', SERVO,
                           joints=encoder_frozen),
    'joints_lost': Kind('no joint feedback arrives', joints=lost),
    'rotor_speed_lost': Kind('no rotor speed arrives', rotors=lost),

    'clock_jumps': Kind("the flight computer's clock is set", {
        'step': Number('jump of the clock', 's', low=-100, high=100)},
        clock=lambda fault: fault.step),
    'estimator_dead': Kind('the estimator publishes nothing', estimate=lost),
    'estimator_diverges': Kind('the estimated position and velocity run away along world x', {
        'acceleration': Number('acceleration of the error', 'm/s^2', 1.0, 0, 1000)},
        estimate=estimator_diverges),
    'estimator_nan': Kind('the estimates are NaN', estimate=lambda fault, state: replace(
        state, position=np.full(3, np.nan))),
    'estimator_rubbish': Kind('the estimates are random states', estimate=estimator_rubbish),
    'estimator_frozen': Kind('the estimator repeats a state with new stamps', estimate=frozen),
    'controller_silent': Kind('the active controller publishes nothing', request=lost),
    'controller_nan': Kind('the commands of the active controller are NaN',
                           request=lambda fault, command: replace(
                               command, thrust=np.full(4, np.nan))),
    'controller_rubbish': Kind(
        'its commands are random tilts within 3 rad and thrusts within 20 N',
        request=controller_rubbish),
    'controller_constant': Kind('it repeats a command with new stamps', request=frozen),
    'controller_noisy': Kind('white noise on its commands; standard deviations', {
        'tilt': Number('standard deviation', 'rad', 0.0, 0, 3),
        'thrust': Number('standard deviation', 'N', 0.0, 0, 20)}, request=controller_noisy),
    'controller_slow': Kind('its commands are late', DELAY, late=True, request=delayed),
    'supervisor_waits': Kind(
        'the supervisor is not scheduled; the newest ten messages of each topic wait',
        waits=lambda fault: True),
    'target': Kind('a pose in world is requested',
                   _vector('m', 'in world', **XYZ | {'z': 1.0})
                   | _vector('rad', 'in world', **RPY),
                   target=lambda fault: (_axes(fault), _turn(fault))),
    'motor_board_lost': Kind("the rotor bridge reports 'lost'",
                             bridges=lambda fault: {'rotor': 'lost: motor board silent'}),
    'servo_bus_lost': Kind("the joint bridge reports 'lost'",
                           bridges=lambda fault: {'joint': 'lost: a servo is silent'}),

    'mocap_lost': Kind('no pose arrives', mocap=lost),
    'mocap_drops': Kind('a share of the poses is lost', _share('share of lost poses'),
                        mocap=dropped),
    'mocap_frozen': Kind('the same pose arrives with new stamps', mocap=frozen),
    'mocap_jumps': Kind('the position jumps by a permanent offset',
                        _vector('m', 'of the jump in world', **XYZ),
                        mocap=added('position', _axes)),
    'mocap_turned': Kind('the orientation jumps by a permanent turn about base_link axes',
                         _vector('rad', 'of the rotation', **RPY), mocap=mocap_turned),
    'mocap_noisy': Kind('additional noise of the pose; standard deviations of an axis', {
        'position': Number('standard deviation', 'm', 0.0, 0, 10),
        'orientation': Number('standard deviation', 'rad', 0.0, 0, 3)}, mocap=mocap_noisy),
    'mocap_delayed': Kind('poses arrive late with the stamps of their capture', DELAY, late=True,
                          mocap=lambda fault, pose: delayed(fault, pose, 1)),
    'mocap_lags': Kind('poses arrive late with late stamps', DELAY, late=True, mocap=mocap_lags),
    'mocap_slow': Kind('poses arrive at a lower rate', {
        'period': Number('time between two poses', 's', low=0.01, high=5)}, mocap=mocap_slow),
    'mocap_clock': Kind('the stamps of the poses jump by a permanent offset', STEP,
                        mocap=stamped_wrongly),
    'imu_lost': Kind('no IMU sample arrives', imu=lost),
    'imu_frozen': Kind('the same IMU sample arrives with new stamps', imu=frozen),
    'imu_clock': Kind('the stamps of the IMU jump by a permanent offset', STEP,
                      imu=stamped_wrongly),
    'gyroscope_bias': Kind('the gyroscope bias steps', _vector('rad/s', 'of the step', **XYZ),
                           imu=added('angular_velocity', _axes)),
    'accelerometer_bias': Kind('the accelerometer bias steps',
                               _vector('m/s^2', 'of the step', **XYZ),
                               imu=added('specific_force', _axes)),
    'imu_saturated': Kind('the IMU saturates', _imu_sizes('largest value', 1000.0),
                          imu=of_motion(lambda fault, motion: np.clip(
                              motion, -_both(fault), _both(fault)))),
    'imu_nan': Kind('the IMU gives NaN', imu=of_motion(lambda fault, motion: np.full(6, np.nan))),
    'imu_spikes': Kind('single IMU samples have errors in random directions', {
        'period': Number('mean time between two spikes', 's', 0.1, 0.005, 100),
        **_imu_sizes('error of an axis', 0.0)}, imu=of_motion(imu_spikes)),
    'imu_axis_dead': Kind('one axis of the IMU reads zero: 1 to 3 specific force, 4 to 6 rate', {
        'axis': Number('number of the axis', '', None, 1, 6, whole=True)},
        imu=of_motion(imu_axis_dead)),

    'commands_lost': Kind('no command reaches the actuators', command=lost),
    'commands_drop': Kind('a share of the commands is lost', _share('share of lost commands'),
                          command=dropped),
    'commands_delayed': Kind('commands reach the actuators late', DELAY, late=True,
                             command=delayed),
    'battery_charge': Kind('the charge of the pack drops to a fraction of a full one', {
        'charge': Number('remaining charge as a fraction of a full battery', low=0.0, high=1.0)},
        switch=battery_charge),
    'battery_resistance': Kind('the resistance of the pack increases', {
        'resistance': Number('additional resistance', 'ohm', low=0, high=2)},
        switch=battery_resistance),
    'battery_unread': Kind('no reading of the pack arrives', battery=lost),
    'payload': Kind('a mass is attached below the body', {
        'mass': Number('attached mass', 'kg', low=0, high=10)}, payload=lambda fault: fault.mass),
    'push': Kind('a force in world and a torque in base_link act',
                 _vector('N', 'force', **XYZ) | _vector('N m', 'torque', **RPY),
                 wrench=lambda fault: np.array([fault.x, fault.y, fault.z,
                                                fault.roll, fault.pitch, fault.yaw])),
}
TIME = Number('', 's', low=0.0)


@dataclass(frozen=True, init=False)
class Fault:
    """One fault."""

    kind: str                       # a name in KINDS
    at: float                       # time from the start of the schedule to the onset [s]
    duration: float                 # [s]; inf: permanent
    numbers: Mapping[str, float]    # all numbers of the kind, by name

    def __init__(self, kind: str, /, at: float = 0.0, duration: float = inf, **numbers: float):
        """
        Check all arguments; missing numbers have the defaults of the kind.

        Raises:
            ParameterError: illegal kind or number; the message has kind and key.

        """
        if kind not in KINDS:
            raise ParameterError(f'fault {quoted(kind)} is unknown; known: '
                                 f"{', '.join(sorted(KINDS))}")
        declared, prefix = KINDS[kind].numbers, f"fault '{kind}': key"
        for key in numbers:
            if key not in declared:
                known = ', '.join(('at', 'duration', *declared))
                raise ParameterError(f'{prefix} {quoted(key)} is unknown; known: {known}')
        values = {}
        for key, number in declared.items():
            value = numbers.get(key, number.default)
            if value is None:
                raise ParameterError(f"{prefix} '{key}' is missing ({number.doc})")
            values[key] = number.checked(value, f"{prefix} '{key}'")
        object.__setattr__(self, 'kind', kind)
        object.__setattr__(self, 'at', TIME.checked(at, f"{prefix} 'at'"))
        object.__setattr__(self, 'duration', inf if duration == inf else TIME.checked(
            duration, f"{prefix} 'duration'"))
        object.__setattr__(self, 'numbers', values)

    @property
    def is_process(self) -> bool:
        """Whether it affects a process of the flight stack, not the robot or its devices."""
        return self.changes(*OF_PROCESSES)

    def changes(self, *signals: str) -> bool:
        """Whether its kind has a function of one of these signals."""
        return not KINDS[self.kind].functions.keys().isdisjoint(signals)

    def __str__(self) -> str:
        """Kind, numbers and times: 'rotor_weak(rotor=2, share=0.5) at 3 s for 1 s'."""
        numbers = ', '.join(f'{key}={value:g}' for key, value in self.numbers.items())
        duration = '' if self.duration == inf else f' for {self.duration:g} s'
        return f"{self.kind}{f'({numbers})' if numbers else ''} at {self.at:g} s{duration}"


@dataclass(eq=False)
class _Entry:
    """A fault of a schedule, its start [s], its state since the onset, and whether it is over."""

    fault: Fault
    start: float
    state: Any = None
    over: bool = False


class Schedule:
    """
    Starts and ends faults by their times, updated once in each ``tick`` [s].

    Equal faults, seeds and calls give equal results. A fault that is in the list before and after
    a change continues unchanged. ``active`` are kind and state of the active faults, ``names``
    their kinds, in the order of the list.
    """

    def __init__(self, tick: float, seed: np.random.SeedSequence, battery=None):
        self._tick, self._seed, self._battery = tick, seed, battery
        self._entries: list[_Entry] = []
        self.active: list[tuple[Kind, Any]] = []
        self.names: list[str] = []

    def set(self, faults: Sequence[Fault], now: float) -> None:
        """Replace the faults; their ``at`` counts from ``now`` [s]."""
        before, self._entries = self._entries, []
        for fault in faults:
            same = next((entry for entry in before if entry.fault == fault), None)
            if same is not None:
                before.remove(same)
            self._entries.append(same or _Entry(fault, now))
        for entry in before:
            if entry.state is not None and not entry.over:
                self._switch(entry, False)
        self._collect()

    def update(self, now: float, truth: Any = None, held: np.ndarray | None = None) -> None:
        """
        Start and end the faults that are due at ``now`` [s].

        The state of a fault has its numbers and ``k`` (index of its rotor or servo), ``tick``,
        ``now``, ``random``, ``memory`` (for its functions, at first None), and at its onset
        ``truth`` and ``held``, the targets of the servos (4,) [rad].
        """
        changed = False
        for entry in self._entries:
            fault = entry.fault
            begin = entry.start + fault.at
            if entry.state is None and now >= begin - ROUNDING:
                numbers = fault.numbers
                entry.state = SimpleNamespace(
                    **numbers, k=int(numbers.get('rotor', numbers.get('servo', 1))) - 1,
                    tick=self._tick, now=now, memory=None, truth=truth, held=held,
                    random=np.random.default_rng(self._seed.spawn(1)[0]))
                self._switch(entry, True)
                changed = True
            if entry.state is not None and not entry.over \
                    and now >= begin + fault.duration - ROUNDING:
                self._switch(entry, False)
                entry.over = changed = True
        if changed:
            self._collect()

    def _switch(self, entry, begins):
        if switch := KINDS[entry.fault.kind].functions.get('switch'):
            switch(entry.state, self._battery, begins)

    def _collect(self):
        running = [entry for entry in self._entries if entry.state is not None and not entry.over]
        self.active = [(KINDS[entry.fault.kind], entry.state) for entry in running]
        self.names = [entry.fault.kind for entry in running]

    def through(self, signal: str, item: Any, now: float) -> list:
        """Items that arrive ``now`` [s] if ``item``, or None, is sent through the faults."""
        items = [] if item is None else [item]
        for kind, state in self.active:
            function = kind.functions.get(signal)
            if function is None:
                continue
            state.now = now
            if kind.late:
                items = [out for one in items or [None] for out in function(state, one)]
            else:
                items = [out for one in items if (out := function(state, one)) is not None]
        return items

    def each(self, signal: str, *arguments: Any) -> list:
        """Results of the functions of ``signal`` of the active faults."""
        return [kind.functions[signal](state, *arguments) for kind, state in self.active
                if signal in kind.functions]

    @property
    def empty(self) -> bool:
        """Whether the list is empty."""
        return not self._entries
