"""Driving by hand: target poses from keys, joystick axes and typed commands; no ROS."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from math import isfinite, radians

import numpy as np

from beetle_omni_ros.model import rotations
from beetle_omni_ros.model.schema import parameter, ParameterError, ParameterFile, quoted

BUTTONS = ('arm', 'land', 'hold', 'home')
NEAR = 1e-9     # [m, rad] distance from the goal that counts as arrived
# Key -> (axis of x, y, z, roll, pitch, yaw, direction).
MOVES = {'w': (0, 1), 's': (0, -1), 'a': (1, 1), 'd': (1, -1), 'r': (2, 1), 'f': (2, -1),
         'o': (3, 1), 'u': (3, -1), 'i': (4, 1), 'k': (4, -1), 'j': (5, 1), 'l': (5, -1)}
KEY_WORDS = {'t': 'arm', 'x': 'land', ' ': 'hold', 'h': 'home', '0': 'level',
             '!': 'emergency_stop', 'c': 'controller', 'q': 'quit'}
KEY_HELP = ('w s a d r f: forth, back, left, right, up, down    o u i k j l: roll, pitch, yaw\n'
        't arm and take off, x land, space hold, h home, 0 level, c other controller, '
        '! emergency stop, q quit')
ORDER = (0, 1, 2, 5, 4, 3)      # DriveParameters.axes -> index in x, y, z, roll, pitch, yaw
WAYS = {'forth': (0, 1), 'back': (0, -1), 'left': (1, 1), 'right': (1, -1), 'up': (2, 1),
        'down': (2, -1)}
TURNS = {'roll': 0, 'pitch': 1, 'yaw': 2}
ORDERS = ('arm', 'land', 'emergency_stop', 'hold', 'level', 'where', 'help', 'quit')
HELP = ('forth|back|left|right|up|down METRES, roll|pitch|yaw DEGREES, '
        'goto X Y Z [ROLL PITCH YAW], controller NAME, wait [SECONDS], arm, land, hold, level, '
        'where, emergency_stop, quit')
MAX_TURN = 180.0    # [deg]; the shortest path to a larger rotation has the other direction


@dataclass(frozen=True, kw_only=True)
class DriveParameters(ParameterFile, file='drive.yaml'):
    """Content of params/drive.yaml."""

    speed: float = parameter(0.5, doc='largest speed of the target', unit='m/s', low=0.01, high=5)
    rate: float = parameter(
        0.8, doc='largest rate of the target attitude', unit='rad/s', low=0.01, high=10)
    leash: float = parameter(
        0.5, doc='distance from the robot at which the target waits', unit='m', low=0.05, high=5)
    step: float = parameter(0.1, doc='shift by one key', unit='m', low=0.001, high=1)
    turn: float = parameter(0.17453, doc='rotation by one key', unit='rad', low=0.001, high=1.6)
    dead_zone: float = parameter(
        0.12, doc='deflection of a joystick axis that counts as none', low=0, high=0.9)
    joystick_timeout: float = parameter(
        0.5, doc='time without a message after which the joystick ' 'counts as released', unit='s',
        low=0.05, high=10)
    axes: np.ndarray = parameter(doc='axes of sensor_msgs/Joy for x, y, z, yaw, pitch, roll; '
                                 '-1: none', low=-1, high=63, shape=(6,))
    signs: np.ndarray = parameter(doc='signs of these axes', low=-1, high=1, shape=(6,))
    buttons: dict = parameter(doc='arm, land, hold, home -> number of the button')
    poses: dict = parameter(doc='name -> x, y, z [m], roll, pitch, yaw [deg]')

    def __post_init__(self):
        for name, number in self.buttons.items():
            if name not in BUTTONS or not isinstance(number, int) or not 0 <= number < 64:
                raise ParameterError(f"key 'buttons.{name}': expected {', '.join(BUTTONS)} with "
                                     f'a number from 0 to 63, found {quoted(number)}')
        for name, pose in self.poses.items():
            if not isinstance(pose, list) or len(pose) != 6 or not all(
                    isinstance(one, (int, float)) and isfinite(one) for one in pose):
                raise ParameterError(f"key 'poses.{name}': expected six numbers x, y, z [m], "
                                     f'roll, pitch, yaw [deg], found {quoted(pose)}')


class Steering:
    """
    Moves a target to a goal within the limits.

    ``position`` (3,) in world [m] and ``quaternion`` (4,) body to world, xyzw, are the present
    target, ``goal`` has those of the goal. ``why_not`` returns '' or the reason why a pose must
    not be flown.
    """

    def __init__(self, parameters: DriveParameters,
                 why_not: Callable[[np.ndarray, np.ndarray], str], position: np.ndarray,
                 quaternion: np.ndarray):
        self._p, self._why_not = parameters, why_not
        self.position, self.quaternion = np.array(position, dtype=float), np.array(quaternion)
        self.goal = self.position, self.quaternion

    @property
    def arrived(self) -> bool:
        """Whether the target is at its goal."""
        return float(np.linalg.norm(self.goal[0] - self.position)) < NEAR \
            and rotations.geodesic_angle(self.goal[1], self.quaternion) < 1e-6

    def go(self, position: np.ndarray, quaternion: np.ndarray) -> str:
        """Set the goal; return '', or the reason of a refusal, which leaves the goal as it is."""
        reason = self._why_not(position, quaternion)
        if not reason:
            self.goal = np.array(position, dtype=float), rotations.normalized(quaternion)
        return reason

    def shift(self, way: np.ndarray, turn: np.ndarray) -> str:
        """
        Shift the goal by a way (3,) in world [m]; returns as :meth:`go`.

        ``turn`` (3,) [rad]: roll and pitch about the body's axes, yaw about world's z.
        """
        position, quaternion = self.goal
        tilted = rotations.multiply(quaternion, rotations.exp([turn[0], turn[1], 0.0]))
        return self.go(position + way, rotations.multiply(
            rotations.exp([0.0, 0.0, turn[2]]), tilted))

    def hold(self) -> None:
        """Set the goal to the present target."""
        self.goal = self.position, self.quaternion

    def update(self, seconds: float, robot: np.ndarray | None = None) -> str:
        """
        Move the target by its motion in ``seconds``; it waits at a distance from the robot (3,).

        Returned is '' or the reason why the next pose must not be flown; then the target stops.
        """
        if self.arrived:
            return ''
        way = self.goal[0] - self.position
        distance = float(np.linalg.norm(way))
        position = self.position + way * min(1.0, self._p.speed * seconds / max(distance, NEAR))
        turn = rotations.log(rotations.multiply(rotations.conjugate(self.quaternion),
                                                self.goal[1]))
        angle = float(np.linalg.norm(turn))
        quaternion = rotations.normalized(rotations.multiply(self.quaternion, rotations.exp(
            turn * min(1.0, self._p.rate * seconds / max(angle, NEAR)))))
        if robot is not None and np.linalg.norm(position - robot) > self._p.leash \
                and np.linalg.norm(position - robot) > np.linalg.norm(self.position - robot):
            position = self.position
        reason = self._why_not(position, quaternion)
        if reason:
            self.hold()
            return reason
        self.position, self.quaternion = position, quaternion
        return ''


def shift_of_key(key: str, p: DriveParameters) -> tuple[np.ndarray, np.ndarray] | None:
    """Shift by a key: (3,) [m] and (3,) roll, pitch, yaw [rad]; None for another key."""
    if key not in MOVES:
        return None
    axis, direction = MOVES[key]
    shift = np.zeros(6)
    shift[axis] = direction * (p.step if axis < 3 else p.turn)
    return shift[:3], shift[3:]


def shift_of_sticks(axes: Sequence[float], seconds: float, p: DriveParameters
                    ) -> tuple[np.ndarray, np.ndarray]:
    """
    Shift by a joystick in ``seconds``, (3,) [m] and (3,) roll, pitch, yaw [rad].

    A fully deflected axis, -1 or 1, moves at full speed or rate, at the edge of the dead zone at
    none. A missing or not finite axis counts as released.
    """
    shift = np.zeros(6)
    for index, number, sign in zip(ORDER, p.axes.astype(int), p.signs):
        value = float(axes[number]) if 0 <= number < len(axes) else 0.0
        if not abs(value) > p.dead_zone:        # also for NaN
            continue
        deflection = (min(abs(value), 1.0) - p.dead_zone) / (1 - p.dead_zone)
        largest = seconds * (p.speed if index < 3 else p.rate)
        shift[index] = sign * np.sign(value) * deflection * largest
    return shift[:3], shift[3:]


def pressed(before: Sequence[int], now: Sequence[int], p: DriveParameters) -> list[str]:
    """Names of the buttons pressed since ``before``."""
    return [name for name, number in p.buttons.items() if number < len(now) and now[number]
            and not (number < len(before) and before[number])]


# A command of the operator, and its values: of 'shift' (3,) in world [m] and (3,) roll, pitch, yaw
# [rad]; of 'goto' (3,) in world [m] and (4,) body to world, xyzw, or None to keep the attitude; of
# 'controller' a name, or none for the next one; of 'wait' perhaps seconds.
Action = tuple[str, tuple]


def parse(line: str, poses: Mapping[str, Sequence[float]]) -> Action | None:
    """
    Parse one line; None for an empty line or a comment after #.

    ``poses``: name -> x, y, z [m], roll, pitch, yaw [deg]. A ParameterError refuses other lines.
    """
    word, *rest = line.partition('#')[0].split() or ['']
    word = word.lower()
    if not word:
        return None
    way, turn = np.zeros(3), np.zeros(3)
    if word in WAYS:
        axis, direction = WAYS[word]
        way[axis] = direction * _numbers(word, rest, 'METRES', (1,))[0]
        return 'shift', (way, turn)
    if word in TURNS:
        degrees, = _numbers(word, rest, 'DEGREES', (1,))
        if abs(degrees) > MAX_TURN:
            raise ParameterError(f"'{line.strip()}': expected at most {MAX_TURN:g} degrees")
        turn[TURNS[word]] = radians(degrees)
        return 'shift', (way, turn)
    if word == 'goto':
        return _pose(_numbers(word, rest, 'X Y Z [ROLL PITCH YAW]', (3, 6)))
    if word == 'controller':
        if len(rest) != 1:
            raise ParameterError("'controller': expected one NAME after it")
        return word, (rest[0],)
    if word == 'wait':
        seconds = _numbers(word, rest, 'SECONDS', (0, 1))
        if any(one < 0 for one in seconds):
            raise ParameterError(f"'{line.strip()}': expected SECONDS from 0")
        return word, tuple(seconds)
    if word not in ORDERS and word not in poses:
        raise ParameterError(f"'{word}': expected {HELP}, or a pose of {', '.join(poses)}")
    if rest:
        raise ParameterError(f"'{line.strip()}': expected nothing after '{word}'")
    return (word, ()) if word in ORDERS else _pose(poses[word])


def _pose(values):
    attitude = rotations.from_rpy(*map(radians, values[3:])) if len(values) == 6 else None
    return 'goto', (np.array(values[:3], dtype=float), attitude)


def _numbers(word, texts, wanted, counts):
    try:
        values = [float(text) for text in texts]
    except ValueError:
        values = [float('nan')]
    if len(values) not in counts or not all(map(isfinite, values)):
        raise ParameterError(f"'{' '.join([word, *texts])}': expected {word} {wanted}")
    return values
