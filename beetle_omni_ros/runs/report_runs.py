"""The flights of a report on a common time axis."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from beetle_omni_ros.control.base import PoseTarget, Target
from beetle_omni_ros.runs.body import EDGE, errors, Motion, motion, reference_poses
from beetle_omni_ros.runs.log import FlightLog
from beetle_omni_ros.runs.tasks import Task

STEP = 0.01             # [s] of the time axis, or more for long flights
MOST = 12_000           # samples of the time axis
BEFORE = 3.0            # [s] before the first target
STALE = 0.3             # [s] after which a value without a newer one is not drawn
TRAJECTORY_STEP = 0.05  # [s] between the drawn poses of a trajectory


@dataclass(frozen=True)
class Run:
    """
    One flight of a report.

    Attributes:
        label: name on the page.
        colour: colour of its lines.
        log: the flight.
        task: flown task, or None if the log does not name it.
        results: label -> metrics, one entry for each controller that flew.

    """

    label: str
    colour: str
    log: FlightLog
    task: Task | None
    results: dict[str, dict]

    @property
    def start(self) -> float:
        """Time of the first target [s], which is 0 in the charts."""
        return self.log.targets[0].stamp if self.log.targets else self.log.start

    @property
    def target_spans(self) -> list[tuple[Target, float]]:
        """(target, its end [s]) of each target; empty if none was recorded."""
        targets = self.log.targets
        return list(zip(targets, [t.stamp for t in targets[1:]] + [self.log.end], strict=False))

    @property
    def body(self) -> Motion:
        """The motion that the metrics use."""
        return motion(self.log)


@dataclass(frozen=True)
class TimeAxis:
    """Times since the first target of each run: ``count`` of them, ``step`` [s] apart."""

    start: float
    step: float
    count: int

    @classmethod
    def of(cls, runs: list[Run]) -> TimeAxis:
        """Make an axis that covers all flights."""
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
        Return the latest values of a series at the times of the axis.

        Args:
            run: run of the series.
            t: (N,) times on the clock of the flight [s].
            values: (N, ...) values.

        Returns:
            (count, ...) values, NaN before the series, after it and in its gaps.

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
    """Return (n,) times [s], (n,) position errors [m], (n,) orientation errors [deg]."""
    body, parts = run.body, []
    for target, end in run.target_spans:
        window = body.window(target.stamp, end - 1e-3)
        if body.t[window].size:
            parts.append((body.t[window], *errors(body, target, window)))
    if not parts:
        return np.zeros(0), np.zeros(0), np.zeros(0)
    return tuple(np.concatenate(column) for column in zip(*parts, strict=True))


def target_poses(run: Run) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return (n,) times since the first target [s] and (n, 3), (n, 4) poses of the targets."""
    times, positions, quaternions = [], [], []
    for target, end in run.target_spans:
        t = np.array([target.stamp]) if isinstance(target, PoseTarget) else \
            np.arange(target.times[0], min(end, target.times[-1]), TRAJECTORY_STEP)
        position, quaternion = reference_poses(target, t)
        times.append(t - run.start)
        positions.append(position)
        quaternions.append(quaternion)
    if not times:
        return np.zeros(0), np.zeros((0, 3)), np.zeros((0, 4))
    return np.concatenate(times), np.concatenate(positions), np.concatenate(quaternions)
