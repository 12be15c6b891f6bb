"""Interactive charts of flights."""

from dataclasses import dataclass, field

import numpy as np
import plotly.graph_objects as go
from plotly.offline import get_plotlyjs
from plotly.subplots import make_subplots

from beetle_omni_ros.control.base import PoseTarget
from beetle_omni_ros.pages.figures import COLOURS, FAINT, INK, PARTS
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.robot.schema import shortened
from beetle_omni_ros.runs.log import (
    errors,
    estimate_errors,
    FlightLog,
    hold,
    motion,
    reference_poses,
    roll_pitch_yaw,
)
from beetle_omni_ros.runs.metrics import L_WINDOW, REACHED_ORIENTATION, REACHED_POSITION, U_WINDOW
from beetle_omni_ros.runs.tasks import POSE_DURATION, Task

POINTS = 800            # of a line; extremes are kept
STALE = 0.3             # [s] without a newer value at which a line is interrupted
TRAJECTORY_STEP = 0.05  # [s] between the drawn poses of a trajectory
FEW_POSES = 20          # up to this number, L and U windows are shaded
MOST_MARKS = 12         # of faults in a chart, and states in a strip
FEW = 3                 # poses below which no distribution is shown
MILLI = 1e3
TINY = {'m': 1e-4, 'deg': 1e-2}     # floor of logarithmic errors
L_COLOUR, U_COLOUR = '#eef1f5', '#cfe3d4'
AXES = ('x [m]', 'y [m]', 'z [m]', 'roll [deg]', 'pitch [deg]', 'yaw [deg]')
ABSURD = 1e6            # [rad, rad/s, N] values that are left out of histograms
BINS = 60
STATE_COLOURS = {'flying': '#9cc7a8', 'takeoff': '#b9cfe6', 'landing': '#f0d29a',
                 'fallback': '#efb08a', 'emergency_stop': '#d9534f'}
ROW, STRIP = 130, 40    # [px] height of a chart, and of a state


@dataclass(frozen=True)
class Run:
    """
    One flight of a report.

    Attributes:
        label, colour: name and colour of its lines.
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

    def line(self, t: np.ndarray, values: np.ndarray, **style) -> go.Scatter:
        """Return a line through values (N,) at times (N,) [s] of the flight's clock."""
        t, values = thinned(*_interrupted(t - self.start, values))
        return _scatter(self, t, values, **style)


@dataclass(frozen=True)
class Panel:
    """
    A chart.

    Attributes:
        label: label of the vertical axis, with its unit.
        traces: lines or bars.
        xlabel: label of the horizontal axis.
        log: whether the (horizontal, vertical) axis is logarithmic.
        marks: (x, text) of vertical lines; no text on a logarithmic axis.
        windows: (from, to, colour) of shaded ranges of the horizontal axis.
        height: [px].

    """

    label: str
    traces: list
    xlabel: str = ''
    log: tuple[bool, bool] = (False, False)
    marks: list[tuple[float, str]] = field(default_factory=list)
    windows: list[tuple[float, float, str]] = field(default_factory=list)
    height: float = ROW


def html(panels: list[Panel]) -> str:
    """Return charts below each other as HTML; they have one horizontal axis and one legend."""
    figure = make_subplots(len(panels), 1, shared_xaxes=True, vertical_spacing=0.25 / len(panels),
                           row_heights=[panel.height for panel in panels],
                           subplot_titles=[panel.label for panel in panels])
    named: set[str] = set()
    for row, panel in enumerate(panels, 1):
        for trace in panel.traces:
            trace.showlegend = bool(trace.legendgroup) and trace.legendgroup not in named
            named.add(trace.legendgroup)
            figure.add_trace(trace, row, 1)
        for begin, end, colour in panel.windows:
            figure.add_vrect(begin, end, fillcolor=colour, line_width=0, layer='below', row=row,
                             col=1)
        for x, text in panel.marks:
            note = {'annotation_text': text} if text else {}
            figure.add_vline(x, line={'color': FAINT, 'dash': 'dash', 'width': 1}, row=row, col=1,
                             **note)
        kinds = ['log' if wanted else '-' for wanted in panel.log]
        figure.update_xaxes(type=kinds[0], row=row, col=1, gridcolor='#e6e9ed')
        figure.update_yaxes(type=kinds[1], row=row, col=1, gridcolor='#e6e9ed', zeroline=False,
                            exponentformat='power')
    figure.update_xaxes(title=panels[-1].xlabel, row=len(panels), col=1)
    figure.update_annotations(font={'size': 12, 'color': INK})
    figure.update_layout(
        height=sum(panel.height + 45 for panel in panels) + 40, font={'size': 11, 'color': INK},
        margin={'l': 50, 'r': 10, 't': 50, 'b': 40}, plot_bgcolor='#ffffff', barmode='overlay',
        legend={'orientation': 'h', 'y': 1, 'yanchor': 'top', 'yref': 'container'},
        hovermode='x unified' if len(panels) == 1 else 'x', dragmode='zoom')
    return figure.to_html(full_html=False, include_plotlyjs=False,
                          config={'responsive': True, 'displaylogo': False})


