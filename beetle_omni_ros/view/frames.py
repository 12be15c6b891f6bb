"""Rows of displayed values, and a run as a table of rows over time."""

from bisect import bisect_right
from typing import Any

import numpy as np

from beetle_omni_ros.control.base import Target
from beetle_omni_ros.robot import rotations
from beetle_omni_ros.runs.log import FAULT_KEY, FlightLog, Recorder, SUPERVISOR_STATUS

FIELDS = {'t': 1, 'position': 3, 'quaternion': 4, 'estimate_position': 3,
          'estimate_quaternion': 4, 'target_position': 3, 'target_quaternion': 4, 'tilt': 4,
          'tilt_command': 4, 'thrust': 4, 'voltage': 1, 'current': 1, 'force': 3}
"""
Columns of a row, by name -> width: time [s]; the body in world, true if known, else estimated; the
estimate if the truth is known; the target; tilt measured and commanded [rad]; thrust commanded
[N]; battery [V], [A]; external force in world [N]. NaN if unknown.
"""

_ENDS = np.cumsum(list(FIELDS.values()))
COLUMNS = {name: slice(int(end) - width, int(end))
           for (name, width), end in zip(FIELDS.items(), _ENDS, strict=True)}
WIDTH = int(_ENDS[-1])
T = COLUMNS['t'].start
INPUTS = ': inputs'   # ending of the name of the status about a node's inputs
SHOWN = {'ground_truth/odom': {'position': 'position', 'quaternion': 'quaternion'},
         'odom': {'estimate_position': 'position', 'estimate_quaternion': 'quaternion'},
         'joint_states': {'tilt': 'position'},
         'command': {'tilt_command': 'tilt', 'thrust': 'thrust'},
         'battery_state': {'voltage': 'voltage', 'current': 'current'},
         'disturbance': {'force': 'force'}}     # topic -> column -> part of its value
POSED = ('ground_truth/odom', 'odom')
STEPPED = ('target_position', 'target_quaternion', 'force')   # not interpolated
QUATERNIONS = ('quaternion', 'estimate_quaternion')


def known(row: np.ndarray, name: str) -> np.ndarray | None:
    """Return the values of one field of a row; None if unknown."""
    values = row[COLUMNS[name]]
    return None if np.isnan(values).any() else values


def pose(row: np.ndarray, prefix: str = '') -> tuple[np.ndarray, np.ndarray] | None:
    """Return position [m] and quaternion of the body, 'estimate_' or 'target_', or None."""
    position, quaternion = (known(row, f'{prefix}{part}') for part in ('position', 'quaternion'))
    return None if position is None or quaternion is None else (position, quaternion)


class Sampler(Recorder):
    """
    Keeps the newest values of all topics, and samples them into rows.

    Attributes:
        meta: metadata of the run.
        target: newest target; assignment replaces a refused one.
        states: (t, state) of the supervisor, in the order of receipt.
        faults: name -> time of the first report [s].
        clock: stamp of the newest pose [s]; NaN before the first.
        input_warnings: (status, text) of each warning or error about a node's inputs.

    """

    def __init__(self):
        self.clock = np.nan
        self.input_warnings: list[tuple[str, str]] = []
        self._row = np.full(WIDTH, np.nan)      # newest values, before _stand_in
        self._series: list[tuple[np.ndarray, dict[str, np.ndarray]]] = []   # since rows()
        self.target: Target | None = None
        self._targets: list[tuple[float, Target | None]] = [(-np.inf, None)]
        self._log = FlightLog()
        self._named: frozenset = frozenset()
        self.meta: dict = {}
        self.states: list[tuple[float, str]] = []
        self.faults: dict[str, float] = {}

    @property
    def placed(self) -> bool:
        """Whether a pose of the robot is known."""
        return pose(self._row) is not None or pose(self._row, 'estimate_') is not None

    def row(self, t: float) -> np.ndarray:
        """Return the (WIDTH,) newest values at ``t`` [s]."""
        return _table(self._row, np.array([t]), [self.target])[0]

    def rows(self, times: np.ndarray) -> np.ndarray:
        """
        Return the newest values at each time, and forget older ones.

        Args:
            times: (N,) increasing times [s], later than those of the previous call.

        Returns:
            (N, WIDTH) newest values by the times of receipt.

        """
        received = [t for t, _ in self._targets]
        table = _table(self._row, times, [self._targets[k - 1][1]
                                          for k in np.searchsorted(received, times, 'right')])
        for received, columns in self._series:
            newest = np.searchsorted(np.maximum.accumulate(received), times, 'right') - 1
            there = newest >= 0
            for name, values in columns.items():
                table[there, COLUMNS[name]] = values[newest[there]]
                self._row[COLUMNS[name]] = values[-1]
        self._series, self._targets = [], [(-np.inf, self._targets[-1][1])]
        return _stand_in(table)

    def write(self, topic: str, value: Any, received: float | np.ndarray | None = None) -> None:
        """
        Store one value; topics that are not displayed are ignored.

        Values of a series may have fields that are arrays over several messages.
        """
        if topic not in SHOWN:
            taker = self._TAKERS.get(topic)
            if taker is not None:
                taker(self, value, received)
            return
        columns = {name: np.nan if getattr(value, part) is None else getattr(value, part)
                   for name, part in SHOWN[topic].items()}
        if np.ndim(value.stamp):
            self._series.append((received, {
                name: np.reshape(values, (len(received), -1)) for name, values in columns.items()
                if np.ndim(values)}))
        else:
            for name, values in columns.items():
                self._row[COLUMNS[name]] = values
        if topic in POSED:
            self.clock = float(np.ravel(value.stamp)[-1])

    def write_meta(self, meta: dict) -> None:
        """Add metadata of the flight."""
        self.meta.update(meta)

    def _take_target(self, target, received):
        if self.target is None or target.stamp >= self.target.stamp:
            self.target = target
            self._targets.append((received, target))

    def _take_state(self, state, received):
        self.states.append((float(received), state))
        self._log.state_t = np.append(self._log.state_t, received)
        self._log.states.append(state)
        self.faults = self._log.named_faults()

    def _take_diagnostics(self, statuses, _):
        for status in statuses:
            if status.level and status.name.endswith(INPUTS):
                self.input_warnings.append((status.name, status.message))
            named = frozenset(key for key in status.values if key.startswith(FAULT_KEY))
            if status.name.endswith(SUPERVISOR_STATUS) and named - self._named:
                self._named |= named
                self._log.diagnostics.append(status)
                self.faults = self._log.named_faults()

    _TAKERS = {'target_pose': _take_target, 'target_trajectory': _take_target,
               'supervisor/state': _take_state, 'diagnostics': _take_diagnostics}


