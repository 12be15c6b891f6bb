"""
Residuals of a flight that was recorded as a bag, with their slopes.

Four groups of channels are compared on one grid:

- force and torque: specific force and angular acceleration minus the body equations at the
  measured tilts,
- acceleration: of MoCap minus that of the IMU; independent of the robot's model,
- rate: of MoCap minus gyroscope; independent of the robot's model,
- joint: encoders minus servos that are simulated from the commands.
"""

from __future__ import annotations

import numpy as np

from beetle_omni_ros.identify.flights.residual import Linear
from beetle_omni_ros.identify.flights.spectrum import blocks_of
from beetle_omni_ros.identify.gap.keys import delays_of
from beetle_omni_ros.identify.gap.residual import BOTH_SIDES, CHANNELS, FlightModel
from beetle_omni_ros.identify.gap.series import low_pass, matrices, THIN, within

LEAST = 0.1             # smallest share of a start to which its keys may fall in one step
WIDEST = 16.0           # [Hz] low-pass edge of joint angles, of which every second one counts
POSES = 8.0             # [Hz] the same of MoCap, whose noise grows with the square of frequency
# [Hz] largest frequency of each group: above 8 Hz the filters of readings and tilts differ, and a
# fit takes the difference for a larger mass of the tilting modules
FASTEST = {'B': 8.0, 'A': POSES, 'W': POSES, 'J': WIDEST}
# Time shift of a pose of MoCap for each second of delay of these sensors.
POSE_SHIFTS = dict.fromkeys(delays_of('imu'), -1.0) | dict.fromkeys(delays_of('mocap'), 1.0)


