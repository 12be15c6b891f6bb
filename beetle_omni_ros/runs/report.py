"""`beetle_omni report`: a self-contained HTML page with several runs side by side."""

from collections.abc import Callable
from html import escape
from pathlib import Path
import sys

import numpy as np
from rich.console import Console

from beetle_omni_ros import __version__
from beetle_omni_ros.pages.figures import COLOURS
from beetle_omni_ros.pages.page import frame, Grid, html, section, Terminal
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.robot.schema import ParameterError, shortened
from beetle_omni_ros.runs import charts, table
from beetle_omni_ros.runs.bag import no_pose, read_bag, runs_in
from beetle_omni_ros.runs.charts import Run, target_poses, TimeAxis
from beetle_omni_ros.runs.files import write_json, write_text
from beetle_omni_ros.runs.log import FlightLog, motion
from beetle_omni_ros.runs.metrics import metrics_by_controller, task_of

MAX_RUNS = len(COLOURS)  # each run has its own colour
MOST_ROWS = 40      # of states, faults and warnings
DISC_RADIUS = 0.4   # of the distance between neighbouring rotors
BALL = 0.29         # [m] height of the end-effector if the robot file has none
SPEEDS = (0.1, 0.25, 0.5, 1, 2, 4, 8)
VIEWS = (('angle', 'Angle'), ('top', 'Top'), ('side', 'Side'), ('front', 'Front'))
STATE_COLOURS = {'flying': '#9cc7a8', 'takeoff': '#b9cfe6', 'landing': '#f0d29a',
                 'fallback': '#efb08a', 'emergency_stop': '#d9534f', 'disarmed': '#dfe3e8'}


def run_report(paths: list[Path], output: Path, *, json_path: Path | None = None,
               console: Console | None = None) -> dict:
    """
    Read runs, print their result table and write the page.

    ``paths`` are bags, or folders of bags.

    Returns:
        The results: ``meta`` and one key for each run and controller.

    Raises:
        BagError: a run cannot be read.
        ParameterError: too many runs, or the page cannot be written.

    """
    console = console or Terminal()
    paths = runs_in(paths)
    if len(paths) > MAX_RUNS:
        raise ParameterError(f'{len(paths)} runs; a page shows at most {MAX_RUNS} side by side')
    logs = []
    for path in paths:
        log = read_bag(path)
        if not len(motion(log).t):
            raise no_pose(path, log.warnings)
        for warning in log.warnings:
            print(f'{path}: {warning}', file=sys.stderr)
        logs.append(log)
    runs = make_runs(logs, [
        path.absolute().parent.name if path.is_file() else path.absolute().name
        for path in paths])
    results = results_of(runs)
    table.print_results(results, console)
    page = make_page(runs, results)
    write_text(output, page, 'report')
    write_json(json_path, results)
    console.print(f'{output}: {len(page) / 1e6:.1f} MB', highlight=False)
    return results


def make_runs(logs: list[FlightLog], names: list[str]) -> list[Run]:
    """Compute the metrics of flights; give each a label, numbered if equal, and a colour."""
    runs = []
    for k, (log, name) in enumerate(zip(logs, names, strict=True)):
        if names.count(name) > 1:
            name = f'{name} ({names[:k + 1].count(name)})'
        task = task_of(log)
        by_controller = metrics_by_controller(log, task)
        several = len(by_controller) > 1
        runs.append(Run(name, COLOURS[k % MAX_RUNS], log, task, {
            f'{name}: {key}' if several else name: result
            for key, result in by_controller.items()}))
    return runs


def results_of(runs: list[Run]) -> dict:
    """Return the results of all runs as in ``evaluate --json``; meta: their common metadata."""
    metas = [run.log.meta for run in runs]
    shared = {key: value for key, value in metas[0].items()
              if all(meta.get(key) == value for meta in metas)} if metas else {}
    results: dict = {'meta': {**shared, 'version': __version__}}
    for run in runs:
        results.update(run.results)
    return results