def _table(row, times, targets):
    """(N, WIDTH) copies of one row with times and targets."""
    table = np.tile(row, (len(times), 1))
    table[:, T] = times
    for k, target in enumerate(targets):
        if target is not None:
            reference = target.at(times[k])
            table[k, COLUMNS['target_position']] = reference.position
            table[k, COLUMNS['target_quaternion']] = reference.quaternion
    return _stand_in(table)


def _stand_in(table):
    """Replace unknown truth by the estimate, and a force of zero by NaN."""
    unknown = np.isnan(table[:, COLUMNS['position']]).any(axis=1)
    for name in ('position', 'quaternion'):
        table[unknown, COLUMNS[name]] = table[unknown, COLUMNS[f'estimate_{name}']]
        table[unknown, COLUMNS[f'estimate_{name}']] = np.nan
    table[~table[:, COLUMNS['force']].any(axis=1), COLUMNS['force']] = np.nan
    return table


class Rows:
    """
    Growing table of rows over time.

    Args:
        longest: duration that is kept [s].

    """

    def __init__(self, longest: float = np.inf):
        self._table, self._begin, self._end = np.empty((1024, WIDTH)), 0, 0
        self._longest = longest

    def __len__(self) -> int:
        return self._end - self._begin

    @property
    def table(self) -> np.ndarray:
        """(N, WIDTH) rows."""
        return self._table[self._begin:self._end]

    @property
    def times(self) -> np.ndarray:
        """(N,) times [s]."""
        return self.table[:, T]

    def append(self, rows: np.ndarray) -> None:
        """Add (M, WIDTH) rows, without those that are not later than the previous one."""
        last = self.times[-1] if len(self) else -np.inf
        rows = rows[np.maximum.accumulate(np.concatenate([[last], rows[:-1, T]])) < rows[:, T]]
        if self._end + len(rows) > len(self._table):
            kept = self.table
            self._table = np.empty((2 * (len(kept) + len(rows)), WIDTH))
            self._table[:len(kept)] = kept
            self._begin, self._end = 0, len(kept)
        self._table[self._end:self._end + len(rows)] = rows
        self._end += len(rows)
        if len(self) and self._longest < np.inf:
            self._begin += int(np.searchsorted(self.times, self.times[-1] - self._longest))

    def at(self, t: float) -> np.ndarray:
        """
        Return the row at time ``t`` [s], interpolated between its neighbours.

        Quaternions are interpolated as vectors; targets and external forces are held. Outside the
        table, the first or last row is returned.

        Raises:
            IndexError: there are no rows.

        """
        table = self.table
        k = int(np.searchsorted(table[:, T], t, side='right')) - 1
        before = table[min(max(k, 0), len(table) - 1)]
        if k < 0 or k >= len(table) - 1:
            return before.copy()
        after = table[k + 1].copy()
        part = (t - before[T]) / (after[T] - before[T])
        for name in QUATERNIONS:
            if before[COLUMNS[name]] @ after[COLUMNS[name]] < 0:
                after[COLUMNS[name]] *= -1
        row = np.where(np.isnan(after) | np.isnan(before), before,
                       (1 - part) * before + part * after)
        for name in STEPPED:
            row[COLUMNS[name]] = before[COLUMNS[name]]
        for name in QUATERNIONS:
            if pose(row, name.removesuffix('quaternion')) is not None:
                row[COLUMNS[name]] = rotations.normalized(row[COLUMNS[name]])
        row[T] = t
        return row

    def window(self, begin: float, end: float, most: int = 200) -> np.ndarray:
        """Return about ``most`` or fewer evenly spaced rows from ``begin`` to ``end`` [s]."""
        first, last = np.searchsorted(self.times, [begin, end])
        return self.table[first:last:max(1, int(last - first) // most)]


def state_at(states: list[tuple[float, str]], t: float) -> str:
    """Return the state of the supervisor at ``t`` [s]; '' before the first."""
    k = bisect_right(states, t, key=lambda entry: entry[0]) - 1
    return states[k][1] if k >= 0 else ''
