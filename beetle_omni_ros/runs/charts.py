"""
Charts of a report, and their data for pages/charts.js.

Numbers are stored as 16-bit integers between minimum and maximum of their series, which is finer
than the width of a line. Differences of neighbours are compressed, all series together.
"""

from __future__ import annotations

import base64
from dataclasses import dataclass, field
import gzip
from html import escape
import json

import numpy as np

from beetle_omni_ros.control.base import PoseTarget, Target
from beetle_omni_ros.pages.figures import INK, PARTS
from beetle_omni_ros.pages.page import shipped
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.robot.schema import shortened
from beetle_omni_ros.runs.log import (
    EDGE,
    errors,
    estimate_errors,
    FlightLog,
    hold,
    inside,
    Motion,
    motion,
    reference_poses,
    roll_pitch_yaw,
)
from beetle_omni_ros.runs.metrics import L_WINDOW, REACHED_ORIENTATION, REACHED_POSITION, U_WINDOW
from beetle_omni_ros.runs.tasks import POSE_DURATION, Task

STEPS, ABSENT = 65534, -32768
STEP = 0.01             # [s] of the time axis, or more for long flights
MOST = 12_000           # samples of the time axis
BEFORE = 3.0            # [s] before the first target
STALE = 0.3             # [s] after which a value without a newer one is not drawn
TRAJECTORY_STEP = 0.05  # [s] between the drawn poses of a trajectory
FEW_POSES = 20          # up to this number, L and U windows are shaded
MOST_FAULTS = 12        # marked in a chart
MILLI = 1e3
TINY = {'m': 1e-4, 'deg': 1e-2}  # floor of logarithmic errors
L_COLOUR, U_COLOUR = '#eef1f5', '#cfe3d4'
PERIOD = 10.0           # [ms] of a controller's step
AXES = ('x [m]', 'y [m]', 'z [m]', 'roll [deg]', 'pitch [deg]', 'yaw [deg]')
ABSURD = 1e6            # [rad, rad/s, N] values that are left out of histograms
NARROW = 1e-9           # [rad, rad/s, N] range of a histogram below which it is widened
BINS = 60               # of a histogram
FEW = 3                 # poses below which no distribution is shown
SHARES = 200            # points of a distribution


@dataclass(frozen=True)
class Series:
    """
    One line of a chart.

    Attributes:
        label: text in the legend.
        colour: '#rrggbb'.
        y: (N,) values, NaN for missing ones.
        run: index of its run, whose switch hides the line, or None.
        style: 'line', 'dash', 'dot', 'step' or 'points'.
        band: whether to fill the area to the previous series.

    """

    label: str
    colour: str
    y: np.ndarray
    run: int | None = None
    style: str = 'line'
    band: bool = False


@dataclass(frozen=True)
class Chart:
    """
    Lines over one axis.

    Attributes:
        label: label of the vertical axis, with its unit.
        series: lines of the chart.
        x: (N,) increasing values of the horizontal axis; None: the time of the page.
        xlabel: label of the horizontal axis.
        log: whether the (horizontal, vertical) axis is logarithmic.
        upright: (x, text) of vertical marks.
        level: (y, text) of horizontal marks.
        windows: (from, to, colour) of shaded ranges of the horizontal axis.
        wide: whether the chart has the full width of the page.

    """

    label: str
    series: list[Series]
    x: np.ndarray | None = None
    xlabel: str = ''
    log: tuple[bool, bool] = (False, False)
    upright: list[tuple[float, str]] = field(default_factory=list)
    level: list[tuple[float, str]] = field(default_factory=list)
    windows: list[tuple[float, float, str]] = field(default_factory=list)
    wide: bool = True

    def spec(self, numbers: Numbers) -> dict:
        """Return the data of the chart for the script; adds its series to ``numbers``."""
        return {
            'label': self.label, 'xlabel': self.xlabel, 'log': self.log, 'level': self.level,
            'upright': self.upright, 'windows': self.windows, 'wide': self.wide,
            'x': None if self.x is None else numbers.add(self.x, self.log[0]),
            'series': [{'label': s.label, 'colour': s.colour, 'run': s.run, 'style': s.style,
                        'band': s.band, 'y': numbers.add(s.y, self.log[1])} for s in self.series]}