def make_page(runs: list[Run], results: dict) -> str:
    """Return the HTML of the page."""
    robot, axis = _robot(runs), TimeAxis.of(runs)
    made: list[tuple[str, str, Callable]] = [
        ('Errors', 'Position and orientation error; grey: L window, green: U window.',
         lambda: charts.errors_over_time(runs, axis)),
        ('Pose', 'Flown pose and target.', lambda: charts.pose(runs, axis)),
        ('Errors of a pose', 'Median and 10 to 90 % band over all poses of a run.',
         lambda: charts.errors_of_a_pose(runs)),
        ('Steady errors', 'Share of the poses with a U error below the value.',
         lambda: charts.steady_errors(runs)),
        ('Disturbance', 'Largest error at each level.', lambda: charts.disturbance(runs)),
        ('Payload', 'Height while payloads are attached.', lambda: charts.payload(runs, axis)),
        ('Commands', 'Commands of joints and rotors 1 to 4.',
         lambda: charts.commands(runs, axis)),
        ('Joint and thrust use', 'Share of the flight at each value; dashed: limits.',
         lambda: charts.use(runs, robot)),
        ('Compute time', 'CPU time of one controller step since the start of the node.',
         lambda: charts.compute(runs, axis)),
        ('Estimate', 'Error of the state estimate against the truth.',
         lambda: charts.estimate(runs, axis)),
        ('Battery', '', lambda: charts.battery(runs, axis))]
    specs: dict[str, dict] = {}
    numbers = charts.Numbers()
    sections = []
    for title, text, draw in made:
        places = []
        for chart in draw():
            name = f'chart{len(specs)}'
            specs[name] = chart.spec(numbers)
            places.append(charts.place(name, chart.wide))
        if places:
            sections.append(section(title, text,
                                    f'<div class="charts">{"".join(places)}</div>'))
    shown = table.grids(results, with_poses=True)
    tables = ''.join(html(grid) for grid in shown if grid.title != 'Poses')
    poses = ''.join(html(grid) for grid in shown if grid.title == 'Poses')
    folded = f'<section><details><summary>Every pose</summary>{poses}</details></section>'
    faults = ''.join(f'<div data-of-run="{number}">{part}</div>'
                     for number, run in enumerate(runs) for part in _faults(run))
    content = f"""<div class="cards">{''.join(map(_card, range(len(runs)), runs))}</div>
{_player()}
<section><h2>Flight</h2><p>Solid: flown, ghost: target, arrows: thrust. Below: states of the
supervisor, with faults. Drag to turn; tap a plot or a strip to go there, drag over a plot to
zoom.</p>
<div id="scene"><div id="errors"></div></div>
<div class="views">{''.join(f'<button data-view="{name}">{text}</button>' for name, text in VIEWS)}
</div>{''.join(_strip(number, run, axis) for number, run in enumerate(runs))}</section>
<section>{tables}</section>
{''.join(sections)}
{folded if poses else ''}
<section class="faults"><h2>Faults</h2>{faults}</section>
{charts.data_block(_data(runs, robot, axis, specs, numbers), numbers)}{charts.scripts()}"""
    meta = results['meta']
    subtitle = ', '.join(filter(None, [table.title(meta), f"beetle_omni_ros {meta['version']}"]))
    return frame('Flight report', subtitle, content)


def _robot(runs):
    """Robot parameters of the first run if its file exists, else the shipped ones."""
    file = runs[0].log.meta.get('robot') if runs else None
    try:
        return RobotParameters.load(file if file and Path(file).is_file() else None)
    except ParameterError:
        return RobotParameters.load()


