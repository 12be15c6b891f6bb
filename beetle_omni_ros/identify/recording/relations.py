"""
The checks as data: signals that must agree, and the mistakes that make them disagree.

A mistake is a linear map of the columns of one topic, as a unit, an order, a sign or a rotation
is. Its inverse undoes it, in the comparison and in a repair.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
from itertools import permutations, product

import numpy as np
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation

from beetle_omni_ros.identify.recording.signals import (
    COMMAND,
    GRAVITY,
    IMU,
    JOINTS,
    POSE,
    Signals,
)


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
    pair: Callable[[Signals], tuple[np.ndarray, np.ndarray]]
    noise: tuple[tuple[str, int, int], ...]
    gain: str
    lag: str = ''
    certain: bool = True


RELATIONS = {
    'turning': Relation(POSE, IMU, 'rotation of the pose and gyroscope', Signals.turning,
                        ((IMU, 3, 0), (POSE, 3, 1)), 'gain', 'sensor_lag'),
    'pushing': Relation(POSE, IMU, 'motion of the pose and accelerometer', Signals.pushing,
                        ((IMU, 0, 0), (POSE, 0, 2)), 'gain'),
    'tilting': Relation(JOINTS, COMMAND, 'encoders and tilt commands', Signals.tilting,
                        ((JOINTS, 0, 0),), 'gain', 'servo_lag'),
    'lifting': Relation(IMU, COMMAND, 'accelerometer and thrust commands', Signals.lifting,
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
        part: key of the changed :class:`Signals`, if not ``topic``.

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
# Topic, relations, columns before and after, what, factor -> unit.
UNITS = (
    (IMU, TURN, 3, 0, 'angular velocity', {
        180 / np.pi: 'in degrees per second, not rad/s',
        np.pi / 180: 'turned into radians twice'}),
    (IMU, PUSH, 0, 3, 'linear acceleration', {
        1 / 9.80665: 'in units of g, not m/s^2', 1e3 / 9.80665: 'in milli-g, not m/s^2',
        100.0: 'in cm/s^2, not m/s^2', 1e3: 'in mm/s^2, not m/s^2'}),
    (POSE, MOVE, 0, 4, 'position', {
        1e3: 'in millimetres, not metres', 100.0: 'in centimetres, not metres',
        1e-3: 'in kilometres, not metres', 1 / 0.3048: 'in feet, not metres',
        1 / 0.0254: 'in inches, not metres'}),
    (JOINTS, TILT + LIFT, 0, 0, 'joint angle', ANGLES),
    (COMMAND, TILT, 0, 4, 'tilt', ANGLES), (COMMAND, LIFT, 4, 0, 'thrust', THRUSTS))
SIGNED = [np.array(signs)[:, None] * np.eye(3)[list(order)]
          for order in permutations(range(3)) for signs in product((1.0, -1.0), repeat=3)][1:]
TURNS = [axes for axes in SIGNED if np.linalg.det(axes) > 0]
UPS = {tuple(axes[:, 2]): axes for axes in TURNS if axes[2, 2] < 1}     # any heading
SIGNS = [np.diag(signs) for signs in product((1.0, -1.0), repeat=4)][1:]
ORDERS = [np.eye(4)[list(order)] for order in permutations(range(4))][1:]
ONE = np.eye(4)
QUATERNIONS = {'as (w, x, y, z)': ONE[[3, 0, 1, 2]],
               'as the inverse, world seen from the body': np.diag([-1.0, -1, -1, 1]),
               'as (w, x, y, z) of the inverse': ONE[[3, 0, 1, 2]] @ np.diag([-1.0, -1, -1, 1])}


@cache
def mistakes() -> tuple[Mistake, ...]:
    """All known mistakes."""
    return (*_units(), *_axes(), Mistake(
        IMU, MOVE, 'linear acceleration is without gravity, which a sensor at rest measures: the '
        'driver takes gravity off', np.zeros((1, 1)), part=GRAVITY))


def _units() -> Iterator[Mistake]:
    for topic, touches, before, after, what, units in UNITS:
        width = {IMU: 3, POSE: 3, JOINTS: 4, COMMAND: 4}[topic]
        for factor, words in units.items():
            yield Mistake(topic, touches, f'{what} is {factor:.4g} times what others show: '
                          f'{words}?', block_diag(np.eye(before), np.eye(width) / factor,
                                                  np.eye(after)),
                          '' if 'counts' in words else f'scale the {what}')


def _axes() -> Iterator[Mistake]:
    """Axes, signs, orders: each matrix is the map from right to recorded columns."""
    for a in SIGNED:
        yield from (
            _axis(IMU, TURN + PUSH, "the IMU's", a, (a, a), 'turn the axes back'),
            _axis(IMU, TURN, 'angular velocity:', a, (np.eye(3), a), 'exchange the axes'),
            _axis(IMU, PUSH, 'linear acceleration (+9.81 m/s^2 upwards at rest, REP-145):', a,
                  (a, np.eye(3)), 'exchange the axes'),
            _axis(POSE, MOVE, 'the axes of positions against the orientation:', a, (a, ONE),
                  'exchange the axes of positions'))
    for a in TURNS:
        yield _axis(POSE, SPIN, "the body's", a, (np.eye(3), _turn(a, after=True)))
        if a[2, 2] < 1:
            yield _axis(POSE, SPIN, f"{_up(a)}, and the body's", a, (a, block_diag(a, 1.0)))
    for a in UPS.values():
        yield Mistake(POSE, SPIN, _up(a), block_diag(a, _turn(a, after=False)).T)
    for k in range(3):
        flip = np.diag(np.where(np.arange(3) == k, -1.0, 1.0))
        yield _axis(POSE, SPIN, "the world's", flip, (flip, block_diag(-flip, 1.0)))
    for text, order in QUATERNIONS.items():
        yield Mistake(POSE, SPIN, f'the quaternion is stored {text}; expected (x, y, z, w), the '
                      'body seen from the world', block_diag(np.eye(3), order.T),
                      'reorder the quaternion')
    for a in SIGNS:
        names = ', '.join(f'gimbal{k + 1}' for k in range(4) if a[k, k] < 0)
        for topic, touches, rest, what in ((JOINTS, TILT + LIFT, 0, 'encoder'),
                                           (COMMAND, TILT, 4, 'command')):
            yield Mistake(topic, touches, f'{names} turns against its command: the sign of the '
                          f'{what} is reversed', block_diag(a, np.eye(rest)), 'reverse the sign')
    for a in ORDERS:
        moved = ', '.join(f'{k + 1} is {np.argmax(row) + 1}' for k, row in enumerate(a)
                          if not row[k])
        yield Mistake(JOINTS, TILT + LIFT, f'joints are swapped: gimbal {moved}', a.T,
                      'exchange the joints')
        yield Mistake(COMMAND, TILT, f'tilt commands are swapped: gimbal {moved}',
                      block_diag(a.T, ONE), 'exchange the commands')
        yield Mistake(COMMAND, LIFT, f'the order of the thrusts is another one: rotor {moved}',
                      block_diag(ONE, a.T))


def _axis(topic, touches, whose, axes, blocks, fix=''):
    """A mistake with turned or mirrored axes (3, 3)."""
    parts = ', '.join(f'{"xyz"[k]} is {"-" * int(row.min() < 0)}{"xyz"[np.argmax(np.abs(row))]}'
                      for k, row in enumerate(axes))
    how = 'the opposite sign' if (axes == -np.eye(3)).all() else f'axes are turned: {parts}' \
        if np.linalg.det(axes) > 0 else \
        f'axes are left-handed, swapped or of the wrong sign: {parts}'
    return Mistake(topic, touches, f'{whose} {how}', block_diag(*blocks).T, fix)


def _up(axes):
    k = int(np.argmax(np.abs(axes[:, 2])))
    return f'the {"-" * int(axes[k, 2] < 0)}{"xyz"[k]} axis points up, expected z up'


def _turn(axes, after):
    """(4, 4) map of a quaternion xyzw to its product with a rotation of the body or the world."""
    unit = Rotation.from_quat(ONE)
    turn = Rotation.from_matrix(axes)
    return np.stack([(q * turn if after else turn * q).as_quat() for q in unit], axis=1)