class Numbers:
    """All series of a page, encoded for the script."""

    def __init__(self):
        self._parts: list[np.ndarray] = []
        self._count = 0

    def add(self, values: np.ndarray, log: bool = False) -> dict:
        """
        Add a series (N,), NaN for missing values; return its position and scale.

        With ``log``, logarithms are stored and only positive values are kept.
        """
        values = np.asarray(values, dtype=float)
        if log:
            values = np.log10(np.where(values > 0, values, np.nan))
        known = values[np.isfinite(values)]
        low, high = (float(known.min()), float(known.max())) if known.size else (0.0, 0.0)
        step = (high - low) / STEPS or 1.0
        scaled = np.full(len(values), ABSENT)
        fine = np.isfinite(values)
        scaled[fine] = np.rint((values[fine] - low) / step) - STEPS // 2
        where = {'at': self._count, 'count': len(values), 'low': low, 'step': step, 'log': log}
        # Differences wrap round within 16 bits, and so do their sums in the script.
        self._parts.append(np.diff(scaled, prepend=0).astype('<i8').astype('<i2'))
        self._count += len(values)
        return where

    def blob(self) -> str:
        """Return all series, compressed, in base64."""
        data = np.concatenate([*self._parts, np.zeros(0, '<i2')])
        planes = data.view(np.uint8).reshape(-1, 2).T     # high bytes together: mostly equal
        return base64.b64encode(gzip.compress(planes.tobytes(), 9, mtime=0)).decode()


def data_block(data: dict, numbers: Numbers) -> str:
    """Return the HTML of the data for the script; no text in it can end the block."""
    text = json.dumps(data, separators=(',', ':'), allow_nan=False).replace('<', '\\u003c')
    return (f'<script type="application/json" id="data">{text}</script>\n'
            f'<script type="text/plain" id="numbers">{numbers.blob()}</script>\n')


def place(identifier: str, wide: bool = True) -> str:
    """Return the HTML element that the script fills with a chart."""
    return f'<div class="chart{"" if wide else " part"}" data-chart="{escape(identifier)}"></div>'


def scripts() -> str:
    """Return libraries and script of an interactive page as HTML."""
    libraries = ''.join(f'<script>{shipped(f"vendor/{name}.js")}</script>\n'
                        for name in ('uplot', 'three'))
    return (f'<style>{shipped("vendor/uplot.css")}</style>\n{libraries}'
            f'<script type="module">{shipped("charts.js")}{shipped("scene.js")}</script>\n')


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


def pose(runs: list[Run], axis: TimeAxis) -> list[Chart]:
    """Plot position and angles of every run and its target; angles within 180 deg of it."""
    wanted = [_wanted(run, axis) for run in runs]
    lines: list[list[Series]] = [[] for _ in AXES]
    tasks: list[object] = []
    for number, (run, target) in enumerate(zip(runs, wanted, strict=True)):
        body = run.body
        flown = np.hstack([axis.sampled(run, body.t, body.position),
                           axis.sampled(run, body.t, roll_pitch_yaw(body.quaternion))])
        near = np.nan_to_num(target[:, 3:])
        flown[:, 3:] = near + (flown[:, 3:] - near + 180) % 360 - 180
        task = run.log.meta.get('task')
        for k, (made, label) in enumerate(zip(lines, AXES, strict=True)):
            if run.log.targets and task not in tasks:
                made.append(Series('target', INK, target[:, k], style='dash'))
            made.append(Series(run.label, run.colour, flown[:, k], number))
        tasks.append(task)
    return [Chart(label, made, wide=False) for label, made in zip(AXES, lines, strict=True)]


def _wanted(run, axis):
    """(count, 6) target position [m] and angles [deg] at the times of the axis."""
    t, position, quaternion = target_poses(run)
    if not len(t):
        return np.full((axis.count, 6), np.nan)
    row = np.searchsorted(t, axis.times + EDGE, side='right') - 1
    values = np.hstack([position, roll_pitch_yaw(quaternion)])[np.maximum(row, 0)]
    values[row < 0] = np.nan
    return values


def errors_over_time(runs: list[Run], axis: TimeAxis) -> list[Chart]:
    """Plot both errors on a logarithmic scale; L and U windows of few poses are shaded."""
    series = [error_series(run) for run in runs]
    if not any(len(t) for t, _, _ in series):
        return []
    stamps = [t.stamp - runs[0].start for t in runs[0].log.targets if isinstance(t, PoseTarget)]
    windows = _windows(stamps) if len(stamps) <= FEW_POSES else []
    faults = [(at - run.start, shortened(name)) for run in runs
              for name, at in run.log.named_faults().items()][:MOST_FAULTS]
    return [Chart(f'{name} [{unit}]', [
        Series(run.label, run.colour,
               axis.sampled(run, t, np.maximum(both[k], TINY[unit])), number)
        for number, (run, (t, *both)) in enumerate(zip(runs, series, strict=True))],
        log=(False, True), windows=windows, upright=faults)
        for k, (name, unit) in enumerate((('position error', 'm'), ('orientation error', 'deg')))]


def _windows(stamps):
    return [(stamp + window[0], stamp + window[1], colour) for stamp in stamps
            for window, colour in ((L_WINDOW, L_COLOUR), (U_WINDOW, U_COLOUR))]