def library() -> str:
    """Return the library of a page with charts as HTML."""
    return f'<script>{get_plotlyjs()}</script>'


def thinned(t: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return about POINTS samples of a series: minimum, maximum and a gap of each bin."""
    if len(t) <= POINTS:
        return t, values
    kept: set[int] = set()
    for part in np.array_split(np.arange(len(t)), POINTS // 2):
        known = part[np.isfinite(values[part])]
        kept.update(part[~np.isfinite(values[part])][:1])
        if len(known):
            kept.update((known[values[known].argmin()], known[values[known].argmax()]))
    index = sorted(kept)
    return t[index], values[index]


def _interrupted(t, values):
    """Series with NaN in its gaps."""
    steps = np.diff(t)
    gaps = np.flatnonzero(steps > max(STALE, 3 * np.median(steps))) + 1 if len(steps) else []
    return np.insert(t, gaps, t[gaps]), np.insert(np.asarray(values, dtype=float), gaps, np.nan)


def _scatter(run, x, y, *, name='', **style):
    style.setdefault('line', {'color': run.colour, 'width': 1.3})
    style.setdefault('mode', 'lines')
    return go.Scatter(x=x.astype('f4'), y=y.astype('f4'), legendgroup=run.label, name=', '.join(
        filter(None, (run.label, name))), **style)


def flight(runs: list[Run]) -> list[Panel]:
    """Charts over the time of the flight, without those that have no data."""
    faults = [(at - run.start, shortened(name)) for run in runs
              for name, at in run.log.named_faults().items()][:MOST_MARKS]
    stamps = [t.stamp - runs[0].start for t in runs[0].log.targets if isinstance(t, PoseTarget)]
    windows = [(stamp + begin, stamp + end, colour) for stamp in stamps
               for (begin, end), colour in ((L_WINDOW, L_COLOUR), (U_WINDOW, U_COLOUR))
               ] if len(stamps) <= FEW_POSES else []
    made = [Panel(label, [run.line(t, np.maximum(both[k], TINY[unit])) for run, (t, *both)
                          in zip(runs, map(_errors, runs), strict=True) if len(t)],
                  log=(False, True), windows=windows, marks=faults)
            for k, (label, unit) in enumerate((('position error [m]', 'm'),
                                               ('orientation error [deg]', 'deg')))]
    made.append(Panel('state of the supervisor', [_states(run) for run in runs if run.log.states],
                      height=STRIP * len(runs)))
    made += _poses(runs)
    for number, kind in enumerate(('tilt command [rad]', 'thrust command [N]')):
        for run in runs:
            values = (run.log.command_tilt, run.log.command_thrust)[number]
            made.append(Panel(f'{run.label}: {kind}' if len(runs) > 1 else kind, [
                run.line(run.log.command_t, values[:, k], name=str(k + 1),
                         line={'color': PARTS[k], 'width': 1})
                for k in range(4) if len(run.log.command_t)]))
    made.append(Panel('CPU time of a step: median, 99 %, largest [ms]', [
        run.line(*np.array([(t, report[key]) for t, report in history], dtype=float).T,
                 name=f'{name}, {key}', line={'color': run.colour, 'width': 1.3, 'dash': dash})
        for run in runs for name, history in run.log.compute_history.items()
        if name in run.log.controllers()
        for key, dash in (('max', 'dot'), ('p99', 'dash'), ('median', 'solid'))],
        log=(False, True)))
    estimates = [(run, estimate_errors(run.log)) for run in runs]
    for k, label, scale in ((1, 'error of the estimated position [mm]', MILLI),
                            (2, 'error of the estimated orientation [deg]', 1.0)):
        made.append(Panel(label, [run.line(found[0], scale * found[k])
                                  for run, found in estimates if len(found[0])]))
    for name, sign, label in (('voltage', 1, 'voltage [V]'), ('current', -1, 'current drawn [A]')):
        made.append(Panel(label, [
            run.line(run.log.battery_t, sign * getattr(run.log, f'battery_{name}'))
            for run in runs if len(run.log.battery_t)], 'time since the first target [s]'))
    return [panel for panel in made if panel.traces]


def _spans(run):
    """(target, its end [s]) of each target."""
    targets = run.log.targets
    return zip(targets, [t.stamp for t in targets[1:]] + [run.log.end])


def _errors(run):
    """(n,) times [s], (n,) position errors [m], (n,) orientation errors [deg]."""
    body, parts = motion(run.log), [np.zeros((3, 0))]
    for target, end in _spans(run):
        window = body.window(target.stamp, end - 1e-3)
        parts.append(np.array([body.t[window], *errors(body, target, window)]))
    return np.concatenate(parts, axis=1)


def _poses(runs):
    """Position and angles of every run and its target; angles within 180 deg of it."""
    made: list[Panel] = [Panel(label, []) for label in AXES]
    tasks: list[object] = []
    for run in runs:
        body, log = motion(run.log), run.log
        flown = np.hstack([body.position, roll_pitch_yaw(body.quaternion)])
        if log.targets:
            t, wanted = _wanted(run)
            near = hold(t, wanted, body.t)[:, 3:]
            flown[:, 3:] = near + (flown[:, 3:] - near + 180) % 360 - 180
            if log.meta.get('task') not in tasks:
                tasks.append(log.meta.get('task'))
                for k, panel in enumerate(made):
                    panel.traces.append(go.Scatter(
                        x=t - run.start, y=wanted[:, k], name='target', legendgroup='target',
                        line={'color': INK, 'width': 1, 'dash': 'dash', 'shape': 'hv'}))
        for k, panel in enumerate(made):
            panel.traces.append(run.line(body.t, flown[:, k]))
    return made


def _wanted(run):
    """Times (n,) [s] and position [m] and angles [deg] (n, 6) of the targets."""
    times = [np.array([target.stamp, end]) if isinstance(target, PoseTarget) else
             np.arange(target.times[0], min(end, target.times[-1]), TRAJECTORY_STEP)
             for target, end in _spans(run)]
    poses = [reference_poses(target, t) for (target, _), t in zip(_spans(run), times)]
    return np.concatenate(times), np.concatenate(
        [np.hstack([position, roll_pitch_yaw(quaternion)]) for position, quaternion in poses])


def _states(run):
    """Bar of the states over time."""
    changes = [k for k, state in enumerate(run.log.states)
               if k == 0 or run.log.states[k - 1] != state][:MOST_MARKS]
    begins = run.log.state_t[changes]
    names = [shortened(run.log.states[k]) for k in changes]
    return go.Bar(
        base=begins - run.start, x=np.diff(begins, append=run.log.end), y=[run.label] * len(names),
        orientation='h', text=names, hovertext=names, textposition='inside',
        insidetextanchor='start', legendgroup=run.label, name=run.label, marker={
            'color': [STATE_COLOURS.get(name.partition(':')[0], '#dfe3e8') for name in names]})


def distributions(runs: list[Run], robot: RobotParameters) -> list[tuple[str, str, list[Panel]]]:
    """Title, text and charts of each group of charts that have no common axis."""
    return [
        ('Errors of a pose', 'Median and 10 to 90 % band over all poses of a run.',
         errors_of_a_pose(runs)),
        ('Steady errors', 'Share of the poses with a U error below the value.',
         steady_errors(runs)),
        ('Disturbance', 'Largest error at each level; black: control was lost.',
         disturbance(runs)),
        ('Joint and thrust use', 'Share of the flight at each value; dashed: limits.',
         use(runs, robot))]


def errors_of_a_pose(runs: list[Run]) -> list[Panel]:
    """Median and 10 to 90 % band of the errors in the 8 s of a pose, over all poses."""
    grid, made = np.arange(0.0, POSE_DURATION, 0.02), []
    folded = [(run, stacks) for run in runs if len((stacks := _folded(run, grid))[0]) >= FEW]
    for k, (name, unit) in enumerate((('position error', 'm'), ('orientation error', 'deg'))):
        traces = []
        for run, stacks in folded:
            low, middle, high = np.maximum(np.percentile(stacks[k], (10, 50, 90), axis=0),
                                           TINY[unit])
            thin = {'color': run.colour, 'width': 0.3}
            traces += [_scatter(run, grid, middle, name='median'),
                       _scatter(run, grid, low, name='10 %', line=thin),
                       _scatter(run, grid, high, name='90 %', line=thin, fill='tonexty')]
        made.append(Panel(f'{name} [{unit}]', traces, 'time since the pose [s]', (False, True),
                          windows=[(*L_WINDOW, L_COLOUR), (*U_WINDOW, U_COLOUR)]))
    return made if folded else []


def _folded(run, grid):
    body, stacks = motion(run.log), ([], [])
    for target in run.log.targets:
        if isinstance(target, PoseTarget) and body.covers(target.stamp,
                                                          target.stamp + U_WINDOW[1]):
            window = body.window(target.stamp, target.stamp + POSE_DURATION)
            for stack, values in zip(stacks, errors(body, target, window), strict=True):
                stack.append(np.interp(grid, body.t[window] - target.stamp, values))
    return stacks


def steady_errors(runs: list[Run]) -> list[Panel]:
    """Cumulative distribution of the poses' U errors."""
    made = []
    for key, limit, label in (
            ('U_position_m', REACHED_POSITION, 'U position error [m], reached: dashed'),
            ('U_orientation_deg', REACHED_ORIENTATION, 'U orientation error [deg]')):
        traces = []
        for run in runs:
            for result in run.results.values():
                values = np.sort([pose[key] for pose in result['poses'] if pose[key] is not None])
                if len(values) >= FEW:
                    share = np.arange(1, len(values) + 1) / len(result['poses'])
                    traces.append(_scatter(run, values, share, line={
                        'color': run.colour, 'width': 1.3, 'shape': 'hv'}))
        if traces:
            made.append(Panel('share of the poses', traces, label, (True, False),
                              marks=[(limit, '')]))
    return made


def use(runs: list[Run], robot: RobotParameters) -> list[Panel]:
    """Histograms of joint angles, rates, thrusts and joint errors, with their limits."""
    joints, rotors = robot.joints, robot.rotors
    limits = (joints.position_limit * np.array([-1, 1]), joints.velocity_limit * np.array([-1, 1]),
              (rotors.thrust_min, rotors.thrust_max), ())
    titles = ('tilt angle [rad]', 'tilt rate [rad/s]', 'thrust command [N]', '|q* - q| [rad]')
    used = [_actuator_use(run.log) for run in runs]
    made = []
    for k, (title, limit) in enumerate(zip(titles, limits, strict=True)):
        columns = [column[k][np.abs(column[k]) < ABSURD] for column in used]
        if not sum(map(len, columns)):
            continue
        edges = np.histogram_bin_edges(np.concatenate(columns), BINS)
        made.append(Panel('share of the time', [
            _scatter(run, edges[:-1], np.histogram(values, edges)[0] / max(1, len(values)),
                     line={'color': run.colour, 'width': 1.3, 'shape': 'hv'})
            for run, values in zip(runs, columns, strict=True)],
            title, (False, True), [(value, '') for value in limit]))
    return made


def _actuator_use(log):
    error = np.abs(hold(log.command_t, log.command_tilt, log.joint_t) - log.joint_position) \
        if len(log.joint_t) and len(log.command_t) else np.zeros(0)
    return (log.joint_position.ravel(), log.joint_velocity.ravel(), log.command_thrust.ravel(),
            error.ravel())


def disturbance(runs: list[Run]) -> list[Panel]:
    """Peak errors over the level of the disturbance, for force and torque tasks."""
    made = []
    for kind, unit in (('force', 'N'), ('torque', 'N_m')):
        known = [(run, result[kind]['levels']) for run in runs
                 for result in run.results.values() if result.get(kind, {}).get('levels')]
        for key, label in (('peak_position_m', 'peak position error [m]'),
                           ('peak_orientation_deg', 'peak orientation error [deg]')):
            traces = []
            for run, every in known:
                levels = [level for level in every if level[key] is not None]
                traces.append(_scatter(
                    run, np.array([level[f'level_{unit}'] for level in levels], dtype=float),
                    np.array([level[key] for level in levels], dtype=float), mode='lines+markers',
                    marker={'color': [INK if level['lost'] else run.colour for level in levels]}))
            if traces:
                made.append(Panel(label, traces, f"{kind} [{unit.replace('_', ' ')}]"))
    return made


MAX_RUNS = len(COLOURS)     # each run has its own colour
