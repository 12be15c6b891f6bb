"""`beetle_omni report`: a self-contained HTML page with several runs side by side."""

from pathlib import Path
import sys

from rich.console import Console

from beetle_omni_ros import __version__
from beetle_omni_ros.bags.bag import read_flights
from beetle_omni_ros.bags.log import FlightLog
from beetle_omni_ros.bags.metrics import metrics_by_controller
from beetle_omni_ros.model.files import write_json, write_text
from beetle_omni_ros.model.schema import shortened
from beetle_omni_ros.show import charts, table
from beetle_omni_ros.show.charts import MAX_RUNS, Run
from beetle_omni_ros.show.figures import colours_of
from beetle_omni_ros.show.page import Grid, print_end, rendered, Terminal
from beetle_omni_ros.show.recorded import recorded_scene

MOST_ROWS = 40      # of states, faults and warnings
LEVELS = {1: 'warning', 2: 'error', 3: 'stale'}     # of diagnostics


def run_report(paths: list[Path], output: Path, *, json_path: Path | None = None,
               full: bool = False, console: Console | None = None) -> dict:
    """
    Read runs, print their result table, write the page; return :func:`results_of` the runs.

    ``paths`` are bags, or folders of bags. A ParameterError reports a run that cannot be read, too
    many runs, or a page that cannot be written.
    """
    console = console or Terminal()
    runs = make_runs(read_flights(paths, MAX_RUNS))
    results = results_of(runs)
    page = make_page(runs, results)
    for run in runs:
        for warning in run.log.warnings:
            print(f'{run.log.source}: {warning}', file=sys.stderr)
    table.print_results(results, console, full=full)
    write_text(output, page, 'report')
    write_json(json_path, results)
    print_end(console, [output, json_path], f'open {output} in a browser', ('view', *paths))
    return results


def make_runs(logs: dict[str, FlightLog]) -> list[Run]:
    """Compute the metrics of flights; give each the colour of its controller."""
    runs = []
    for (name, log), colour in zip(logs.items(), colours_of(logs.values()), strict=True):
        found = metrics_by_controller(log)
        runs.append(Run(name, colour, log, {
            f'{name}: {key}' if len(found) > 1 else name: result
            for key, result in found.items()}))
    return runs


def results_of(runs: list[Run]) -> dict:
    """Return the results of all runs as in ``evaluate --json``; meta: their common metadata."""
    first, *others = [run.log.meta for run in runs]
    shared = {key: value for key, value in first.items()
              if all(meta.get(key) == value for meta in others)}
    results: dict = {'meta': {**shared, 'version': __version__}}
    for run in runs:
        results.update(run.results)
    return results


def make_page(runs: list[Run], results: dict) -> str:
    """Return the HTML of the page."""
    grids, meta = table.grids(results, full=True), results['meta']
    return rendered(
        'report.html', title='Flight report', cards=map(_card, runs), charts=charts.html(runs),
        subtitle=', '.join(filter(None, [table.title(meta),
                                         f"beetle_omni_ros {meta['version']}"])),
        tables=[grid for grid in grids if not grid.title.startswith('Poses')],
        poses=[grid for grid in grids if grid.title.startswith('Poses')],
        scene=recorded_scene({run.label: run.log for run in runs}),
        faults=[grid for run in runs for grid in _faults(run) if grid.rows])


def _card(run):
    """The run, facts about it and warnings."""
    log, meta = run.log, run.log.meta
    facts = [', '.join(log.controllers()), *(f'{key} {meta[key]}' for key in
             ('task', 'conditions', 'seed', 'robot', 'plant') if meta.get(key) is not None),
             f'{log.end - log.start:.0f} s', log.source]
    injected = meta.get('faults') or []
    injected = injected if isinstance(injected, list) else [injected]
    named = [f'fault: {shortened(name)} at {at - log.begin:.2f} s'
             for name, at in log.named_faults().items()]
    return run, facts, [*(f'injected: {shortened(str(fault))}' for fault in injected[:MOST_ROWS]),
                        *named[:MOST_ROWS], *log.warnings]


def _faults(run):
    """Tables of warnings of the nodes, and of rejected messages."""
    told: dict[tuple, list] = {}
    last: dict[str, dict] = {}
    for entry in run.log.diagnostics:
        last[entry.name] = entry.values
        if entry.level > 0:
            told.setdefault((entry.name, entry.level, entry.message), []).append(entry.t)
    warnings = [[name, LEVELS.get(level, str(level)), message,
                 f'{times[0] - run.log.begin:.1f}', str(len(times))]
                for (name, level, message), times in told.items()]
    rejected = [[name, key, value] for name, values in last.items()
                for key, value in values.items()
                if ('reject' in key or 'refused' in key) and value not in ('0', '0.0', '', '{}')]
    return (Grid(f'{run.label}: warnings and errors',
                 ['node', 'level', 'text', 'first at [s]', 'reports'], warnings[:MOST_ROWS]),
            Grid(f'{run.label}: rejected', ['node', 'reason', 'count'], rejected[:MOST_ROWS]))