def commands(runs: list[Run], axis: TimeAxis) -> list[Chart]:
    """Plot tilt and thrust commands of each run."""
    made = []
    for number, run in enumerate(runs):
        log, name = run.log, f'{run.label}: ' if len(runs) > 1 else ''
        for label, values in (('tilt command [rad]', log.command_tilt),
                              ('thrust command [N]', log.command_thrust)):
            sampled = axis.sampled(run, log.command_t, values)
            made.append(Chart(name + label, [
                Series(str(k + 1), PARTS[k], sampled[:, k], number) for k in range(4)],
                wide=False))
    return made


def compute(runs: list[Run], axis: TimeAxis) -> list[Chart]:
    """Plot the CPU time of the controllers' steps since their start, and the period."""
    series = []
    for number, run in enumerate(runs):
        for label, name in _controllers(run):
            history = run.log.compute_history[name]
            t = np.array([entry[0] for entry in history])
            for key, style in (('max', 'dot'), ('p99', 'dash'), ('median', 'line')):
                values = np.array([entry[1][key] for entry in history], dtype=float)
                series.append(Series(f'{label}, {key}', run.colour, axis.sampled(run, t, values),
                                     number, style))
    if not series:
        return []
    return [Chart('CPU time of a step [ms]', series, log=(False, True),
                  level=[(PERIOD, 'period')])]


def _controllers(run):
    """(label, name) of each controller of a run with compute times."""
    names = [name for name in run.log.controllers() if run.log.compute_history.get(name)]
    return [(run.label if len(names) == 1 else f'{run.label}: {name}', name) for name in names]


def estimate(runs: list[Run], axis: TimeAxis) -> list[Chart]:
    """Plot the error of the estimate, if the truth was recorded."""
    places, angles = [], []
    for number, run in enumerate(runs):
        if not (len(run.log.truth_t) and len(run.log.odom_t)):
            continue
        t, distance, angle = estimate_errors(run.log)
        for made, values in ((places, MILLI * distance), (angles, angle)):
            made.append(Series(run.label, run.colour, axis.sampled(run, t, values), number))
    return [Chart(label, series, wide=False) for label, series in
            (('position [mm]', places), ('orientation [deg]', angles)) if series]


def battery(runs: list[Run], axis: TimeAxis) -> list[Chart]:
    """Plot pack voltage and current."""
    known = [(number, run) for number, run in enumerate(runs) if len(run.log.battery_t)]
    return [Chart(label, [Series(run.label, run.colour, axis.sampled(
        run, run.log.battery_t, sign * getattr(run.log, name)), number) for number, run in known],
        wide=False)
        for label, name, sign in (('voltage [V]', 'battery_voltage', 1.0),
                                  ('current drawn [A]', 'battery_current', -1.0)) if known]


def payload(runs: list[Run], axis: TimeAxis) -> list[Chart]:
    """Plot the height error while payloads are attached."""
    known = [(number, run) for number, run in enumerate(runs)
             if run.task and run.task.kind == 'payload' and run.log.targets]
    if not known:
        return []
    begins = np.concatenate([[0.0], known[0][1].task.ends[:-1]])
    return [Chart('height error [m]', [
        Series(run.label, run.colour, axis.sampled(
            run, run.body.t, run.body.position[:, 2] - run.log.targets[0].at(
                run.start).position[2]), number) for number, run in known],
        upright=[(float(begin), f'{segment.payload:g} kg') for begin, segment in
                 zip(begins, known[0][1].task.segments, strict=True)])]


def errors_of_a_pose(runs: list[Run]) -> list[Chart]:
    """Plot median and 10 to 90 % band of the errors in the 8 s of a pose, over all poses."""
    grid = np.arange(0.0, POSE_DURATION, 0.02)
    folded = [(number, run, stacks) for number, run in enumerate(runs)
              if (stacks := _folded(run, grid)) is not None]
    made = []
    for k, (name, unit) in enumerate((('position error', 'm'), ('orientation error', 'deg'))):
        series = []
        for number, run, stacks in folded:
            low, middle, high = np.maximum(np.percentile(stacks[k], (10, 50, 90), axis=0),
                                           TINY[unit])
            series += [Series(f'{run.label}, 10 %', run.colour, low, number, 'dot'),
                       Series('90 %', run.colour, high, number, 'dot', band=True),
                       Series('median', run.colour, middle, number)]
        if series:
            made.append(Chart(f'{name} [{unit}]', series, grid, 'time since the pose [s]',
                              (False, True), wide=False, windows=[
                                  (*L_WINDOW, L_COLOUR), (*U_WINDOW, U_COLOUR)]))
    return made


