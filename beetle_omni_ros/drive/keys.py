"""Shifts of the goal by keys and joystick axes."""

from collections.abc import Sequence

import numpy as np

from beetle_omni_ros.drive.parameters import DriveParameters

# Key -> (axis of x, y, z, roll, pitch, yaw, direction).
MOVES = {'w': (0, 1), 's': (0, -1), 'a': (1, 1), 'd': (1, -1), 'r': (2, 1), 'f': (2, -1),
         'o': (3, 1), 'u': (3, -1), 'i': (4, 1), 'k': (4, -1), 'j': (5, 1), 'l': (5, -1)}
WORDS = {'t': 'arm', 'x': 'land', ' ': 'hold', 'h': 'home', '0': 'level', '!': 'emergency_stop',
         'c': 'controller', 'q': 'quit'}
HELP = ('w s a d r f: forth, back, left, right, up, down    o u i k j l: roll, pitch, yaw\n'
        't arm and take off, x land, space hold, h home, 0 level, c other controller, '
        '! emergency stop, q quit')
ORDER = (0, 1, 2, 5, 4, 3)      # DriveParameters.axes -> index in x, y, z, roll, pitch, yaw


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
    Shift by a joystick in ``seconds``; a fully deflected axis moves at full speed or rate.

    Args:
        axes: axes of sensor_msgs/Joy, -1 to 1; a missing or not finite one counts as released.
        seconds: time since the last shift [s].
        p: mapping of the axes, and the dead zone, at whose edge the speed is zero.

    Returns:
        shift (3,) [m] and (3,) roll, pitch, yaw [rad].

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
