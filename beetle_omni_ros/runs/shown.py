"""The flights of a report, on one time axis."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from beetle_omni_ros.control.base import PoseTarget, Target
from beetle_omni_ros.runs.body import EDGE, errors, Motion, motion, reference_poses
from beetle_omni_ros.runs.log import FlightLog
from beetle_omni_ros.runs.tasks import Task

STEP = 0.01             # [s] of the time axis, or more where the flights are long
MOST = 12_000           # times of it
BEFORE = 3.0            # [s] shown before the first target
STALE = 0.3             # [s] after which a value that was not renewed is not drawn
TRAJECTORY_STEP = 0.05  # [s] between the drawn poses of a trajectory


@dataclass(frozen=True)
class Run:
    """
    One flight of a report.

    Attributes:
        label: what it is called on the page.
        colour: of its lines.
        log: the flight.
        task: what was flown, where the log says.
        results: label -> metrics, one entry for each controller that flew.

    """

    label: str
    colour: str
    log: FlightLog
    task: Task | None
    results: dict[str, dict]

    @property
    def start(self) -> float:
        """Time of the first target, from which the plots count [s]."""
        return self.log.targets[0].stamp if self.log.targets else self.log.start

    @property
    def pursued(self) -> list[tuple[Target, float]]:
        """(target, end of its time [s]) of each target; empty where none was recorded."""
        targets = self.log.targets
        return list(zip(targets, [t.stamp for t in targets[1:]] + [self.log.end], strict=False))

    @property
    def body(self) -> Motion:
        """The motion that the metrics judge."""
        return motion(self.log)


@dataclass(frozen=True)
class TimeAxis:
    """Times since the first target of each run: ``count`` of them, ``step`` [s] apart."""

    start: float
    step: float
    count: int

    @classmethod
    def of(cls, runs: list[Run]) -> TimeAxis:
        """Cover all flights."""
        start = max(-BEFORE, min(run.body.t[0] - run.start for run in runs))
        end = max(run.body.t[-1] - run.start for run in runs)
        step = max(STEP, (end - start) / MOST)
        return cls(float(start), float(step), int((end - start) / step) + 1)

    @property
    def times(self) -> np.ndarray:
        """(count,) [s]."""
        return self.start + self.step * np.arange(self.count)

    def sampled(self, run: Run, t: np.ndarray, values: np.ndarray) -> np.ndarray:
        """
        Values of a series of a run in force at the times of the axis.

        Args:
            run: whose series it is.
            t: (N,) on the clock of its flight [s].
            values: (N, ...).

        Returns:
            (count, ...), NaN before the series, after it and where it was not renewed.

        """
        if not len(t):
            return np.full((self.count, *values.shape[1:]), np.nan)
        at = self.times + run.start
        index = np.searchsorted(t, at + EDGE, side='right') - 1
        made = np.array(values[np.maximum(index, 0)], dtype=float)
        usual = float(np.median(np.diff(t))) if len(t) > 1 else 0.0
        made[(index < 0) | (at - t[np.maximum(index, 0)] > max(STALE, 3 * usual))] = np.nan
        return made


def error_series(run: Run) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(n,) times [s], (n,) position errors [m], (n,) orientation errors [deg]."""
    body, parts = run.body, []
    for target, end in run.pursued:
        window = body.window(target.stamp, end - 1e-3)
        if body.t[window].size:
            parts.append((body.t[window], *errors(body, target, window)))
    if not parts:
        return np.zeros(0), np.zeros(0), np.zeros(0)
    return tuple(np.concatenate(column) for column in zip(*parts, strict=True))


def target_poses(run: Run) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(n,) times since the first target [s] and (n, 3), (n, 4) poses asked for from then on."""
    times, positions, quaternions = [], [], []
    for target, end in run.pursued:
        t = np.array([target.stamp]) if isinstance(target, PoseTarget) else \
            np.arange(target.times[0], min(end, target.times[-1]), TRAJECTORY_STEP)
        position, quaternion = reference_poses(target, t)
        times.append(t - run.start)
        positions.append(position)
        quaternions.append(quaternion)
    if not times:
        return np.zeros(0), np.zeros((0, 3)), np.zeros((0, 4))
    return np.concatenate(times), np.concatenate(positions), np.concatenate(quaternions)
