"""
The residual: measurements of IMU, MoCap and encoders minus the model's expectation.

It has four groups of channels. Each group has measured inputs, so that errors do not propagate:

- B: specific force and angular acceleration minus the body equations at the measured tilts,
- A: acceleration by MoCap minus specific force of the IMU; independent of the robot's model,
- W: rate by MoCap minus gyroscope; independent of the robot's model,
- J: encoders minus servos simulated from the commands.
"""

import numpy as np

from beetle_omni_ros.identify.gap.body import BodyModel
from beetle_omni_ros.identify.gap.ingest import Flight
from beetle_omni_ros.identify.gap.keys import delays_of, Key
from beetle_omni_ros.identify.gap.parameters import GapParameters
from beetle_omni_ros.identify.gap.servo import (
    module_load,
    simulate,
    targets_at,
    undescribed_load,
    Windows,
)
from beetle_omni_ros.identify.gap.signals import Signals
from beetle_omni_ros.identify.gap.treatment import TREATMENTS
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.model.servo import NUMPY, Servo

CHANNELS = {'B': ('force_x', 'force_y', 'force_z', 'torque_x', 'torque_y', 'torque_z'),
            'A': ('acceleration_x', 'acceleration_y', 'acceleration_z'),
            'W': ('rate_x', 'rate_y', 'rate_z'),
            'J': ('joint_1', 'joint_2', 'joint_3', 'joint_4')}
UNITS = {'force': 'm/s^2', 'torque': 'rad/s^2', 'acceleration': 'm/s^2', 'rate': 'rad/s',
         'joint': 'rad'}
# Time shift of an encoder reading for each second of delay of these sensors.
SHIFTS = dict.fromkeys(delays_of('imu'), -1.0) | dict.fromkeys(delays_of('encoders'), 1.0)
# Parameters with central differences. With one-sided ones, slopes of equivalent delays differ by
# the second derivative, and a linear fit exploits the difference.
BOTH_SIDES = 'delay'


