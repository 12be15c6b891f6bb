"""Where a flight goes: smooth references of position and attitude."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation, RotationSpline

RATE = 100.0  # [Hz] of the tables


@dataclass
class Course:
    """
    A reference as a table of ``RATE``.

    Attributes:
        position, velocity, acceleration: (N, 3) in world.
        rotation: (N, 3, 3) body to world; rate (N, 3) in the reference's own axes.

    """

    position: np.ndarray
    velocity: np.ndarray
    acceleration: np.ndarray
    rotation: np.ndarray
    rate: np.ndarray


def make_course(kind: str, duration: float, rng: np.random.Generator,
                vigour: float = 1.0) -> Course:
    """
    Draw a course.

    Args:
        kind: 'poses' (changes of pose with low passes and strong rotation), 'hover' (one pose) or
            'lemniscate'.
        duration: [s].
        rng: of this flight.
        vigour: 1 is normal, less is calmer.

    """
    times = np.arange(0.0, duration + 1.0, 1 / RATE)
    if kind == 'poses':
        knots, position, angles = _pose_table(duration, rng, vigour)
        return _course(_eased(times, knots, position), _eased_rotations(times, knots, angles))
    return _course(*(_lemniscate if kind == 'lemniscate' else _hover)(times, rng))


def _pose_table(duration, rng, vigour):
    """Times, positions and yaw-pitch-roll; each pose is held from an odd to an even entry."""
    knots, positions, angles = [0.0], [np.array([0.0, 0.0, 1.2])], [np.zeros(3)]
    t, low = 1.0, 0
    while t < duration + 1.0:
        knots.append(t)
        positions.append(positions[-1])
        angles.append(angles[-1])
        low = 2 if low == 0 and rng.random() < 0.22 else max(0, low - 1)
        place = np.array([*rng.uniform(-1.8, 1.8, 2), rng.uniform(0.7, 2.0)])
        lean = rng.uniform(-1.0, 1.0, 2) * (1.2 if rng.random() < 0.4 else 0.7)
        if low:
            place[2], lean = rng.uniform(0.21, 0.35), lean * 0.05
        yaw = angles[-1][0] + rng.uniform(-2.2, 2.2)
        turn = np.array([yaw, *lean])
        effort = max(np.linalg.norm(place - positions[-1]) / 1.0,
                     np.abs(turn - angles[-1]).max() / 1.0)
        t += max(0.9, effort * rng.uniform(0.7, 1.3)) / vigour
        knots.append(t)
        positions.append(place)
        angles.append(turn)
        t += rng.uniform(0.2, 1.2)
    return np.array(knots), np.array(positions), np.array(angles)


def _ease(times, knots):
    """Interval and share 0..1 of a quintic between two knots."""
    k = np.clip(np.searchsorted(knots, times, side='right') - 1, 0, len(knots) - 2)
    s = np.clip((times - knots[k]) / (knots[k + 1] - knots[k]), 0.0, 1.0)
    return k, s ** 3 * (10 - 15 * s + 6 * s * s)


def _eased(times, knots, values):
    k, s = _ease(times, knots)
    return values[k] + s[:, None] * (values[k + 1] - values[k])


def _eased_rotations(times, knots, angles):
    k, s = _ease(times, knots)
    poses = Rotation.from_euler('ZYX', angles)
    way = (poses[:-1].inv() * poses[1:]).as_rotvec()
    return poses[k] * Rotation.from_rotvec(way[k] * s[:, None])


def _lemniscate(times, rng):
    """A figure of eight in three dimensions, with roll and pitch; fades in over 3 s."""
    period = rng.uniform(8.0, 11.0)
    rise = np.clip(times / 3.0, 0, 1)
    phase = 2 * np.pi / period * (times - 1.5 * (1 - (1 - rise) ** 2))
    size = rng.uniform(1.0, 1.5)
    position = np.stack([size * np.sin(phase), size * np.sin(phase) * np.cos(phase),
                         1.2 + 0.35 * np.sin(2 * phase)], axis=1)
    angles = np.stack([phase / 5, 0.4 * np.sin(phase), 0.4 * np.sin(phase + 1.0)], axis=1)
    angles[:, 2] -= 0.4 * np.sin(1.0)
    return position, Rotation.from_euler('ZYX', angles)


def _hover(times, rng):
    place = np.array([*rng.uniform(-0.5, 0.5, 2), rng.uniform(0.9, 1.4)])
    turn = np.array([0.0, 0.0, rng.uniform(-np.pi, np.pi)])
    ones = np.ones((len(times), 1))
    return place * ones, Rotation.from_rotvec(turn * ones)


def _course(position, rotation):
    step = 1 / RATE
    velocity = np.gradient(position, step, axis=0)
    acceleration = np.gradient(velocity, step, axis=0)
    # splines of a subset: a spline through every 10 ms would need a large solve for nothing
    every = 5
    times = np.arange(len(position)) * step
    last = (len(times) - 1) // every * every
    spline = RotationSpline(times[:last + 1:every], rotation[:last + 1:every])
    rate = spline(np.minimum(times, times[last]), 1)
    return Course(position, velocity, acceleration, rotation.as_matrix(), rate)
