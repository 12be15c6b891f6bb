"""
Residuals of a flight that was recorded as a bag, with their slopes.

It has four groups of channels on one grid. Each group has measured inputs, so that errors do not
propagate:

- B, force and torque: specific force and angular acceleration minus the body equations at the
  measured tilts,
- A, acceleration: of MoCap minus that of the IMU; independent of the robot's model,
- W, rate: of MoCap minus gyroscope; independent of the robot's model,
- J, joint: encoders minus servos that are simulated from the commands.
"""

from __future__ import annotations

import numpy as np

from beetle_omni_ros.identify.flights.body import BodyModel
from beetle_omni_ros.identify.flights.keys import delays_of, Key, OF_ONE, of_start, TILT_BUS
from beetle_omni_ros.identify.flights.servo import simulate, windows_of
from beetle_omni_ros.identify.flights.signals import IMU_LAG, Signals
from beetle_omni_ros.identify.flights.spectrum import blocks_of, Linear, warm
from beetle_omni_ros.identify.recording.bag import COMMAND, Recording
from beetle_omni_ros.identify.recording.parameters import GapParameters
from beetle_omni_ros.identify.recording.series import FASTEST, low_pass, matrices, THIN, within
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.model.parts import ThrustMap

CHANNELS = {'B': ('force_x', 'force_y', 'force_z', 'torque_x', 'torque_y', 'torque_z'),
            'A': ('acceleration_x', 'acceleration_y', 'acceleration_z'),
            'W': ('rate_x', 'rate_y', 'rate_z'),
            'J': ('joint_1', 'joint_2', 'joint_3', 'joint_4')}
PLACE = {'B': slice(0, 6), 'A': slice(6, 9), 'W': slice(9, 12), 'J': slice(12, 16)}
# Time shift of an encoder reading, and of a pose of MoCap, for each second of delay of a sensor.
SHIFTS = dict.fromkeys(delays_of('imu'), -1.0) | dict.fromkeys(delays_of('encoders'), 1.0)
POSE_SHIFTS = dict.fromkeys(delays_of('imu'), -1.0) | dict.fromkeys(delays_of('mocap'), 1.0)
# Keys by which the tilts of a servo model are late. Gains are those of the joints alone: with
# forces, a fit takes the answer of a controller to noise for softer servos.
LATE_TILTS = {TILT_BUS, IMU_LAG, 'command_latency.delay', 'joint_command_latency.delay'}
# Parameters with central differences. With one-sided ones, slopes of equivalent delays differ by
# the second derivative, and a linear fit exploits the difference.
BOTH_SIDES = 'delay'
LEAST = 0.1             # smallest share of a start to which its keys may fall in one step
WIDEST = 16.0           # [Hz] low-pass edge of joint angles, of which every second one counts
# [Hz] largest frequency of each group: above 8 Hz the filters of readings and tilts differ, and a
# fit takes the difference for a larger mass of the tilting modules
HIGHEST = {'B': 8.0, 'A': FASTEST, 'W': FASTEST, 'J': WIDEST}


