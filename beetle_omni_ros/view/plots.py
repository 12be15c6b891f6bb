"""The plots beside the scene, and their data in a window around the present time."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from beetle_omni_ros.runs.body import geodesic_angles
from beetle_omni_ros.view.frames import COLUMNS, T

COLOURS = ('#e4572e', '#17a398', '#5b6ee1', '#d4a017')     # of x, y, z; of rotors and joints
RUN_COLOURS = ((228, 87, 46), (23, 163, 152), (91, 110, 225), (212, 160, 23))
NOW = '#8a8f98'
BEHIND, AHEAD = 6.0, 6.0        # [s] around the present that a plot shows
HEIGHT = 150                    # [px]


@dataclass(frozen=True)
class Plot:
    """
    One plot.

    Attributes:
        title: title with unit.
        labels: labels of its series.
        values: rows (N, WIDTH) -> (N, len(labels)).
        compares: whether it shows all runs; otherwise the first run only.

    """

    title: str
    labels: tuple[str, ...]
    values: Callable[[np.ndarray], np.ndarray]
    compares: bool = False


def colour(run: int) -> str:
    """Return the HTML colour of a run."""
    return '#{:02x}{:02x}{:02x}'.format(*RUN_COLOURS[run % len(RUN_COLOURS)])


def _field(name, scale=1.0):
    return lambda rows: scale * rows[:, COLUMNS[name]]


def _position_error(rows):
    return np.linalg.norm(rows[:, COLUMNS['position']] - rows[:, COLUMNS['target_position']],
                          axis=1, keepdims=True)


def _orientation_error(rows):
    return np.degrees(geodesic_angles(rows[:, COLUMNS['quaternion']],
                                      rows[:, COLUMNS['target_quaternion']]))[:, None]


FOUR = ('1', '2', '3', '4')
PLOTS = (
    Plot('position error [m]', ('',), _position_error, True),
    Plot('orientation error [deg]', ('',), _orientation_error, True),
    Plot('position [m]', ('x', 'y', 'z'), _field('position')),
    Plot('tilt [deg]', FOUR, _field('tilt', 180 / np.pi)),
    Plot('thrust command [N]', FOUR, _field('thrust')),
    Plot('battery [V]', ('V',), _field('voltage')),
)


def window(plot: Plot, runs: list[np.ndarray], now: float) -> tuple[np.ndarray, ...] | None:
    """
    Return the series of a plot around the present time.

    Args:
        plot: plot to draw.
        runs: rows (N, WIDTH) of each run, on the time base of the first.
        now: present time [s].

    Returns:
        Times, the series, and a vertical line at ``now`` from 0 to 1 on its own scale. All have
        equal length. The series contain no NaN, at which the plotting library would stop. None
        without data.

    """
    series = [plot.values(rows) for rows in (runs if plot.compares else runs[:1])]
    own = [rows[:, T] for rows in runs][:len(series)]
    times = np.unique(np.concatenate(own))
    if not any(np.isfinite(values).any() for values in series):
        return None
    columns = [_over(times, t, column) for t, values in zip(own, series, strict=True)
               for column in values.T]
    spare = next(column for column in columns if column is not None)
    k = int(np.searchsorted(times, now))
    mark = np.insert(np.full(len(times), np.nan), [k, k], [0.0, 1.0])
    return (np.insert(times, [k, k], now),
            *(np.insert(column, [k, k], np.interp(now, times, column))
              for column in (spare if column is None else column for column in columns)), mark)


def _over(times, own, values):
    """Values interpolated at other times, without NaN; None without values."""
    there = np.isfinite(values)
    return np.interp(times, own[there], values[there]) if there.any() else None
