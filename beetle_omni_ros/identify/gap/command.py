"""`beetle_omni gap`: recorded flights in; verdict, numbers, page and corrected robot file out."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from rich.console import Console
from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

from beetle_omni_ros.identify.gap.analysis import analyse, Analysis
from beetle_omni_ros.identify.gap.apply import write_corrected
from beetle_omni_ros.identify.gap.bags import read_recording
from beetle_omni_ros.identify.gap.ingest import (
    check_apart,
    check_flights,
    load_flight,
    names_of,
    UnusableFlight,
)
from beetle_omni_ros.identify.gap.joint_changes import change_grids
from beetle_omni_ros.identify.gap.joint_gap import analyse_joint_log
from beetle_omni_ros.identify.gap.page import gap_page
from beetle_omni_ros.identify.gap.parameters import GapParameters
from beetle_omni_ros.identify.gap.results import grids, headline, results
from beetle_omni_ros.identify.gap.workers import Workers
from beetle_omni_ros.identify.robot_file import check_not_base, write_text
from beetle_omni_ros.pages.table import print_grids
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.robot.schema import ParameterError
from beetle_omni_ros.runs.json_file import check_writable, write_json

BAD_DATA = 3        # exit status
LEAST_FITTED = 2    # flights, above which the last one judges where nobody named one


def run_gap(runs: list[Path], holdout: Sequence[Path] = (), robot: Path | None = None,
            apply: Path | None = None, json_path: Path | None = None, page: Path | None = None,
            console: Console | None = None, parameters: Path | None = None,
            fix: bool = False, tolerances: bool = False) -> int:
    """
    Find where model and measurement disagree.

    Arguments are those of `beetle_omni gap`.

    Returns:
        3 for the verdict `bad_data`; 0 for any other, which is no error.

    Raises:
        BagError: a run that does not exist or is no recording of this robot, in one line.
        ParameterError, LogError: unusable robot file, log or output, or the same run twice.

    """
    made = gap_results(runs, holdout, robot, apply, json_path, page, console, parameters, fix,
                       tolerances)
    return BAD_DATA if made['verdict'] == 'bad_data' else 0


def gap_results(runs, holdout=(), robot=None, apply=None, json_path=None, page=None,
                console=None, parameters=None, fix=False, tolerances=False) -> dict:
    """Do as :func:`run_gap`, and return what it writes to JSON."""
    console = console or Console()
    runs, holdout = [Path(r) for r in runs], [Path(h) for h in holdout]
    _check_outputs(apply, robot, json_path, page)
    check_apart([*runs, *holdout])
    believed, p = RobotParameters.load(robot), GapParameters.load(parameters)
    if any(run.suffix.lower() == '.csv' for run in runs):
        made, html = analyse_joint_log(runs, holdout, believed, robot, p)
    else:
        meta = {'runs': [str(r) for r in runs], 'holdout': [str(h) for h in holdout],
                'robot': str(robot) if robot else 'params/robot.yaml'}
        with Progress(SpinnerColumn(), TextColumn('{task.description}'), TimeElapsedColumn(),
                      console=console, transient=True) as bars:
            bar = bars.add_task('reading')
            a = _analysed(runs, holdout, believed, p, fix,
                          lambda text: bars.update(bar, description=text))
        made = results(a, believed, p, meta)
        if page and a.damages:
            a.damaged = _first_damaged([*runs, *holdout], a.damages[0])
        html = gap_page(a, made) if page else ''
    _print(console, made)
    if json_path:
        write_json(json_path, made)
    if page:
        write_text(page, html, 'page')
    if apply:
        if made['effects']:
            write_corrected(apply, made, believed, robot, tolerances)
            console.print(f'corrected robot: {apply}', highlight=False)
        else:
            console.print('nothing is named: no robot file is written', highlight=False)
    return made


def _analysed(runs, holdout, robot, p, fix, progress):
    given = [*runs, *holdout]
    with Workers() as workers:
        flights = workers.map(_loaded, zip(given, names_of(given), strict=True), robot, p, fix)
    unusable = [flight for flight in flights if isinstance(flight, UnusableFlight)]
    if unusable:
        # A verdict about the other flights would pass for one about all that were given.
        return Analysis('bad_data', str(unusable[0]),
                        damages=[damage for f in unusable for damage in f.problems])
    check_flights(given, flights, p.same_flight)
    fitted, judging = flights[:len(runs)], flights[len(runs):]
    if not judging and len(fitted) > LEAST_FITTED:
        fitted, judging = fitted[:-1], fitted[-1:]
    a = analyse(fitted, judging, robot, p, progress)
    a.findings = [text for flight in flights for text in flight.findings] + a.findings
    return a


def _loaded(_, named, robot, p, fix):
    """A flight, or why it cannot be used."""
    path, name = named
    try:
        return load_flight(path, robot, p, fix, name)
    except UnusableFlight as error:
        return error


def _first_damaged(paths, damage):
    """Recording of a damage, read again: what worked on it kept only what is wrong."""
    path = paths[names_of(paths).index(damage.run)]
    return read_recording(path), damage


def _check_outputs(apply, robot, json_path, page):
    if apply:
        check_not_base(apply, robot)
    for path, what in ((json_path, 'result file'), (page, 'page'), (apply, 'parameter file')):
        if path:
            check_writable(path, what)


def _print(console, made):
    console.print(headline(made), style='bold', highlight=False, markup=False)
    console.print(made['summary'], highlight=False, markup=False)
    for finding in dict.fromkeys(made['findings']):
        console.print(finding, style='dim', highlight=False, markup=False)
    print_grids([*grids(made), *change_grids(made.get('changes', []))], console)
    if made['next_experiment']:
        console.print(f"Next: {made['next_experiment']}", highlight=False, markup=False)


__all__ = ['gap_results', 'ParameterError', 'run_gap']
