"""
Smoothed readings on one grid, and the checks as data: signals that must agree, and mistakes.

A mistake makes signals disagree. It is a linear map of the columns of one topic, as a unit, an
order, a sign or a rotation is. Its inverse undoes it, in the comparison and in a repair.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from itertools import permutations, product

import numpy as np
from scipy.linalg import block_diag
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from beetle_omni_ros.identify.inference.noise import SIGMA_OF_MEDIAN
from beetle_omni_ros.identify.recording.bag import COMMAND, IMU, JOINTS, POSE, Recording
from beetle_omni_ros.identify.recording.parameters import shipped
from beetle_omni_ros.identify.recording.series import aligned, low_pass, matrices
from beetle_omni_ros.model.parameters import RobotParameters

GRAVITY = 'gravity'     # [m/s^2] that the accelerometer measures
I3, I4 = np.eye(3), np.eye(4)
SHOWN = 0.02            # share of the largest slope below which a flight does not show an angle
THINNED = 4             # points of the fine grid for each point of the coarse one


@dataclass(frozen=True)
class Smoothed:
    """
    All topics of one flight on one grid, below three times the edge of the comparisons.

    Attributes:
        t: (N,) stamps [s].
        data: topic -> (3, N, width) values and their first and second derivatives; ``GRAVITY``
            -> (3, N, 1) gravity [m/s^2] that the accelerometer measures.
        silent: (N,) whether a topic has a gap there.
        noise: topic -> (width,) density of the white noise of its readings: variance times
            period.
        robot: its geometry.

    """

    t: np.ndarray
    data: dict[str, np.ndarray]
    silent: np.ndarray
    noise: dict[str, np.ndarray]
    robot: RobotParameters

    def corrected(self, topic: str, undo: np.ndarray) -> 'Smoothed':
        """The same with ``undo`` (width, width) applied to the values of one topic."""
        return replace(self, data=self.data | {topic: self.data[topic] @ undo.T},
                       noise=self.noise | {topic: undo**2 @ self.noise[topic]})

    def turning(self) -> tuple[np.ndarray, np.ndarray]:
        """Rates (N, 3) [rad/s] by MoCap and gyroscope, body axes."""
        q, change = self.data[POSE][:2, :, 3:]
        v, w, dv, dw = q[:, :3], q[:, 3:], change[:, :3], change[:, 3:]
        rate = 2 * (w * dv - dw * v - np.cross(v, dv)) / (q**2).sum(axis=1, keepdims=True)
        return rate, self.data[IMU][0, :, 3:]

    def pushing(self) -> tuple[np.ndarray, np.ndarray]:
        """
        Accelerations (N, 3) [m/s^2] by MoCap and accelerometer, body axes.

        The second one is without what a small angle between both and a bias explain: in a slow
        flight, gravity along a wrong axis is more than the motion.
        """
        rotation, limits = matrices(self.data[POSE][0, :, 3:]), shipped()
        seen = np.einsum('nij,ni->nj', rotation, self.data[POSE][2, :, :3])
        weight = self.data[GRAVITY][0] * rotation[:, 2]
        felt = self.data[IMU][0, :, :3] - weight
        most = np.repeat([limits.mounting, limits.bias], 3)
        slopes = most * np.concatenate([np.cross(I3, weight[:, None]).transpose(0, 2, 1),
                                        np.broadcast_to(I3, (len(felt), 3, 3))], axis=2)
        small, *_ = np.linalg.lstsq(slopes.reshape(-1, 6), (felt - seen).ravel(), SHOWN)
        if max(np.linalg.norm(small[:3]), np.linalg.norm(small[3:])) < 1:
            felt = felt - slopes @ small
        return seen, felt

    def tilting(self) -> tuple[np.ndarray, np.ndarray]:
        """Tilts (N, 4) [rad] by encoders and commands, without their means."""
        read, told = self.data[JOINTS][0], self.data[COMMAND][0, :, :4]
        return read - read.mean(axis=0), told - told.mean(axis=0)

    def lifting(self) -> tuple[np.ndarray, np.ndarray]:
        """Specific forces (N, 3) [m/s^2] by accelerometer and thrusts at the measured tilts."""
        normals = self.robot.thrust_directions(self.data[JOINTS][0])
        force = np.einsum('ni,nij->nj', self.data[COMMAND][0, :, 4:], normals)
        return self.data[IMU][0, :, :3], force / self.robot.mass


def signals_of(recording: Recording, robot: RobotParameters) -> Smoothed | None:
    """Smooth all topics with the same filter; None if they have too little time in common."""
    limits = shipped()
    series = {topic: series_of(recording, topic) for topic in (IMU, POSE, JOINTS, COMMAND)}
    if min(len(t) for t, _ in series.values()) < 2:
        return None
    begin = max(t[0] for t, _ in series.values())
    end = min(t[-1] for t, _ in series.values())
    if not limits.window < end - begin < 1e5:
        return None
    kernel = low_pass(3 * limits.edge, THINNED, limits.period[1] / 10)
    grid = begin + kernel.period * np.arange(int((end - begin) / kernel.period))
    at = grid[kernel.centres(len(grid))]
    data = {GRAVITY: np.full((3, len(at), 1), robot.gravity)}
    noise, silent = {GRAVITY: np.zeros(1)}, np.zeros(len(at), dtype=bool)
    for topic, (t, values) in series.items():
        if topic == POSE:
            norm = np.linalg.norm(values[:, 3:], axis=1, keepdims=True)
            values = np.concatenate([values[:, :3], aligned(values[:, 3:] / norm)], axis=1)
        even = np.stack([np.interp(grid, t, column) for column in values.T], axis=1)
        if topic == COMMAND:
            keep = np.exp(-kernel.period / robot.rotors.time_constant)
            even[:, 4:] = lfilter([1 - keep], [1, -keep], even[:, 4:], axis=0,
                                  zi=keep * even[:1, 4:])[0]
        data[topic] = np.stack([kernel(even, order)[:len(at)] for order in range(3)])
        for k in np.flatnonzero(np.diff(t) > limits.period[1]):
            silent |= (at > t[k]) & (at < t[k + 1])
        noise[topic] = white_noise(values)**2 * np.median(np.diff(t))
    return Smoothed(at, data, silent, noise, robot)


def series_of(recording: Recording, topic: str) -> tuple[np.ndarray, np.ndarray]:
    """Ascending unique stamps (N,) and finite values (N, width)."""
    t, values = recording.times[topic], recording.values[topic]
    fine = np.isfinite(t) & np.isfinite(values).all(axis=1)
    t, first = np.unique(t[fine], return_index=True)
    return t, values[fine][first]


def white_noise(values: np.ndarray) -> np.ndarray:
    """
    Standard deviation (width,) of the white noise of equidistant readings (N, width).

    The third difference removes smooth motion. Its variance is 1 + 9 + 9 + 1 times that of white
    noise, and its median absolute deviation is robust against single steps.
    """
    return SIGMA_OF_MEDIAN / 20**0.5 * np.median(np.abs(np.diff(values, 3, axis=0)), axis=0)


@dataclass(frozen=True)
class Relation:
    """
    Two measurements of the same motion.

    Attributes:
        late, early: topics of the later and of the earlier signal.
        words: what both signals show.
        pair: both signals, (N, n) each.
        noise: (topic, a column, order of derivative) of the noise of both.
        gain: name of the limit of their ratio.
        lag: name of the limits of the lag of the later one [s]; none without a check.
        certain: whether a contradiction is a damage even if no mistake explains it. With thrusts
            it is not, because the robot file may be wrong.

    """

    late: str
    early: str
    words: str
    pair: Callable[[Smoothed], tuple[np.ndarray, np.ndarray]]
    noise: tuple[tuple[str, int, int], ...]
    gain: str
    lag: str = ''
    certain: bool = True


RELATIONS = {
    'turning': Relation(POSE, IMU, 'rotation of the pose and gyroscope', Smoothed.turning,
                        ((IMU, 3, 0), (POSE, 3, 1)), 'gain', 'sensor_lag'),
    'pushing': Relation(POSE, IMU, 'motion of the pose and accelerometer', Smoothed.pushing,
                        ((IMU, 0, 0), (POSE, 0, 2)), 'gain'),
    'tilting': Relation(JOINTS, COMMAND, 'encoders and tilt commands', Smoothed.tilting,
                        ((JOINTS, 0, 0),), 'gain', 'servo_lag'),
    'lifting': Relation(IMU, COMMAND, 'accelerometer and thrust commands', Smoothed.lifting,
                        ((IMU, 0, 0),), 'thrust_gain', certain=False)}


@dataclass(frozen=True, eq=False)
class Mistake:
    """
    One way to record a topic wrongly.

    Attributes:
        topic: damaged topic.
        touches: names of the relations that it changes.
        text: cause in words.
        undo: (width, width) map from recorded to right columns.
        fix: description of the repair; empty without one.
        part: key of the changed :class:`Smoothed`, if not ``topic``.

    """

    topic: str
    touches: tuple[str, ...]
    text: str
    undo: np.ndarray
    fix: str = ''
    part: str = ''


TURN, PUSH, TILT, LIFT = ('turning',), ('pushing', 'lifting'), ('tilting',), ('lifting',)
MOVE, SPIN = ('pushing',), ('turning', 'pushing')
ANGLES = {180 / np.pi: 'in degrees, not radians', 2048 / np.pi: 'in encoder counts, not radians',
          np.pi / 180: 'turned into radians twice', 1 / (2 * np.pi): 'in turns, not radians'}
THRUSTS = {1e3: 'in millinewtons, not N', 1e3 / 9.80665: 'in grams, not N',
           1 / 9.80665: 'in kilograms, not N', 5.0: 'in percent of the largest thrust, not N',
           0.05: 'in parts of the largest thrust, not N'}
# Topic, relations, columns before, of and after it, what, factor -> unit.
UNITS = (
    (IMU, TURN, 3, 3, 0, 'angular velocity', {
        180 / np.pi: 'in degrees per second, not rad/s',
        np.pi / 180: 'turned into radians twice'}),
    (IMU, PUSH, 0, 3, 3, 'linear acceleration', {
        1 / 9.80665: 'in units of g, not m/s^2', 1e3 / 9.80665: 'in milli-g, not m/s^2',
        100.0: 'in cm/s^2, not m/s^2', 1e3: 'in mm/s^2, not m/s^2'}),
    (POSE, MOVE, 0, 3, 4, 'position', {
        1e3: 'in millimetres, not metres', 100.0: 'in centimetres, not metres',
        1e-3: 'in kilometres, not metres', 1 / 0.3048: 'in feet, not metres',
        1 / 0.0254: 'in inches, not metres'}),
    (JOINTS, TILT + LIFT, 0, 4, 0, 'joint angle', ANGLES),
    (COMMAND, TILT, 0, 4, 4, 'tilt', ANGLES), (COMMAND, LIFT, 4, 4, 0, 'thrust', THRUSTS))
SIGNED = [np.array(signs)[:, None] * np.eye(3)[list(order)]
          for order in permutations(range(3)) for signs in product((1.0, -1.0), repeat=3)][1:]
TURNS = [axes for axes in SIGNED if np.linalg.det(axes) > 0]
UPS = {tuple(axes[:, 2]): axes for axes in TURNS if axes[2, 2] < 1}     # any heading
SIGNS = [np.diag(signs) for signs in product((1.0, -1.0), repeat=4)][1:]
ORDERS = [np.eye(4)[list(order)] for order in permutations(range(4))][1:]
MIRRORS = [np.diag(np.where(np.arange(3) == k, -1.0, 1.0)) for k in range(3)]


def _body(axes):
    """(4, 4) map of a quaternion xyzw to its product with a rotation of the body."""
    return np.stack([(q * Rotation.from_matrix(axes)).as_quat() for q in BASIS], axis=1)


def _world(axes):
    """The same with a rotation of the world."""
    return np.stack([(Rotation.from_matrix(axes) * q).as_quat() for q in BASIS], axis=1)


BASIS = Rotation.from_quat(I4)
# Topic, relations, matrices, blocks of the map from right to recorded columns, text, repair.
AXES = (
    (IMU, TURN + PUSH, SIGNED, lambda a: (a, a), "the IMU's {}", 'turn the axes back'),
    (IMU, TURN, SIGNED, lambda a: (I3, a), 'angular velocity: {}', 'exchange the axes'),
    (IMU, PUSH, SIGNED, lambda a: (a, I3),
     'linear acceleration (+9.81 m/s^2 upwards at rest, REP-145): {}', 'exchange the axes'),
    (POSE, MOVE, SIGNED, lambda a: (a, I4), 'the axes of positions against the orientation: {}',
     'exchange the axes of positions'),
    (POSE, SPIN, TURNS, lambda a: (I3, _body(a)), "the body's {}", ''),
    (POSE, SPIN, UPS.values(), lambda a: (a, _world(a)), '{up} points up, expected z up', ''),
    (POSE, SPIN, [a for a in TURNS if a[2, 2] < 1], lambda a: (a, block_diag(a, 1.0)),
     "{up} points up, expected z up, and the body's {}", ''),
    (POSE, SPIN, MIRRORS, lambda a: (a, block_diag(-a, 1.0)), "the world's {}", ''),
    (POSE, SPIN, [I4[[3, 0, 1, 2]]], lambda a: (I3, a), 'the quaternion is stored as (w, x, y, z),'
     ' expected (x, y, z, w)', 'reorder the quaternion'),
    (POSE, SPIN, [np.diag([-1.0, -1, -1, 1])], lambda a: (I3, a), 'the quaternion is stored as the'
     ' inverse, world seen from the body, expected the body seen from the world', 'invert it'),
    (POSE, SPIN, [I4[[3, 0, 1, 2]] * [-1, -1, -1, 1]], lambda a: (I3, a), 'the quaternion is '
     'stored as the inverse in the order (w, x, y, z), expected (x, y, z, w)', 'reorder it'),
    (JOINTS, TILT + LIFT, SIGNS, lambda a: (a,), 'joints turn against their commands: the sign of '
     'the encoder is reversed: {}', 'reverse the sign'),
    (COMMAND, TILT, SIGNS, lambda a: (a, I4), 'joints turn against their commands: the sign of '
     'the command is reversed: {}', 'reverse the sign'),
    (JOINTS, TILT + LIFT, ORDERS, lambda a: (a,), 'joints are swapped: {}', 'exchange the joints'),
    (COMMAND, TILT, ORDERS, lambda a: (a, I4), 'tilt commands are swapped: {}',
     'exchange the commands'),
    (COMMAND, LIFT, ORDERS, lambda a: (I4, a), 'the order of the thrusts is another one: {}', ''))


@cache
def mistakes() -> tuple[Mistake, ...]:
    """All known mistakes."""
    units = [Mistake(topic, touches, f'{what} is {factor:.4g} times what others show: {words}?',
                     block_diag(np.eye(before), np.eye(width) / factor, np.eye(after)),
                     '' if 'counts' in words else f'scale the {what}')
             for topic, touches, before, width, after, what, units in UNITS
             for factor, words in units.items()]
    axes = [Mistake(topic, touches, text.format(_how(a), up=_up(a)), block_diag(*blocks(a)).T, fix)
            for topic, touches, matrices, blocks, text, fix in AXES for a in matrices]
    return (*units, *axes, Mistake(
        IMU, MOVE, 'linear acceleration is without gravity, which a sensor at rest measures: the '
        'driver takes gravity off', np.zeros((1, 1)), part=GRAVITY))


def _how(a):
    """Text such as 'axes are turned: x is y, y is -x', or '1 is 2, 2 is 1' of joints."""
    names = 'xyz' if len(a) == 3 else '1234'
    parts = ', '.join(f'{names[k]} is {"-" * int(row.min() < 0)}{names[np.argmax(np.abs(row))]}'
                      for k, row in enumerate(a) if row[k] < 1)
    if len(a) == 4:
        return parts
    kind = 'turned' if np.linalg.det(a) > 0 else 'left-handed, swapped or of the wrong sign'
    return 'the opposite sign' if (a == -I3).all() else f'axes are {kind}: {parts}'


def _up(a):
    """The upward axis."""
    k = int(np.argmax(np.abs(a[:, 2])))
    return f'the {"-" * int(a[k, 2] < 0)}{"xyzw"[k]} axis'
