"""`beetle_omni report`: one self-contained HTML page, several runs side by side."""

from __future__ import annotations

from collections.abc import Callable
from html import escape
import os
from pathlib import Path
import sys

import matplotlib
from rich.console import Console

from beetle_omni_ros import __version__
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.robot.schema import ParameterError
from beetle_omni_ros.robot.yaml_file import shortened
from beetle_omni_ros.runs import figures, plots, plots_summary, report_page, table
from beetle_omni_ros.runs.bag import BagError, read_bag
from beetle_omni_ros.runs.figures import COLOURS, Run
from beetle_omni_ros.runs.json_file import write_json
from beetle_omni_ros.runs.log import FlightLog
from beetle_omni_ros.runs.metrics import metrics_by_controller, task_of

MAX_RUNS = len(COLOURS)  # more could not be told apart
MOST_ROWS = 40      # of states, faults and warnings


def run_report(paths: list[Path], output: Path, *, json_path: Path | None = None,
               console: Console | None = None) -> dict:
    """
    Read runs, print their result table and write the page.

    Args:
        paths: bags, or folders of bags.
        output: HTML file.
        json_path: file for the results.
        console: where to print.

    Returns:
        The results: ``meta`` and one key for each run and controller.

    Raises:
        BagError: a run cannot be read.
        ParameterError: too many runs, or the page cannot be written.

    """
    console = console or Console()
    paths = [run for path in paths for run in _runs_in(path)]
    if len(paths) > MAX_RUNS:
        raise ParameterError(f'{len(paths)} runs; a page shows at most {MAX_RUNS} side by side')
    logs = []
    for path in paths:
        log = read_bag(path)
        if not len(log.truth_t) and not len(log.odom_t):
            raise BagError(f'{path}: no pose of the robot in it; expected '
                           'ground_truth/odom or odom')
        for warning in log.warnings:
            print(f'{path}: {warning}', file=sys.stderr)
        logs.append(log)
    runs = make_runs(logs, [_name(path) for path in paths])
    results = results_of(runs)
    table.print_results(results, console)
    page = make_page(runs, results)
    try:
        temporary = output.with_name(output.name + '.tmp')
        temporary.write_text(page, encoding='utf-8')
        os.replace(temporary, output)
    except OSError as error:
        raise ParameterError(f'{output}: cannot write the report ({error.strerror})') from None
    if json_path:
        write_json(json_path, results)
    console.print(f'{output}: {len(page) / 1e6:.1f} MB', highlight=False)
    return results


def _name(path):
    path = Path(path).absolute()
    return path.parent.name if path.is_file() else path.name


def make_runs(logs: list[FlightLog], names: list[str]) -> list[Run]:
    """Judge flights and give each its label and colour; equal names are numbered."""
    runs = []
    for k, (log, name) in enumerate(zip(logs, names, strict=True)):
        if names.count(name) > 1:
            name = f'{name} ({names[:k + 1].count(name)})'
        task = task_of(log)
        judged = metrics_by_controller(log, task)
        labels = {key: name if len(judged) == 1 else f'{name}: {key}' for key in judged}
        runs.append(Run(name, COLOURS[k % MAX_RUNS], log, task,
                        {labels[key]: result for key, result in judged.items()}))
    return runs


def results_of(runs: list[Run]) -> dict:
    """Results of all runs in the form of ``evaluate --json``; meta holds what they share."""
    metas = [run.log.meta for run in runs]
    shared = {key: value for key, value in metas[0].items()
              if all(meta.get(key) == value for meta in metas)} if metas else {}
    results: dict = {'meta': {**shared, 'version': __version__}}
    for run in runs:
        results.update(run.results)
    return results


