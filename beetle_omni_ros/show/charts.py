"""Interactive charts of flights over time."""

from dataclasses import dataclass
import json

import numpy as np
import plotly.graph_objects as go
from plotly.offline import get_plotlyjs
from plotly.subplots import make_subplots

from beetle_omni_ros.bags import log as flights
from beetle_omni_ros.bags.metrics import L_WINDOW, U_WINDOW
from beetle_omni_ros.control.base import PoseTarget
from beetle_omni_ros.model.schema import ParameterError, shortened
from beetle_omni_ros.show.figures import BLUE, COLOURS, FAINT, GREY, INK, PARTS, RED, VIOLET
from beetle_omni_ros.show.page import rendered

MAX_RUNS = len(COLOURS)     # each run has its own colour
BINS = 400              # of the visible part of a line; of each, the extremes are drawn
MOST = 24000            # samples of a line in the page, two minutes at 200 Hz; extremes are kept
STALE = 0.3             # [s] without a newer value at which a line is interrupted
TRAJECTORY_STEP = 0.05  # [s] between the drawn poses of a trajectory
FEW_POSES = 20          # up to this number, L and U windows are shaded
MOST_MARKS = 12         # of faults in a chart, and states in a strip
TINY = {'m': 1e-4, 'deg': 1e-2}     # floor of logarithmic errors
L_COLOUR, U_COLOUR, GRID = '#eef1f5', '#cfe3d4', '#e6e9ed'
# Colour -> the one on a dark page.
NIGHT = {INK: '#dde2e8', L_COLOUR: '#252c35', U_COLOUR: '#254232', GRID: '#343b44',
         BLUE: '#5d9fe8', RED: '#f0665c', VIOLET: '#ab86d3', GREY: '#98a3af'}
AXES = ('x [m]', 'y [m]', 'z [m]', 'roll [deg]', 'pitch [deg]', 'yaw [deg]')
STATE_COLOURS = {'flying': '#9cc7a8', 'takeoff': '#b9cfe6', 'landing': '#f0d29a',
                 'fallback': '#efb08a', 'emergency_stop': '#d9534f'}
ROW, STRIP = 130, 40    # [px] height of a chart, and of a state


@dataclass(frozen=True)
class Run:
    """One flight of a report."""

    label: str      # name of its lines
    colour: str
    log: flights.FlightLog
    results: dict[str, dict]        # label -> metrics, for each controller that flew

    def line(self, t: np.ndarray, values: np.ndarray, name: str = '', **style) -> go.Scatter:
        """Return a line through values (N,) at times (N,) [s] of the flight's clock."""
        steps = np.diff(t)
        gaps = np.flatnonzero(steps > max(STALE, 3 * np.median(steps))) + 1 if len(steps) else []
        t, values = _thinned(np.insert(t, gaps, t[gaps]) - self.log.begin, np.insert(
            np.asarray(values, dtype=float), gaps, np.nan))
        return go.Scatter(x=t.astype('f4'), y=values.astype('f4'), legendgroup=self.label,
                          name=f'{self.label}, {name}' if name else self.label, mode='lines',
                          line={'color': self.colour, 'width': 1.3, **style})


def figure(runs: list[Run], *names: str) -> go.Figure:
    """Return all charts below each other, or those whose titles begin with a name."""
    charts = [chart for chart in _charts(runs) if not names or chart[0].startswith(names)]
    if not charts:
        raise ParameterError(f"charts {', '.join(names)}: expected the begin of one of "
                             + ', '.join(label for label, _ in _charts(runs)))
    figure = make_subplots(
        len(charts), 1, shared_xaxes=True, vertical_spacing=0.25 / len(charts),
        row_heights=[STRIP * len(runs) if traces[0].type == 'bar' else ROW
                     for _, traces in charts],
        subplot_titles=[label for label, _ in charts])
    named: set[str] = set()
    for row, (label, traces) in enumerate(charts, 1):
        for trace in traces:
            trace.showlegend = trace.legendgroup not in named
            named.add(trace.legendgroup)
            figure.add_trace(trace, row, 1)
        of_target = label.startswith(('position error', 'orientation error'))
        if of_target:
            _mark(figure, runs, row)
        figure.update_yaxes(type='log' if of_target or label.startswith('CPU') else '-',
                            row=row, col=1, zeroline=False, exponentformat='power')
    figure.update_xaxes(gridcolor=GRID, zeroline=False)
    figure.update_yaxes(gridcolor=GRID)
    figure.update_xaxes(title='time since the first target [s]', row=len(charts), col=1)
    figure.update_annotations(font={'size': 12, 'color': INK})
    figure.update_layout(
        height=(ROW + 45) * len(charts) + STRIP * len(runs), font={'size': 11, 'color': INK},
        margin={'l': 50, 'r': 10, 't': 50, 'b': 40}, plot_bgcolor='#ffffff', barmode='overlay',
        legend={'orientation': 'h', 'y': 1, 'yanchor': 'top', 'yref': 'container'},
        hovermode='x', dragmode='zoom')
    return figure


def html(runs: list[Run]) -> str:
    """Return the charts as HTML."""
    found, times = json.loads(figure(runs).to_json()), {}
    for trace in found['data']:     # lines of one clock share its times; a target has float64
        if isinstance(trace['x'], dict) and trace['x']['dtype'] == 'f4':
            trace['x'] = times.setdefault(trace['x']['bdata'], len(times))
    return rendered('charts.html', plotly=get_plotlyjs(), figure={**found, 'times': list(times)},
                    bins=BINS, night=NIGHT)