def outcome(run: Run) -> str:
    """Return the outcome of a flight in one sentence."""
    sentences = []
    for label, result in run.results.items():
        name = '' if label == run.label else f'{label.removeprefix(run.label + ": ")}: '
        tracking = result.get('trajectory') or {}
        poses = [] if tracking else result.get('poses') or []
        parts = ['crashed'] if result.get('crashed') else []
        parts += [result['ended']] if result.get('ended') else []
        if poses:
            parts.append(f"{sum(pose['reached'] for pose in poses)} of {len(poses)} poses reached")
        median = result.get('median') or {}
        if poses and median.get('U_position_m') is not None:
            parts.append(f"median error {1e3 * median['U_position_m']:.1f} mm and "
                         f"{median['U_orientation_deg']:.2f}° at the target")
        if tracking.get('position_mean_m') is not None:
            parts.append(f"mean error {1e3 * tracking['position_mean_m']:.1f} mm and "
                         f"{tracking['orientation_mean_deg']:.2f}° on the trajectory")
        sentences.append(name + (', '.join(parts) or 'no target'))
    return '; '.join(sentences)


def _card(number, run):
    log, meta = run.log, run.log.meta
    facts = [', '.join(log.controllers()), *(f'{key} {meta[key]}' for key in
             ('task', 'conditions', 'seed', 'robot', 'plant') if meta.get(key) is not None),
             f'{log.end - log.start:.0f} s', log.source]
    named = [f'fault: {shortened(name)} at {at - run.start:.2f} s'
             for name, at in log.named_faults().items()]
    lines = ''.join(f'<span class="warning">{escape(text)}</span>'
                    for text in (*_injected(run), *named[:MOST_ROWS], *log.warnings))
    text = escape(' · '.join(fact for fact in facts if fact))
    return (f'<label class="card" style="border-top-color: {run.colour}">'
            f'<input type="checkbox" checked data-run="{number}"><strong>{escape(run.label)}'
            f'</strong><em>{escape(outcome(run))}</em><span>{text}</span>{lines}</label>')


def _injected(run):
    """One line for each fault that was injected."""
    faults = run.log.meta.get('faults') or []
    return [f'injected: {shortened(str(fault))}'
            for fault in (faults if isinstance(faults, list) else [faults])][:MOST_ROWS]


def _player():
    speeds = ''.join(f'<option{" selected" if speed == 1 else ""} value="{speed}">{speed}×'
                     '</option>' for speed in SPEEDS)
    return (f'<div class="player"><button id="play">Play</button>'
            f'<input type="range" id="slider" aria-label="time"><output id="time"></output>'
            f'<select id="speed" aria-label="speed">{speeds}</select>'
            '<span class="zoom"><button id="nearer" title="zoom in">+</button>'
            '<button id="further" title="zoom out">−</button>'
            '<button id="all" title="the whole flight">all</button></span></div>')


def _strip(number, run, axis):
    """Strip of the supervisor's states over time, with its faults."""
    length = axis.step * (axis.count - 1) or 1.0

    def place(t):
        return min(100.0, max(0.0, 100 * (t - run.start - axis.start) / length))

    states: list[tuple[float, str]] = []
    for t, state in zip(run.log.state_t, run.log.states, strict=True):
        if not states or states[-1][1] != state:
            states.append((float(t), state))
    ends = [t for t, _ in states[1:]] + [run.log.end]
    parts = []
    for (t, state), end in zip(states[:MOST_ROWS], ends):
        colour = STATE_COLOURS.get(state.partition(':')[0], '#dfe3e8')
        text = escape(shortened(state))
        parts.append(f'<i style="left:{place(t):.2f}%;width:{place(end) - place(t):.2f}%;'
                     f'background:{colour}" title="{text}">{text}</i>')
    faults = [(shortened(name), at) for name, at in run.log.named_faults().items()][:MOST_ROWS]
    parts += [f'<b style="left:{place(at):.2f}%" title="{escape(name)} at {at - run.start:.2f} s">'
              '</b>' for name, at in faults]
    return (f'<div data-of-run="{number}" class="lane"><span style="color:{run.colour}">'
            f'{escape(run.label)}</span><div class="strip">{"".join(parts)}'
            '<u class="pin"></u></div></div>')