def make_page(runs: list[Run], results: dict) -> str:
    """Build the page."""
    robot = _robot(runs)
    made: list[tuple[str, str, Callable]] = [
        ('Pose', 'Flown pose and target.', lambda: plots.pose(runs)),
        ('Path', 'From above and from the side.', lambda: plots_summary.path(runs)),
        ('Errors', 'Distance from the target and angle to it, logarithmic.',
         lambda: plots.errors_over_time(runs)),
        ('Errors of a pose', 'Median and 10 to 90 % band over all poses of a run.',
         lambda: plots.errors_of_a_pose(runs)),
        ('Steady errors', 'Share of the poses with a U error below the value.',
         lambda: plots_summary.steady_errors(runs)),
        ('Disturbance', 'Largest error at each level.', lambda: plots_summary.disturbance(runs)),
        ('Payload', 'Height while payloads are attached.', lambda: plots_summary.payload(runs)),
        ('Commands', 'What the actuators were told: joints and rotors 1 to 4.',
         lambda: plots.commands(runs)),
        ('Joint and thrust use', 'Share of the flight at each value; dashed: limits.',
         lambda: plots_summary.use(runs, robot)),
        ('Compute time', 'CPU time of one controller step since the start of the node.',
         lambda: plots.compute(runs)),
        ('Estimate', 'Error of the state estimate against the truth.',
         lambda: plots.estimate(runs)),
        ('Battery', '', lambda: plots.battery(runs))]
    sections = []
    with matplotlib.rc_context(figures.STYLE):
        for title, text, draw in made:
            figure = draw()
            if figure is not None:
                sections.append(report_page.section(title, text, figures.svg(figure, title)))
    tables = ''.join(table.html(grid) for grid in table.grids(results, with_poses=False))
    poses = [table.html(grid) for grid in table.grids(results, with_poses=True)
             if grid.title == 'Poses']
    faults = ''.join(table.html(grid) for run in runs
                     for grid in (*supervisor_grids(run), *fault_grids(run)))
    return report_page.page(
        'Flight report', _subtitle(results['meta']), [_card(run) for run in runs], tables,
        sections, poses, faults)


def _robot(runs):
    """Limits for the plots: those of the runs' robot where its file is there."""
    file = runs[0].log.meta.get('robot') if runs else None
    try:
        return RobotParameters.load(file if file and Path(file).is_file() else None)
    except ParameterError:
        return RobotParameters.load()


def _subtitle(meta):
    known = [f'{key} {meta[key]}' for key in ('task', 'conditions', 'seed')
             if meta.get(key) is not None]
    return ', '.join([*known, f"beetle_omni_ros {meta['version']}"])


def _card(run):
    log, meta = run.log, run.log.meta
    facts = [', '.join(log.controllers()), *(f'{key} {meta[key]}' for key in
             ('task', 'conditions', 'seed', 'robot', 'plant') if meta.get(key) is not None),
             f'{log.end - log.start:.0f} s', log.source]
    named = [f'fault: {shortened(name)} at {at - run.start:.2f} s'
             for name, at in log.named_faults().items()]
    return report_page.card(run.label, run.colour, [fact for fact in facts if fact],
                            [*named[:MOST_ROWS], *log.warnings])


def supervisor_grids(run: Run) -> list[table.Grid]:
    """When the supervisor was in which state, and for which controller or fault."""
    rows: list[list[str]] = []
    for t, state in zip(run.log.state_t, run.log.states, strict=True):
        kind, _, what = (shortened(part) for part in state.partition(':'))
        if not rows or rows[-1][1:] != [kind, what]:
            rows.append([f'{t - run.start:.2f}', kind, what])
    return [table.Grid(f'{run.label}: states of the supervisor',
                       ['at [s]', 'state', 'controller or fault'], rows[:MOST_ROWS])] * bool(rows)


def fault_grids(run: Run) -> list[table.Grid]:
    """Warnings and errors of the nodes, and the counters of what they rejected."""
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
        made.append(table.Grid(f'{run.label}: warnings and errors',
                               ['node', 'level', 'text', 'first at [s]', 'reports'],
                               rows[:MOST_ROWS]))
    if rejected:
        made.append(table.Grid(f'{run.label}: rejected', ['node', 'reason', 'count'], rejected))
    if not made:
        made.append(table.Grid(f'{run.label}: no fault, nothing rejected', [escape('')], []))
    return made


def _runs_in(path: Path) -> list[Path]:
    """Find the bags of a folder that is none itself, such as `evaluate` makes; else the path."""
    if path.is_dir() and not any(path.glob('*.mcap')):
        return sorted({file.parent for file in path.glob('*/*.mcap')}) or [path]
    return [path]
