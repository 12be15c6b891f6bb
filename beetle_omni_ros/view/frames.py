"""What is shown of one moment, and a run as a table of such moments."""

from __future__ import annotations

from bisect import bisect_right
from typing import Any

import numpy as np

from beetle_omni_ros.control.base import Target
from beetle_omni_ros.robot import rotations
from beetle_omni_ros.runs.log import FAULT_KEY, FlightLog, SUPERVISOR_STATUS
from beetle_omni_ros.runs.recorder import Recorder

FIELDS = {'t': 1, 'position': 3, 'quaternion': 4, 'estimate_position': 3,
          'estimate_quaternion': 4, 'target_position': 3, 'target_quaternion': 4, 'tilt': 4,
          'tilt_command': 4, 'thrust': 4, 'voltage': 1, 'current': 1, 'force': 3}
"""
Columns of a row, by name -> width: time [s]; the body in world, true where that is known, else
estimated; the estimate beside the truth; the target; tilt measured and commanded [rad]; thrust
commanded [N]; battery [V], [A]; external force in world [N]. NaN where unknown.
"""

_ENDS = np.cumsum(list(FIELDS.values()))
COLUMNS = {name: slice(int(end) - width, int(end))
           for (name, width), end in zip(FIELDS.items(), _ENDS, strict=True)}
WIDTH = int(_ENDS[-1])
T = COLUMNS['t'].start
INPUTS = ': inputs'   # ending of the status in which a node tells what it refused
STEPPED = ('target_position', 'target_quaternion', 'force')   # hold until the next row
QUATERNIONS = ('quaternion', 'estimate_quaternion')


def known(row: np.ndarray, name: str) -> np.ndarray | None:
    """Values of one field of a row; None where they are unknown."""
    values = row[COLUMNS[name]]
    return None if np.isnan(values).any() else values


def pose(row: np.ndarray, prefix: str = '') -> tuple[np.ndarray, np.ndarray] | None:
    """Position [m] and quaternion of the body, 'estimate_' or 'target_'; None where unknown."""
    position, quaternion = (known(row, f'{prefix}{part}') for part in ('position', 'quaternion'))
    return None if position is None or quaternion is None else (position, quaternion)


class Sampler(Recorder):
    """
    Keeps the newest of everything, and gives it as rows and as what was told when.

    Attributes:
        meta: of the run.
        target: the newest; assigning one takes a refused one back.
        states: (t, state) of the supervisor, in the order of their arrival.
        faults: name -> when it was first told [s].
        clock: stamp of the newest pose [s]; NaN before the first.
        remarks: (status, text) of each warning or error of a node's inputs, as it came.

    """

    def __init__(self):
        self.clock = np.nan
        self.remarks: list[tuple[str, str]] = []
        self._row = np.full(WIDTH, np.nan)
        self._truth = False
        self.target: Target | None = None
        self._told = FlightLog()
        self._named: frozenset = frozenset()
        self.meta: dict = {}
        self.states: list[tuple[float, str]] = []
        self.faults: dict[str, float] = {}

    @property
    def placed(self) -> bool:
        """Whether it is known where the robot is."""
        return pose(self._row) is not None

    def row(self, t: float) -> np.ndarray:
        """(WIDTH,) newest values at ``t`` [s]."""
        row = self._row.copy()
        row[T] = t
        if self.target is not None:
            reference = self.target.at(t)
            row[COLUMNS['target_position']] = reference.position
            row[COLUMNS['target_quaternion']] = reference.quaternion
        return row

    def _set(self, **values):
        for name, value in values.items():
            self._row[COLUMNS[name]] = value

    def write(self, topic: str, value: Any, received: float | None = None) -> None:
        """Take one value, as the table of topics has it; nothing of other topics is shown."""
        taker = self._TAKERS.get(topic)
        if taker is not None:
            taker(self, value, received)

    def write_meta(self, meta: dict) -> None:
        """Add to what is known of the flight."""
        self.meta.update(meta)

    def _take_truth(self, odom, _):
        self._truth, self.clock = True, float(odom.stamp)
        self._set(position=odom.position, quaternion=odom.quaternion)

    def _take_odom(self, odom, _):
        self.clock = float(odom.stamp)
        if self._truth:
            self._set(estimate_position=odom.position, estimate_quaternion=odom.quaternion)
        else:       # it stands for the body while no truth is known
            self._set(position=odom.position, quaternion=odom.quaternion)

    def _take_joints(self, joints, _):
        self._set(tilt=joints.position)

    def _take_command(self, command, _):
        self._set(tilt_command=command.tilt, thrust=command.thrust)

    def _take_battery(self, battery, _):
        self._set(voltage=battery.voltage, current=battery.current)

    def _take_wrench(self, wrench, _):
        self._set(force=wrench.force if np.any(wrench.force) else np.nan)

    def _take_target(self, target, _):
        if self.target is None or target.stamp >= self.target.stamp:
            self.target = target

    def _take_state(self, state, received):
        self.states.append((float(received), state))
        self._told.state_t = np.append(self._told.state_t, received)
        self._told.states.append(state)
        self.faults = self._told.named_faults()

    def _take_diagnostics(self, statuses, _):
        for status in statuses:
            if status.level and status.name.endswith(INPUTS):
                self.remarks.append((status.name, status.message))
            named = frozenset(key for key in status.values if key.startswith(FAULT_KEY))
            if status.name.endswith(SUPERVISOR_STATUS) and named - self._named:
                self._named |= named
                self._told.diagnostics.append(status)
                self.faults = self._told.named_faults()

    _TAKERS = {'ground_truth/odom': _take_truth, 'odom': _take_odom,
               'joint_states': _take_joints, 'command': _take_command,
               'battery_state': _take_battery, 'disturbance': _take_wrench,
               'target_pose': _take_target, 'target_trajectory': _take_target,
               'supervisor/state': _take_state, 'diagnostics': _take_diagnostics}


class Rows:
    """
    Rows in time, which may grow.

    Args:
        longest: time that is kept [s].

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
        """Add (M, WIDTH) rows; those that do not follow in time are left out."""
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
        One row at a time, between the rows around it.

        Poses, angles and thrusts are interpolated, quaternions as vectors; targets and external
        forces hold. Outside, the first or last row holds.

        Args:
            t: [s].

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
        """Rows from ``begin`` to ``end`` [s], at most about ``most`` of them, evenly."""
        first, last = np.searchsorted(self.times, [begin, end])
        return self.table[first:last:max(1, int(last - first) // most)]


def state_at(states: list[tuple[float, str]], t: float) -> str:
    """State of the supervisor at ``t`` [s]; '' before the first."""
    k = bisect_right(states, t, key=lambda entry: entry[0]) - 1
    return states[k][1] if k >= 0 else ''