def _data(runs, robot, axis, specs, numbers):
    rotors = robot.rotors.positions
    parts = robot.parts
    ball = BALL if parts is None else parts.end_effector.height
    apart = min(np.linalg.norm(a - b) for k, a in enumerate(rotors) for b in rotors[:k])
    return {
        'time': {'start': axis.start, 'step': axis.step, 'count': axis.count},
        'charts': specs,
        'robot': {'rotors': np.asarray(rotors).tolist(),
                  'axes': np.asarray(robot.tilt_axes).tolist(),
                  'radius': DISC_RADIUS * float(apart), 'ball': [0.0, 0.0, ball],
                  'ball_radius': 0.035},
        'runs': [_scene(run, axis, numbers) for run in runs]}


def _scene(run, axis, numbers):
    body, log = run.body, run.log
    tilt_t, tilt = (log.joint_t, log.joint_position) if len(log.joint_t) else \
        (log.command_t, log.command_tilt)

    def columns(t, values):
        return [numbers.add(column) for column in axis.sampled(run, t, values).T]

    t, position, quaternion = target_poses(run)
    return {'label': run.label, 'colour': run.colour,
            'position': columns(body.t, body.position),
            'quaternion': columns(body.t, body.quaternion),
            'tilt': columns(tilt_t, tilt), 'thrust': columns(log.command_t, log.command_thrust),
            'targets': {'t': np.round(t, 4).tolist(),
                        'pose': np.round(np.hstack([position, quaternion]), 5).ravel().tolist()}}


def _faults(run):
    """Injected faults, states of the supervisor, warnings and rejected messages as HTML."""
    grids = fault_grids(run)
    return [*(f'<p>{escape(f"{run.label}: {text}")}</p>' for text in _injected(run)),
            *map(html, (*supervisor_grids(run), *grids)),
            *([] if grids else [f'<p>{escape(run.label)}: nothing rejected</p>'])]


def supervisor_grids(run: Run) -> list[Grid]:
    """Return a table of the supervisor's states with times and controllers or faults."""
    rows: list[list[str]] = []
    for t, state in zip(run.log.state_t, run.log.states, strict=True):
        kind, _, what = (shortened(part) for part in state.partition(':'))
        if not rows or rows[-1][1:] != [kind, what]:
            rows.append([f'{t - run.start:.2f}', kind, what])
    return [Grid(f'{run.label}: states of the supervisor',
                       ['at [s]', 'state', 'controller or fault'], rows[:MOST_ROWS])] * bool(rows)


def fault_grids(run: Run) -> list[Grid]:
    """Return tables of warnings and errors of the nodes, and of rejected messages, if any."""
    faults: dict[tuple, list] = {}
    last: dict[str, dict] = {}
    for entry in run.log.diagnostics:
        last[entry.name] = entry.values
        if entry.level > 0:
            faults.setdefault((entry.name, entry.level, entry.message), []).append(entry.t)
    levels = {1: 'warning', 2: 'error', 3: 'stale'}
    rows = [[name, levels.get(level, str(level)), message, f'{times[0] - run.start:.1f}',
             str(len(times))] for (name, level, message), times in faults.items()]
    rejected = [[name, key, value] for name, values in last.items()
                for key, value in values.items()
                if ('reject' in key or 'refused' in key) and value not in ('0', '0.0', '', '{}')]
    made = []
    if rows:
        made.append(Grid(f'{run.label}: warnings and errors',
                               ['node', 'level', 'text', 'first at [s]', 'reports'],
                               rows[:MOST_ROWS]))
    if rejected:
        made.append(Grid(f'{run.label}: rejected', ['node', 'reason', 'count'], rejected))
    return made
