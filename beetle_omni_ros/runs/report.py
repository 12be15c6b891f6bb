"""`beetle_omni report`: a self-contained HTML page with several runs side by side."""

from pathlib import Path
import sys

from rich.console import Console

from beetle_omni_ros import __version__
from beetle_omni_ros.pages.figures import COLOURS
from beetle_omni_ros.pages.table import Terminal
from beetle_omni_ros.robot.schema import ParameterError
from beetle_omni_ros.runs import table
from beetle_omni_ros.runs.bag import read_bag
from beetle_omni_ros.runs.bag_files import no_pose, runs_in
from beetle_omni_ros.runs.body import motion
from beetle_omni_ros.runs.json_file import write_json, write_text
from beetle_omni_ros.runs.log import FlightLog
from beetle_omni_ros.runs.metrics import metrics_by_controller, task_of
from beetle_omni_ros.runs.report_page import make_page
from beetle_omni_ros.runs.report_runs import Run

MAX_RUNS = len(COLOURS)  # each run has its own colour


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
        _has_a_pose(log, path)
        for warning in log.warnings:
            print(f'{path}: {warning}', file=sys.stderr)
        logs.append(log)
    runs = make_runs(logs, [_name(path) for path in paths])
    results = results_of(runs)
    table.print_results(results, console)
    page = make_page(runs, results)
    write_text(output, page, 'report')
    write_json(json_path, results)
    console.print(f'{output}: {len(page) / 1e6:.1f} MB', highlight=False)
    return results


def _name(path):
    path = Path(path).absolute()
    return path.parent.name if path.is_file() else path.name


def _has_a_pose(log, name):
    if not len(motion(log).t):
        raise no_pose(name, log.warnings)


def make_runs(logs: list[FlightLog], names: list[str]) -> list[Run]:
    """
    Compute the metrics of flights, and give each a label and a colour; equal names are numbered.

    Raises:
        BagError: a flight without a pose.

    """
    runs = []
    for k, (log, name) in enumerate(zip(logs, names, strict=True)):
        _has_a_pose(log, name)
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