def _folded(run, grid):
    body, stacks = run.body, ([], [])
    for target in run.log.targets:
        if not isinstance(target, PoseTarget) or \
                not body.covers(target.stamp, target.stamp + U_WINDOW[1]):
            continue
        window = body.window(target.stamp, target.stamp + POSE_DURATION)
        for stack, values in zip(stacks, errors(body, target, window), strict=True):
            stack.append(np.interp(grid, body.t[window] - target.stamp, values))
    return [np.array(stack) for stack in stacks] if len(stacks[0]) >= FEW else None


def steady_errors(runs: list[Run]) -> list[Chart]:
    """Plot the cumulative distribution of the poses' U errors."""
    made = []
    for key, limit, title in (('U_position_m', REACHED_POSITION, 'U position error [m]'),
                              ('U_orientation_deg', REACHED_ORIENTATION,
                               'U orientation error [deg]')):
        known = [(number, run, label, values, len(result['poses']))
                 for number, run in enumerate(runs) for label, result in run.results.items()
                 if len(values := np.sort([pose[key] for pose in result['poses']
                                           if pose[key] is not None])) >= FEW]
        if not known:
            continue
        every = np.concatenate([values for *_, values, _ in known])
        x = np.geomspace(max(every.min(), 1e-6) * 0.8, max(every.max(), limit) * 1.25, SHARES)
        made.append(Chart('share of the poses', [
            Series(label, run.colour, np.searchsorted(values, x, side='right') / count, number,
                   'step') for number, run, label, values, count in known],
            x, title, (True, False), [(limit, 'reached below')], wide=False))
    return made


def use(runs: list[Run], robot: RobotParameters) -> list[Chart]:
    """Plot histograms of joint angles, rates, thrusts and joint errors, with their limits."""
    joints, rotors = robot.joints, robot.rotors
    limits = ((-joints.position_limit, joints.position_limit),
              (-joints.velocity_limit, joints.velocity_limit),
              (rotors.thrust_min, rotors.thrust_max), ())
    titles = ('tilt angle [rad]', 'tilt rate [rad/s]', 'thrust command [N]', '|q* - q| [rad]')
    used = [_actuator_use(run) for run in runs]
    return [chart for title, limit, column in zip(titles, limits, zip(*used, strict=True),
                                                  strict=True)
            for chart in _histograms(runs, column, title, limit)]


def _actuator_use(run):
    log = run.log
    flown = [(run.start, log.end)]
    joint, command = inside(log.joint_t, flown), inside(log.command_t, flown)
    error = np.zeros(0)
    if np.any(joint) and len(log.command_t):
        error = np.abs(hold(log.command_t, log.command_tilt, log.joint_t[joint])
                       - log.joint_position[joint])
    return (log.joint_position[joint].ravel(), log.joint_velocity[joint].ravel(),
            log.command_thrust[command].ravel(), error.ravel())


def _histograms(runs, columns, title, limit):
    """Histograms of all runs in the same bins."""
    columns = [values[np.abs(values) < ABSURD] for values in columns]
    every = np.concatenate(columns)
    if not every.size:
        return []
    low, high = every.min(), every.max()
    spare = 0.5 if high - low < NARROW else 0.0
    edges = np.linspace(low - spare, high + spare, BINS + 1)
    series = []
    for number, (run, values) in enumerate(zip(runs, columns, strict=True)):
        share = np.histogram(values, bins=edges)[0] / max(1, values.size)
        series.append(Series(run.label, run.colour, np.append(share, share[-1]), number, 'step'))
    return [Chart('share of the time', series, edges, title, (False, True),
                  [(value, '') for value in limit], wide=False)]


def disturbance(runs: list[Run]) -> list[Chart]:
    """Plot peak errors over the disturbance level, for force and torque tasks."""
    made = []
    for kind, unit in (('force', 'N'), ('torque', 'N_m')):
        known = [(number, run, label, result[kind]['levels']) for number, run in enumerate(runs)
                 for label, result in run.results.items() if result.get(kind, {}).get('levels')]
        x = np.array(sorted({entry[f'level_{unit}'] for *_, levels in known for entry in levels}))
        if not len(x):
            continue
        for key, title in (('peak_position_m', 'peak position error [m]'),
                           ('peak_orientation_deg', 'peak orientation error [deg]')):
            series = []
            for number, run, label, levels in known:
                for name, style, wanted in ((label, 'points', False),
                                            (f'{label}: control lost', 'points', True)):
                    y = np.full(len(x), np.nan)
                    for entry in levels:
                        if entry['lost'] >= wanted and entry[key] is not None:
                            y[np.searchsorted(x, entry[f'level_{unit}'])] = entry[key]
                    if np.isfinite(y).any():
                        series.append(Series(name, '#22272e' if wanted else run.colour, y, number,
                                             style))
            if series:
                made.append(Chart(title, series, x, f"{kind} [{unit.replace('_', ' ')}]",
                                  wide=False))
    return made