class BagFlight:
    """
    Signals, body equations and servos of one flight; all flights share the body equations.

    Attributes:
        modules: share of the file's tilting modules in the model, 0 or 1; fits vary it.
        trusted: (N,) whether a grid point is away from the ground and from the rotor limits.
        period: of the samples [s].
        mask: (M, 16) samples that count.
        rows: (M,) rows of the grid of the signals.
        time: (M,) times of the samples [s].
        starts: name of a start -> deviations of the keys of its effect.
        tangents: name of a tangent -> start and key.

    """

    channels = tuple(name for group in CHANNELS.values() for name in group)
    turning = 'rate'        # IMU and MoCap agree in it where the robot moves
    highest = np.repeat([HIGHEST[group] for group in CHANNELS], [6, 3, 3, 4])

    def __init__(self, flight: Recording, robot: RobotParameters, body: BodyModel,
                 keys: dict[str, Key], p: GapParameters):
        self.flight, self.robot, self.keys, self.p, self._body = flight, robot, keys, p, body
        self.name, self.period, self.modules = flight.name, THIN * p.grid, 0.0
        self.starts: dict[str, dict[str, float]] = {}
        self.tangents: dict[str, tuple[str, str]] = {}
        self.signals = Signals(flight, robot, p)
        self._length = round(p.servo_window / p.grid)
        count = len(self.signals.t) - round(p.servo_warm_up / p.grid) - 1
        self._starts = np.arange(0, count - self._length + 1, self._length) \
            + round(p.servo_warm_up / p.grid)
        self._kept: tuple = (None, None)        # delays of the last windows, and these
        self._runs: dict[frozenset, np.ndarray] = {}    # deviations -> simulated servos
        self.trusted = self._trusted()
        first, count = self._starts[0], self._length * len(self._starts)
        self._simulated = slice(first, first + count)       # rows of the servos' windows
        self.rows = first + THIN * np.arange(count // THIN)
        self.time = self.signals.t[self.rows]
        self._fine = low_pass(WIDEST, 1, p.grid)
        self._poses = low_pass(FASTEST, 1, p.grid)
        self.mask = np.ones((len(self.rows), len(self.channels)), dtype=bool)
        self.mask[:, :6] = self.trusted[self.rows, None]
        far = self._poses.margin
        inside = (self.rows >= far) & (self.rows < len(self.signals.t) - far)
        self.mask[:, 6:12] = inside[:, None]
        self.usable = len(blocks_of(warm(self.mask, self.period), self.period)) > 0

    def _trusted(self):
        """(N,) whether a grid point is not at the rotor limit for its voltage, nor grounded."""
        s, p = self.signals, self.p
        bad = s.pose({})[0][:, 2] < p.contact_height
        if self.robot.rotors.map:
            most = ThrustMap(self.robot.rotors).thrust_limit_below(
                s.voltage * self.robot.battery.full_voltage)
            commanded = self.flight.values[COMMAND][np.clip(np.searchsorted(
                self.flight.times[COMMAND], s.t) - 1, 0, None), 4:].max(axis=1)
            bad |= commanded > p.limit_margin * most
        # Rotor lag: a limit also affects the following samples.
        memory = round(5 * self.robot.rotors.time_constant / p.grid)
        return np.convolve(bad, np.ones(memory))[:len(bad)] == 0

    def _inputs(self, theta):
        """Inputs of the body equations, name -> (M, width)."""
        s = self.signals
        thrust, thrust_rate = s.smooth_thrust(theta)
        position, quaternion, velocity = s.pose(theta)
        tilt, tilt_rate, tilt_acceleration, _ = s.joints(theta)
        inputs = {'velocity': velocity, 'quaternion': quaternion, 'rate': s.imu(theta)[1],
                  'tilt': tilt, 'tilt_rate': tilt_rate, 'tilt_acceleration': tilt_acceleration,
                  'thrust': thrust, 'thrust_rate': thrust_rate, 'position': position,
                  'voltage': s.voltage,
                  'modules': np.full(len(s.t), self.modules + theta.get('modules.share', 0.0)),
                  **{f'state of {name}': s.state(name, theta) for name in self._body.slow}}
        return {name: values[self.rows] for name, values in inputs.items()}

    def residual(self, theta: dict[str, float], groups: str = 'BAWJ') -> dict[str, np.ndarray]:
        """Group -> (M, channels) measured minus expected."""
        result = {}
        force, rate, turning = self.signals.imu(theta)
        if 'B' in groups:
            result['B'] = np.concatenate([force, turning], axis=1)[self.rows] \
                - self._body(self._inputs(theta), theta)
        if 'A' in groups or 'W' in groups:
            position, quaternion, _ = self.signals.pose(theta)
            rotation = matrices(quaternion)
        if 'A' in groups:
            world = np.einsum('nij,nj->ni', rotation, force)
            world[:, 2] -= self.robot.gravity
            result['A'] = (within(self._poses, world, 0)
                           - within(self._poses, position, 2))[self.rows]
        if 'W' in groups:
            change = np.gradient(rotation, self.p.grid, axis=0)
            skew = np.einsum('nji,njk->nik', rotation, change)
            seen = np.stack([skew[:, 2, 1] - skew[:, 1, 2], skew[:, 0, 2] - skew[:, 2, 0],
                             skew[:, 1, 0] - skew[:, 0, 1]], axis=1) / 2
            result['W'] = within(self._poses, rate - seen, 0)[self.rows]
        if 'J' in groups:
            run = self._runs.get(frozenset(theta.items()))
            run = self._servos([theta], theta)[0] if run is None else run
            result['J'] = self._of_joints(self.signals.joints(theta)[3][self._simulated]
                                          - run.reshape(-1, 4))
        return result

    def _of_joints(self, series):
        """Filtered and thinned series (N, 4) of the joints."""
        return within(self._fine, series, 0)[::THIN]

    def linear(self, theta: dict[str, float], names: list[str]) -> Linear:
        """Residual and its slopes at deviations ``theta`` of keys, starts and tangents."""
        theta, own = self._real(theta)
        like = {name: self._of_all(name, own) for name in names if name in self.starts}
        ends = {name: self._ends(name, theta, own) for name, other in like.items() if not other}
        self.run_servos([theta, *(end for name, both in ends.items() for end in both
                                  if 'J' in self._groups_of(name))])
        now = self.residual(theta)
        residual = np.concatenate([now[group] for group in PLACE], axis=1)
        slopes = np.zeros((len(names), *residual.T.shape)).T
        # name -> key and factor of its slope; a tangent counts where its start acts
        factors = {name: (name, 1.0) for name in names
                   if name not in self.starts and name not in self.tangents}
        factors |= {name: (key, self.starts[start][key])
                    for name, (start, key) in self.tangents.items()
                    if start in own and name in names}
        keys = list(dict.fromkeys(key for key, _ in factors.values()))
        of_keys = self._slopes(theta, now, keys) if keys else slopes
        for k, name in enumerate(names):
            if like.get(name):
                joint = PLACE['J'].start + (of_start(name)[1] or 0) - 1
                slopes[:, joint, k] = slopes[:, joint, names.index(like[name])]
            elif name in self.starts:
                groups = self._groups_of(name)
                behind, ahead = (
                    now if end == theta and self.signals.model_tilts is None
                    else self._guided(end, groups) for end in ends[name])
                for group in groups:
                    slopes[:, PLACE[group], k] = (ahead[group] - behind[group]) \
                        / own.get(name, 1.0)
            elif name in factors:
                key, part = factors[name]
                slopes[:, :, k] = part * of_keys[:, :, keys.index(key)]
        return Linear(residual, slopes)

    def run_servos(self, sets):
        """Simulate the servos at all ``sets`` at once, none of which changes a sensor."""
        each = {frozenset(theta.items()): theta for theta in sets}
        self._runs = dict(zip(each, self._servos([*each.values()], sets[0]), strict=True))

    def _guided(self, theta, groups):
        """Residual with the tilts of the servo model at ``theta``, where they are of a model."""
        before, run = self.signals.model_tilts, self._runs.get(frozenset(theta.items()))
        return self.residual(theta, groups) if before is None or run is None \
            else self._with_tilts(before, run, theta, groups)

    def _with_tilts(self, before, run, theta, groups):
        """Residual at ``theta`` with fast tilts of simulated servos, not those ``before``."""
        self._use_tilts(before, run)
        result = self.residual(theta, groups)
        self.signals.use_model_tilts(before)
        return result

    def measured(self, theta: dict[str, float]) -> np.ndarray:
        """(M, 16) measurements of the channels at deviations ``theta``."""
        theta = self._real(theta)[0]
        force, rate, turning = self.signals.imu(theta)
        world = np.einsum('nij,nj->ni', matrices(self.signals.pose(theta)[1]), force)
        world[:, 2] -= self.robot.gravity
        body = np.concatenate([force, turning], axis=1)
        seen = within(self._poses, np.concatenate([world, rate], axis=1), 0)
        return np.concatenate([body[self.rows], seen[self.rows], self._of_joints(
            self.signals.joints(theta)[3][self._simulated])], axis=1)

    def encoder_noise(self) -> np.ndarray:
        """(M, 16) drawn noise of the encoders, as large as that of their readings; others: 0."""
        noise = np.zeros((len(self.rows), len(self.channels)))
        noise[:, PLACE['J']] = self._of_joints(
            self.signals.drawn_reading_noise()[self._simulated])
        return noise

    def _groups_of(self, start):
        """Groups that a start acts on; with tilts of a servo model, servos act on the body."""
        groups = self.keys[next(iter(self.starts[start]))].groups
        return groups if self.signals.model_tilts is None else groups.replace('J', 'BJ')

    def _slopes(self, theta, now, names):
        """(M, 16, K) derivatives by keys at ``theta``, where the residual is ``now``."""
        slopes = np.zeros((len(names), len(self.channels), len(self.rows))).T
        body = [k for k, name in enumerate(names) if self.keys[name].body
                and self.keys[name].effect not in self._body.slow]
        if body:
            slopes[:, PLACE['B'], body] = -self._body.derivatives(
                self._inputs(theta), theta, tuple(names[k] for k in body))
        for k, name in enumerate(names):
            key = self.keys[name]
            groups = '' if k in body else key.groups.replace('J', '')
            if name in POSE_SHIFTS:
                groups = groups.replace('A', '').replace('W', '')
                slopes[:, 6:12, k] = POSE_SHIFTS[name] * self._of_pose_shift(theta)
            if groups:
                h, here = key.step, theta.get(name, 0.0)
                ahead = self.residual({**theta, name: here + h}, groups)
                both = key.parameter == BOTH_SIDES
                behind = self.residual({**theta, name: here - h}, groups) if both else now
                for group in groups:
                    slopes[:, PLACE[group], k] = (ahead[group] - behind[group]) / (
                        2 * h if both else h)
        turning = [name for name in names if 'J' in self.keys[name].groups]
        for name, slope in zip(turning, self._joint_slopes(theta, turning), strict=True):
            slopes[:, PLACE['J'], names.index(name)] = slope
        late = sorted(LATE_TILTS & set(names))
        if self.signals.model_tilts is not None and late:
            h = self.keys[TILT_BUS].step
            run, = self._servos([{**theta, TILT_BUS: theta.get(TILT_BUS, 0.0) + h}], theta)
            moved = self._with_tilts(self.signals.model_tilts, run, theta, 'B')['B'] - now['B']
            slopes[:, PLACE['B'], [names.index(name) for name in late]] += moved[:, :, None] / h
        return slopes

    def _of_pose_shift(self, theta):
        """
        Derivatives (M, 6) of accelerations and rates by a time shift of the poses.

        They are those of the IMU. The derivative of the poses would explain their own noise,
        shifted in time.
        """
        force, _, turning = self.signals.imu(theta)
        jerk = np.einsum('nij,nj->ni', matrices(self.signals.pose(theta)[1]),
                         np.gradient(force, self.p.grid, axis=0))
        return -within(self._poses, np.concatenate([jerk, turning], axis=1), 0)[self.rows]

    def _real(self, theta):
        """Deviations of real keys, and factor of each start that acts."""
        own = {name: value for name, value in theta.items() if name in self.starts and value}
        theta = {name: value for name, value in theta.items()
                 if name not in self.starts and name not in self.tangents and value}
        return self._started(theta, own), own

    def _started(self, theta, own):
        return {**theta, **{key: theta.get(key, 0.0) + factor * part
                            for name, factor in own.items()
                            for key, part in self.starts[name].items()}}

    def restart(self, theta: dict[str, float], part: float) -> dict[str, float]:
        """
        Move the starts that act in ``theta`` by a ``part`` of the way to their fitted values.

        All flights share the starts. Where a start acts, its factor becomes one, and its tangents
        become zero.
        """
        new = {name: 1.0 for name in self.starts if theta.get(name)}
        for tangent, (name, key) in self.tangents.items():
            if name in new:
                self.starts[name][key] *= max(
                    1 + part * (theta[name] + theta.get(tangent, 0.0) - 1), LEAST)
                new[tangent] = 0.0
        return new

    def _of_all(self, name, own):
        """Start of all joints with the slopes of one of a joint, as servos are independent."""
        effect, joint = of_start(name)
        acts = any(of_start(each)[0] == effect for each in own)
        return f'{effect}@{name.partition("@")[2]}' \
            if joint and not acts and self._groups_of(name) == 'J' else None

    def _ends(self, name, theta, own):
        """Deviations without the effect of a start, and with it as far as it acts, else whole."""
        (effect, joint), without = of_start(name), dict(theta)
        for other, factor in own.items():       # of one effect, only one start can act on a joint
            also, member = of_start(other)
            if also == effect and (member == joint or None in (member, joint)):
                for key, part in self.starts[other].items():
                    without[key] -= factor * part
        without = {key: value for key, value in without.items() if abs(value) > 1e-12}
        return without, theta if name in own else self._started(without, {name: 1.0})

    def settle(self, theta: dict[str, float]) -> None:
        """
        With noisy encoders, take the fast part of the tilts from the servo model at ``theta``.

        Noise in the tilts would enter the residual and the slopes of the body equations. A fit
        explains its second derivative by a larger mass of the tilting modules, for example.
        """
        self._runs = {}
        if self.noisy:
            theta = self._real(theta)[0]
            self._use_tilts(self.signals.joints(theta)[0], self._servos([theta], theta)[0])
            self._kept = None, None

    def _use_tilts(self, tilts, run):
        """Take the fast tilts from simulated servos, beside their windows from ``tilts``."""
        tilts = tilts.copy()
        tilts[self._simulated] = run.reshape(-1, 4)
        self.signals.use_model_tilts(tilts)

    @property
    def noisy(self) -> bool:
        """Whether the fast tilts of the body equations are those of the servo model."""
        return self.signals.reading_noise >= self.p.guide_above

    @property
    def motion(self) -> dict[str, np.ndarray]:
        """Velocity (world), quaternion, position and tilts of the samples."""
        return self._inputs({})

    def _servos(self, sets, at):
        """Simulated servos (P, W, M, 4) of each set, with initial states and loads at ``at``."""
        windows, edges = self._windows(at)
        delays, which = np.unique([self.signals.delays(theta)[0] for theta in sets],
                                  return_inverse=True)
        targets = np.array([self._targets(edges, delay) for delay in delays])
        runs = simulate(self.robot, windows, targets, which, sets, self.modules)
        return runs.transpose(0, 2, 1, 3)

    def _targets(self, edges, delay):
        """(K, W, 4) mean delayed commands [rad] between the steps ``edges`` (W, K + 1) [s]."""
        means = self.signals.tilt_targets(edges.ravel(), delay)
        # The mean from the end of a window to the next one is dropped.
        means = np.concatenate([means, means[-1:]]).reshape(*edges.shape, 4)
        return means[:, :-1].transpose(1, 0, 2)

    def _joint_slopes(self, theta, names):
        """
        Derivatives (M, 4) of the joints' residual by each key.

        Late encoders are as late commands: the derivative by both is the same, that of the
        simulated servo. The rate of the encoders would explain their own noise, shifted in time,
        and a linear fit would exploit any difference between equivalent delays.
        """
        # Servos are independent, so one run with all gains changed gives the slope of each.
        sources = [f'{OF_ONE[key.parameter]}.{key.parameter}' if key.effect == 'servo'
                   else key.name for key in (self.keys[name] for name in names)]
        moved = list(dict.fromkeys([TILT_BUS, *sources]))
        sizes = [self.keys[name].step for name in moved]
        # Central differences: gains, loads and inertia scaled by one factor leave the motion
        # unchanged, and with one-sided differences their slopes would not add up to zero.
        runs = self._servos([{**theta, name: theta.get(name, 0.0) + side * h} for side in (1, -1)
                             for name, h in zip(moved, sizes, strict=True)], theta)
        ahead, behind = runs.reshape(2, len(moved), *runs[0].shape)
        slopes, changes = {}, dict(zip(moved, (behind - ahead) / (
            2 * np.reshape(sizes, (-1, 1, 1, 1))), strict=True))
        for name, change in changes.items():
            slope = changes[TILT_BUS] * SHIFTS.get(name, 0.0) + change
            slopes[name] = self._of_joints(slope.reshape(-1, 4))
        return [slopes[source] * (np.arange(4) == self.keys[name].index)
                if source != name else slopes[name]
                for name, source in zip(names, sources, strict=True)]

    def _windows(self, theta):
        """Windows of the servos and the edges of their steps; the last ones are kept."""
        timing = {name: theta.get(name, 0.0) for name in SHIFTS}
        if self._kept[0] != timing:
            self._kept = timing, windows_of(self.signals, self._starts, timing)
        return self._kept[1]