def _mark(figure, runs, row):
    """Shade the windows of the first run's poses, and draw the faults of all runs."""
    first = runs[0].log
    stamps = [t.stamp - first.begin for t in first.targets if isinstance(t, PoseTarget)]
    x, y = figure.data[-1].xaxis, figure.data[-1].yaxis
    figure.layout.shapes += tuple(      # add_vrect takes tenths of a second for each
        {'type': 'rect', 'xref': x, 'x0': stamp + begin, 'x1': stamp + end, 'layer': 'below',
         'yref': f'{y} domain', 'y0': 0, 'y1': 1, 'fillcolor': colour, 'line': {'width': 0}}
        for stamp in (stamps if len(stamps) <= FEW_POSES else ())
        for (begin, end), colour in ((L_WINDOW, L_COLOUR), (U_WINDOW, U_COLOUR)))
    faults = [(at - run.log.begin, name) for run in runs
              for name, at in run.log.named_faults().items()]
    for at, name in faults[:MOST_MARKS]:
        figure.add_vline(at, line={'color': FAINT, 'dash': 'dash', 'width': 1}, row=row, col=1,
                         annotation_text=shortened(name))


def _thinned(t, values):
    """About MOST samples of a series: minimum, maximum and a gap of each bin."""
    if len(t) <= MOST:
        return t, values
    missing = np.isnan(values)
    extremes = missing, -np.where(missing, np.inf, values), np.where(missing, -np.inf, values)
    index = sorted({part[0] + of[part].argmax() for of in extremes
                    for part in np.array_split(np.arange(len(t)), MOST // 2)})
    return t[index], values[index]


def _charts(runs):
    """(label, lines or bars) of each chart that has data."""
    away = [(run, flights.target_errors(run.log)) for run in runs]
    made = [(f'{name} error [{unit}]', [run.line(found[0], np.maximum(found[k], TINY[unit]))
                                        for run, found in away if len(found[0])])
            for k, name, unit in ((1, 'position', 'm'), (2, 'orientation', 'deg'))]
    made.append(('state of the supervisor', [_states(run) for run in runs if run.log.states]))
    made += _poses(runs)
    for kind in ('tilt command [rad]', 'thrust command [N]'):
        for run in runs:
            values = getattr(run.log.command, kind.partition(' ')[0])
            made.append((f'{run.label}: {kind}' if len(runs) > 1 else kind, [
                run.line(run.log.command.t, values[:, k], str(k + 1), color=PARTS[k], width=1)
                for k in range(4) if len(values)]))
    made.append(('CPU time of a step: median, 99 %, largest [ms]', [
        run.line(*np.array([(t, report[key]) for t, report in history], dtype=float).T,
                 f'{name}, {key}', dash=dash)
        for run in runs for name, history in run.log.compute_history.items()
        if name in run.log.controllers()
        for key, dash in (('max', 'dot'), ('p99', 'dash'), ('median', 'solid'))]))
    estimates = [(run, flights.estimate_errors(run.log)) for run in runs]
    made += [(f'error of the estimated {name}', [run.line(found[0], scale * found[k])
                                                 for run, found in estimates if len(found[0])])
             for k, name, scale in ((1, 'position [mm]', 1e3), (2, 'orientation [deg]', 1.0))]
    made += [(label, [run.line(run.log.battery.t, sign * getattr(run.log.battery, name))
                      for run in runs if len(run.log.battery)])
             for name, sign, label in (('voltage', 1, 'voltage [V]'),
                                       ('current', -1, 'current drawn [A]'))]
    return [(label, traces) for label, traces in made if traces]


def _poses(runs):
    """Position and angles of every run and its target; angles within 180 deg of it."""
    made: list[tuple[str, list]] = [(label, []) for label in AXES]
    tasks: list[object] = []
    for run in runs:
        body, log = flights.motion(run.log), run.log
        flown = np.hstack([body.position, flights.roll_pitch_yaw(body.quaternion)])
        if log.targets:
            t, wanted = _wanted(run)
            near = flights.hold(t, wanted, body.t)[:, 3:]
            flown[:, 3:] = near + (flown[:, 3:] - near + 180) % 360 - 180
            if log.meta.get('task') not in tasks:
                tasks.append(log.meta.get('task'))
                for k, (_, traces) in enumerate(made):
                    traces.append(go.Scatter(
                        x=t - run.log.begin, y=wanted[:, k], name='target', legendgroup='target',
                        line={'color': INK, 'width': 1, 'dash': 'dash', 'shape': 'hv'}))
        for k, (_, traces) in enumerate(made):
            traces.append(run.line(body.t, flown[:, k]))
    return made


def _wanted(run):
    """Times (n,) [s] and position [m] and angles [deg] (n, 6) of the targets."""
    times = [np.array([target.stamp, end]) if isinstance(target, PoseTarget) else
             np.arange(target.times[0], min(end, target.times[-1]), TRAJECTORY_STEP)
             for target, end in flights.spans(run.log)]
    poses = [flights.reference_poses(target, t)
             for (target, _), t in zip(flights.spans(run.log), times)]
    return np.concatenate(times), np.concatenate(
        [np.hstack([position, flights.roll_pitch_yaw(quaternion)])
         for position, quaternion in poses])


def _states(run):
    """Bar of the states over time."""
    changes = [k for k, state in enumerate(run.log.states)
               if k == 0 or run.log.states[k - 1] != state][:MOST_MARKS]
    begins = run.log.state_t[changes]
    modes = [run.log.states[k] for k in changes]
    names = [shortened(mode) for mode in modes]
    return go.Bar(
        base=begins - run.log.begin, x=np.diff(begins, append=run.log.end),
        y=[run.label] * len(names), orientation='h', text=names, hovertext=names,
        textposition='inside', insidetextanchor='start', legendgroup=run.label, name=run.label,
        marker={'color': [STATE_COLOURS.get(mode.state, '#dfe3e8')
                          for mode in modes]})
