"""`beetle_omni report`: a self-contained HTML page with several runs side by side."""

from html import escape
from pathlib import Path
import sys

from rich.console import Console

from beetle_omni_ros import __version__
from beetle_omni_ros.pages.figures import COLOURS
from beetle_omni_ros.pages.page import frame, Grid, html, section, Terminal
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.robot.schema import ParameterError, shortened
from beetle_omni_ros.runs import table
from beetle_omni_ros.runs.bag import no_pose, read_bag, runs_in
from beetle_omni_ros.runs.files import write_json, write_text
from beetle_omni_ros.runs.log import FlightLog, motion
from beetle_omni_ros.runs.metrics import metrics_by_controller, task_of
from beetle_omni_ros.view import charts
from beetle_omni_ros.view.charts import MAX_RUNS, Run
from beetle_omni_ros.view.recorded import recorded_scene

MOST_ROWS = 40      # of states, faults and warnings


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
    grouped = ''.join(section(title, text, '<div class="charts">' + ''.join(
        map(charts.html, ([panel] for panel in panels))) + '</div>')
        for title, text, panels in charts.distributions(runs, _robot(runs)) if panels)
    shown = table.grids(results, with_poses=True)
    tables = ''.join(html(grid) for grid in shown if grid.title != 'Poses')
    poses = ''.join(html(grid) for grid in shown if grid.title == 'Poses')
    folded = f'<section><details><summary>Every pose</summary>{poses}</details></section>'
    faults = ''.join(part for run in runs for part in _faults(run))
    scene = recorded_scene({run.label: run.log for run in runs})
    content = f"""<div class="cards">{''.join(map(_card, runs))}</div>
<section>{tables}</section>
<section><h2>Flight</h2><p>Frame: target, arrows: thrust. Drag to turn.</p>
<iframe title="3D" srcdoc="{escape(scene)}"></iframe></section>
{charts.library()}
{section('In time', 'Grey: L window, green: U window. Drag over a chart to zoom all, click twice '
         'to see all; click in the legend to hide a run.', charts.html(charts.flight(runs)))}
{grouped}{folded if poses else ''}
<section class="faults"><h2>Faults</h2>{faults}</section>"""
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


def _card(run):
    log, meta = run.log, run.log.meta
    facts = [', '.join(log.controllers()), *(f'{key} {meta[key]}' for key in
             ('task', 'conditions', 'seed', 'robot', 'plant') if meta.get(key) is not None),
             f'{log.end - log.start:.0f} s', log.source]
    named = [f'fault: {shortened(name)} at {at - run.start:.2f} s'
             for name, at in log.named_faults().items()]
    lines = ''.join(f'<span class="warning">{escape(text)}</span>'
                    for text in (*_injected(run), *named[:MOST_ROWS], *log.warnings))
    text = escape(' · '.join(fact for fact in facts if fact))
    return (f'<div class="card" style="border-top-color: {run.colour}"><strong>'
            f'{escape(run.label)}</strong><em>{escape(outcome(run))}</em><span>{text}</span>'
            f'{lines}</div>')


def _injected(run):
    """One line for each fault that was injected."""
    faults = run.log.meta.get('faults') or []
    return [f'injected: {shortened(str(fault))}'
            for fault in (faults if isinstance(faults, list) else [faults])][:MOST_ROWS]


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