class BagFlight(FlightModel):
    """
    A flight of a bag for the engine.

    Attributes:
        period: of the samples [s].
        mask: (N, 16) samples that count.
        rows: (N,) rows of the grid of the signals.

    """

    channels = tuple(name for group in 'BAWJ' for name in CHANNELS[group])
    highest = np.repeat([FASTEST[group] for group in 'BAWJ'], [6, 3, 3, 4])
    usable = True

    def __init__(self, flight, robot, body, keys, p):
        super().__init__(flight, robot, body, keys, p)
        self.starts, self.tangents = {}, {}
        self.name, self.period = flight.name, THIN * p.grid
        self.reasons = dict.fromkeys(self.channels, '')
        first, count = self._starts[0], self._length * len(self._starts)
        self.rows = first + THIN * np.arange(count // THIN)
        self._readings = low_pass(p.smooth_imu, 1, p.grid)
        self._fine = low_pass(WIDEST, 1, p.grid)
        self._poses = low_pass(POSES, 1, p.grid)
        self.mask = np.ones((len(self.rows), len(self.channels)), dtype=bool)
        self.mask[:, :6] = self.trusted[self.rows, None]
        far = self._poses.margin
        inside = (self.rows >= far) & (self.rows < len(self.signals.t) - far)
        self.mask[:, 6:12] = inside[:, None]
        self.usable = len(blocks_of(self.mask, self.period)) > 0

    def _thinned(self, theta):
        inputs = self.inputs(theta)
        # as the readings are smoothed that the forces are compared with
        for name in ('thrust', 'thrust_rate'):
            inputs[name] = within(self._readings, inputs[name], 0)
        return {name: values[self.rows] for name, values in inputs.items()}

    def _residual(self, theta, groups):
        result = {}
        force, rate, turning = self.signals.imu(theta)
        if 'B' in groups:
            result['B'] = np.concatenate([force, turning], axis=1)[self.rows] \
                - self._body(self._thinned(theta), theta)
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
            result['J'] = self._joints([theta])[0]
        return result

    def _of_joints(self, series):
        return within(self._fine, series, 0)[::THIN]

    def linear(self, theta, names):
        """Residual and its slopes at deviations ``theta``."""
        given = theta
        theta, own = self._real(given)
        now = self.residual(theta)
        residual = np.concatenate([now[group] for group in 'BAWJ'], axis=1)
        slopes = np.zeros((*residual.shape, len(names)))
        place = {'B': slice(0, 6), 'A': slice(6, 9), 'W': slice(9, 12), 'J': slice(12, 16)}
        self._secants(slopes, theta, own, now, names, place)
        # tangent of a start that acts -> its key
        moved = {name: self.tangents[name][1] for name in names
                 if name in self.tangents and self.tangents[name][0] in own}
        every = list(names)
        names = list(dict.fromkeys([name for name in every if name not in self.starts
                                    and name not in self.tangents] + [*moved.values()]))
        found = np.zeros((*residual.shape, len(names)))
        where = {name: k for k, name in enumerate(names)}
        body = [name for name in names if self.keys[name].body]
        if body:
            exact = self._body.derivatives(self._thinned(theta), theta, tuple(body))
            for k, name in enumerate(body):
                found[:, place['B'], where[name]] = -exact[:, :, k]
        for name in names:
            key = self.keys[name]
            groups = '' if key.body else key.groups.replace('J', '')
            if name in POSE_SHIFTS:
                groups = groups.replace('A', '').replace('W', '')
                found[:, 6:12, where[name]] = POSE_SHIFTS[name] * self._of_pose_shift(theta)
            if groups:
                h, here = key.step, theta.get(name, 0.0)
                ahead = self._residual({**theta, name: here + h}, groups)
                both = key.parameter == BOTH_SIDES
                behind = self._residual({**theta, name: here - h}, groups) if both else now
                for group in groups:
                    found[:, place[group], where[name]] = (ahead[group] - behind[group]) / (
                        2 * h if both else h)
        turning = [name for name in names if 'J' in self.keys[name].groups]
        for name, slope in zip(turning, self._joint_slopes(theta, turning), strict=True):
            found[:, place['J'], where[name]] = slope
        for k, name in enumerate(every):
            if name in moved:
                part = self.starts[self.tangents[name][0]][moved[name]]
                slopes[:, :, k] = part * found[:, :, where[moved[name]]]
            elif name in where:
                slopes[:, :, k] = found[:, :, where[name]]
        return Linear(residual, slopes, residual)

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

    def restart(self, theta: dict[str, float]) -> dict[str, float]:
        """
        Move the starts that act in ``theta`` to their fitted values.

        All flights share the starts. Where a start acts, its factor becomes one, and its tangents
        become zero.
        """
        new = {name: 1.0 for name in self.starts if theta.get(name)}
        for tangent, (name, key) in self.tangents.items():
            if name in new:
                self.starts[name][key] *= max(theta[name] + theta.get(tangent, 0.0), LEAST)
                new[tangent] = 0.0
        return new

    def _secants(self, slopes, theta, own, now, names, place):
        """Slopes from no effect to the start, or to the deviation where it acts."""
        for k, name in enumerate(names):
            if name not in self.starts:
                continue
            start, factor = self.starts[name], own.get(name, 1.0)
            groups = ''.join(dict.fromkeys(''.join(self.keys[key].groups for key in start)))
            less = {key: theta.get(key, 0.0) - (factor * part if name in own else 0.0)
                    for key, part in start.items()}
            # of another start of the same effect, only one can act
            less = {key: value if abs(value) > 1e-12 else 0.0 for key, value in less.items()}
            with_it = now if name in own else self._residual(
                self._started({**theta, **dict.fromkeys(start, 0.0)}, {name: factor}), groups)
            without = self._residual({**theta, **less}, groups) if name in own else \
                now if not any(theta.get(key) for key in start) else \
                self._residual({**theta, **dict.fromkeys(start, 0.0)}, groups)
            for group in groups:
                slopes[:, place[group], k] = (with_it[group] - without[group]) / factor

    def settle(self, theta):
        """Take the fast part of noisy tilts from the servo model at ``theta``."""
        self.smooth_tilts(self._real(theta)[0])

    @property
    def motion(self) -> dict[str, np.ndarray]:
        """Velocity (world), quaternion, position and tilts of the samples."""
        return self._thinned({})

    @property
    def time(self) -> np.ndarray:
        """(N,) times of the samples [s]."""
        return self.signals.t[self.rows]