class FlightModel:
    """
    Signals, body equations and servos of one flight; all flights share the body equations.

    A subclass defines the residual and the filter of the joints.

    Attributes:
        modules: share of the file's tilting modules in the model, 0 or 1; fits vary it around
            that.
        trusted: (N,) whether a grid point is away from the ground and from the rotor limits.

    """

    def __init__(self, flight: Flight, robot: RobotParameters, body: BodyModel,
                 keys: dict[str, Key], p: GapParameters):
        self.flight, self.robot, self.keys, self.p, self._body = flight, robot, keys, p, body
        self.modules = 0.0
        self.signals = Signals(flight, robot, p)
        self._length = round(p.servo_window / p.grid)
        count = len(self.signals.t) - round(p.servo_warm_up / p.grid) - 1
        self._starts = np.arange(0, count - self._length + 1, self._length) \
            + round(p.servo_warm_up / p.grid)
        self._cache: dict[tuple, tuple] = {}      # of _windows
        self._last: tuple = (None, {})      # point of the last residual, and the residual by group
        self.trusted = self._trusted()

    def _trusted(self):
        """(N,) whether a grid point is not at the rotor limit for its voltage, nor grounded."""
        s, p = self.signals, self.p
        bad = s.pose({})[0][:, 2] < p.contact_height
        rows = sorted(self.robot.rotors.map, key=lambda row: row.voltage)
        if rows:
            volts = s.voltage * self.robot.battery.full_voltage
            most = np.interp(volts, [row.voltage for row in rows],
                             [row.thrust_max for row in rows])
            commanded = self.flight.command[np.clip(np.searchsorted(
                self.flight.command_t, s.t) - 1, 0, None), 4:].max(axis=1)
            bad |= commanded > p.limit_margin * most
        # Rotor lag: a limit also affects the following samples.
        memory = round(5 * self.robot.rotors.time_constant / p.grid)
        spread = np.convolve(bad, np.ones(memory))[:len(bad)] > 0
        return ~spread

    def inputs(self, theta: dict[str, float]) -> dict[str, np.ndarray]:
        """Inputs (N, width) of the body equations."""
        s = self.signals
        _, rate, _ = s.imu(theta)
        position, quaternion, velocity = s.pose(theta)
        tilt, tilt_rate, tilt_acceleration, _ = s.joints(theta)
        thrust, thrust_rate = s.thrust(theta)
        return {'velocity': velocity, 'quaternion': quaternion, 'rate': rate, 'tilt': tilt,
                'thrust': thrust, 'tilt_rate': tilt_rate, 'tilt_acceleration': tilt_acceleration,
                'thrust_rate': thrust_rate, 'position': position, 'voltage': s.voltage,
                'charge': s.charge,
                'modules': np.full(len(s.t), self.modules + theta.get('modules.share', 0.0))}

    def residual(self, theta: dict[str, float], groups: str = 'BAWJ') -> dict[str, np.ndarray]:
        """Group -> (M, channels) measured minus expected."""
        point = (self.modules, theta)
        if self._last[0] != point:
            self._last = (self.modules, dict(theta)), {}
        result = self._last[1]
        result.update(self._residual(theta, ''.join(g for g in groups if g not in result)))
        return {group: result[group] for group in groups}

    def _residual(self, theta: dict[str, float], groups: str) -> dict[str, np.ndarray]:
        """As :meth:`residual`, without the cache."""
        raise NotImplementedError

    def _of_joints(self, series: np.ndarray) -> np.ndarray:
        """Filtered and thinned series (N, 4) of the joints."""
        raise NotImplementedError

    def _joints(self, sets):
        """Encoders minus simulated servos, [(M, 4)] for each set."""
        first, count = self._starts[0], self._length * len(self._starts)
        return [self._of_joints(self.signals.joints(theta)[3][first:first + count]
                                - self._servos([theta], theta)[0].reshape(-1, 4))
                for theta in sets]

    def smooth_tilts(self, theta: dict[str, float]) -> None:
        """
        With noisy encoders, take the fast part of the tilts from the servo model at ``theta``.

        Noise in the tilts would enter the residual and the slopes of the body equations. A fit
        explains its second derivative by a larger mass of the tilting modules, for example.
        """
        s = self.signals
        if s.reading_noise < self.p.guide_above:
            return
        run = self._servos([theta], theta)[0].reshape(-1, 4)
        tilts = s.joints(theta)[0].copy()
        tilts[self._starts[0]:self._starts[0] + len(run)] = run
        s.use_model_tilts(tilts)
        self._cache.clear()
        self._last = (None, {})

    def _servos(self, sets, at):
        """Simulated servos (P, W, M, 4) of each set, with initial states and loads at ``at``."""
        windows, edges = self._windows(at)
        targets = [targets_at(self.signals, theta, edges) for theta in sets]
        runs = simulate(self.robot, windows, np.array(targets), sets, self.modules)
        return runs.transpose(0, 2, 1, 3)

    def _joint_slopes(self, theta, names):
        """
        Derivatives (M, 4) of the joints' residual by each key.

        The derivative by an encoder delay uses the rate of the simulated servo. The rate of the
        encoder would explain its own noise, shifted in time.
        """
        # Servos are independent, so one run with all gains changed gives the slope of each.
        sources = [f'joint_bandwidth.{self.keys[name].parameter}'
                   if self.keys[name].effect == 'servo' else name for name in names]
        moved = list(dict.fromkeys(sources))
        sizes = [self.keys[name].step for name in moved]
        # Central differences: gains, loads and inertia scaled by one factor leave the motion
        # unchanged, and with one-sided differences their slopes would not add up to zero.
        sets = [theta, *({**theta, name: theta.get(name, 0.0) + side * h}
                         for side in (1, -1) for name, h in zip(moved, sizes, strict=True))]
        runs = self._servos(sets, theta)
        rate, slopes = np.gradient(runs[0], self.p.grid, axis=1), {}
        ahead, behind = runs[1:].reshape(2, len(moved), *runs[0].shape)
        for name, change in zip(moved, ahead - behind, strict=True):
            slope = rate * SHIFTS.get(name, 0.0) - change / (2 * self.keys[name].step)
            slopes[name] = self._of_joints(slope.reshape(-1, 4))
        return [slopes[source] * (np.arange(4) == self.keys[name].index)
                if source != name else slopes[name]
                for name, source in zip(names, sources, strict=True)]

    def _windows(self, theta):
        """Windows of the servos and the edges of their steps, cached by the sensor delays."""
        timing = {name: theta.get(name, 0.0) for name in SHIFTS}
        key = tuple(timing.values())
        if key not in self._cache:
            if len(self._cache) > 3:
                del self._cache[next(iter(self._cache))]
            self._cache[key] = self._make_windows(timing)
        return self._cache[key]

    def _make_windows(self, theta):
        p, s = self.p, self.signals
        skip, count = round(p.servo_warm_up / p.servo_step), round(p.servo_window / p.servo_step)
        begins = s.t[self._starts] - skip * p.servo_step
        edges = begins[:, None] + p.servo_step * np.arange(skip + count + 1)
        tilt, rate, _, _ = s.joints(theta)
        at = self._starts - round(p.servo_warm_up / p.grid)
        middle = edges[:, :-1] + p.servo_step / 2
        index = np.clip(np.rint((middle - s.t[0]) / p.grid).astype(int), 0, len(s.t) - 1)
        loads = (s.thrust({})[0], module_load(s, theta),
                 *undescribed_load(s, theta))
        force, load, *more = (series[index].transpose(1, 0, 2) for series in loads)
        return Windows(tilt[at], rate[at], force, load, p.servo_step, skip,
                       round(p.grid / p.servo_step), tuple(more)), edges


def starts_of(key, models):
    """Starts of an effect without a slope; of a limit, where it begins to act in these flights."""
    treatment = TREATMENTS[key.effect]
    if treatment.limit is None:
        return treatment.starts
    what, below = treatment.limit
    most = max(float({
        'tilt_rate': lambda m: np.abs(m.signals.joints({})[1]).max(),
        'torque': lambda m: np.quantile(np.abs(_torques(m)), 0.999),
        'thrust': lambda m: np.quantile(m.flight.command[:, 4:], 0.999)}[what](m))
        for m in models)
    return tuple((float(np.log(part * most / key.base)),) for part, in treatment.starts
                 if part * most < below * key.base)


def _torques(model):
    """
    Torques [N m] that the simulated servo loops request, without limits and encoder noise.

    They include damping, which takes most of the stiffness term while a servo turns.
    """
    s, joint = model.signals, model.robot.joints
    run = model._servos([{}], {})[0]
    rate = np.gradient(run, model.p.grid, axis=1)
    times = s.t[model._starts][:, None] + model.p.grid * np.arange(run.shape[1])
    edges = np.append(times.ravel(), times[-1, -1] + model.p.grid)
    target = s.tilt_targets(edges, s.delays({})[0]).reshape(run.shape)
    return Servo.of(joint, effort_limit=None).motor(NUMPY, target - run, rate)
