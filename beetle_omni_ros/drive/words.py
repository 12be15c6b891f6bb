"""Parser of typed commands: `up 0.3`, `roll 180`, `goto 1 0 1 0 0 90`, `home`."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import isfinite, radians

import numpy as np

from beetle_omni_ros.robot import rotations

WAYS = {'forth': (0, 1), 'back': (0, -1), 'left': (1, 1), 'right': (1, -1), 'up': (2, 1),
        'down': (2, -1)}
TURNS = {'roll': 0, 'pitch': 1, 'yaw': 2}
ORDERS = ('arm', 'land', 'emergency_stop', 'hold', 'level', 'where', 'help', 'quit')
HELP = ('forth|back|left|right|up|down METRES, roll|pitch|yaw DEGREES, '
        'goto X Y Z [ROLL PITCH YAW], controller NAME, wait [SECONDS], arm, land, hold, level, '
        'where, emergency_stop, quit')
MAX_TURN = 180.0    # [deg]; the shortest path to a larger rotation has the other direction


class WordError(ValueError):
    """A typed line is not a command; the message has the expected input."""


@dataclass(frozen=True)
class Shift:
    """Shift of the goal: (3,) in world [m], (3,) roll, pitch, yaw [rad]."""

    way: np.ndarray
    turn: np.ndarray


@dataclass(frozen=True)
class Go:
    """A goal: (3,) in world [m], (4,) body to world, xyzw, or None to keep the attitude."""

    position: np.ndarray
    quaternion: np.ndarray | None


@dataclass(frozen=True)
class Order:
    """Another command: its name and its argument."""

    name: str
    value: str = ''


def parse(line: str, poses: Mapping[str, Sequence[float]]) -> Shift | Go | Order | None:
    """
    Parse one line; None for an empty line or a comment after #.

    ``poses``: name -> x, y, z [m], roll, pitch, yaw [deg].

    Raises:
        WordError: not a command.

    """
    word, *rest = line.partition('#')[0].split() or ['']
    word = word.lower()
    if not word:
        return None
    if word in WAYS:
        axis, direction = WAYS[word]
        way = np.zeros(3)
        way[axis] = direction * _numbers(word, rest, 'METRES', (1,))[0]
        return Shift(way, np.zeros(3))
    if word in TURNS:
        degrees, = _numbers(word, rest, 'DEGREES', (1,))
        if abs(degrees) > MAX_TURN:
            raise WordError(f"'{line.strip()}': expected at most {MAX_TURN:g} degrees")
        turn = np.zeros(3)
        turn[TURNS[word]] = radians(degrees)
        return Shift(np.zeros(3), turn)
    if word == 'goto':
        values = _numbers(word, rest, 'X Y Z [ROLL PITCH YAW]', (3, 6))
        return _pose(values)
    if word == 'controller':
        if len(rest) != 1:
            raise WordError("'controller': expected one NAME after it")
        return Order(word, rest[0])
    if word == 'wait':
        seconds = _numbers(word, rest, 'SECONDS', (0, 1))
        if any(one < 0 for one in seconds):
            raise WordError(f"'{line.strip()}': expected SECONDS from 0")
        return Order(word, str(seconds[0]) if seconds else '')
    if rest:
        raise WordError(f"'{line.strip()}': expected nothing after '{word}'" if word in (
            *ORDERS, *poses) else _unknown(word, poses))
    if word in ORDERS:
        return Order(word)
    if word in poses:
        return _pose(poses[word])
    raise WordError(_unknown(word, poses))


def _pose(values):
    position = np.array(values[:3], dtype=float)
    return Go(position, rotations.from_rpy(*map(radians, values[3:])) if len(values) == 6
              else None)


def _unknown(word, poses):
    return f"'{word}': expected {HELP}, or a pose of {', '.join(poses)}"


def _numbers(word, texts, wanted, counts):
    try:
        values = [float(text) for text in texts]
    except ValueError:
        values = [float('nan')]
    if len(values) not in counts or not all(map(isfinite, values)):
        raise WordError(f"'{' '.join([word, *texts])}': expected {word} {wanted}")
    return values
