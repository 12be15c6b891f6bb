"""`beetle_omni gap`: from recorded flights to verdict, numbers, page and corrected robot file."""

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
    UnusableFlight,
)
from beetle_omni_ros.identify.gap.page import gap_page
from beetle_omni_ros.identify.gap.parameters import GapParameters
from beetle_omni_ros.identify.gap.results import grids, headline, results
from beetle_omni_ros.identify.gap.workers import Workers
from beetle_omni_ros.identify.robot_file import check_differs
from beetle_omni_ros.identify.servo.compare import analyse_joint_logs, is_joint_log
from beetle_omni_ros.identify.servo.page import gap_log_page
from beetle_omni_ros.pages.page import print_grids, Terminal
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.runs.bag import names_of, runs_in
from beetle_omni_ros.runs.files import write_json, write_text

BAD_DATA = 3        # exit status
LEAST_FITTED = 2    # with more flights, the last one is held out if none is given


def run_gap(runs: list[Path], holdout: Sequence[Path] = (), robot: Path | None = None,
            apply: Path | None = None, json_path: Path | None = None, page: Path | None = None,
            console: Console | None = None, parameters: Path | None = None,
            fix: bool = False, tolerances: bool = False) -> int:
    """
    Find differences between model and measurement.

    Arguments are those of `beetle_omni gap`.

    Returns:
        exit status: 3 for the verdict `bad_data`, else 0.

    Raises:
        BagError: a run does not exist or is no recording of this robot.
        ParameterError, LogError: unusable robot file, log or output, or the same run twice.

    """
    result = gap_results(runs, holdout, robot, apply, json_path, page, console, parameters, fix,
                         tolerances)
    return BAD_DATA if result['verdict'] == 'bad_data' else 0


def gap_results(runs, holdout=(), robot=None, apply=None, json_path=None, page=None,
                console=None, parameters=None, fix=False, tolerances=False) -> dict:
    """As :func:`run_gap`, but return the results that it writes as JSON."""
    console = console or Terminal()
    runs, holdout = runs_in(runs), runs_in(holdout)
    check_differs(apply, robot)
    check_apart([*runs, *holdout])
    robot_parameters, p = RobotParameters.load(robot), GapParameters.load(parameters)
    if any(is_joint_log(run) for run in runs):
        with console.status('comparing the servos'):
            result, apart = analyse_joint_logs(runs, holdout, robot_parameters, robot)
        html = gap_log_page(apart, result, grids(result), robot_parameters) if page else ''
    else:
        meta = {'runs': [str(r) for r in runs], 'holdout': [str(h) for h in holdout],
                'robot': str(robot) if robot else 'params/robot.yaml'}
        with Progress(SpinnerColumn(), TextColumn('{task.description}'), TimeElapsedColumn(),
                      console=console, transient=True) as bars:
            bar = bars.add_task('reading')
            a = _analysed(runs, holdout, robot_parameters, p, fix,
                          lambda text: bars.update(bar, description=text))
        result = results(a, robot_parameters, p, meta)
        if page and a.damages:      # workers return only the damages, so the bag is read again
            given = [*runs, *holdout]
            path = given[names_of(given).index(a.damages[0].run)]
            a.damaged = read_recording(path), a.damages[0]
        html = gap_page(a, result) if page else ''
    write_json(json_path, result)
    if page:
        write_text(page, html, 'page')
    if apply and result['effects']:
        write_corrected(apply, result, robot_parameters, robot, tolerances)
    _print(console, result)
    if apply:
        console.print(f'corrected robot: {apply}' if result['effects'] else
                      'no effect is named: no robot file is written', highlight=False)
    return result


def _analysed(runs, holdout, robot, p, fix, progress):
    given = [*runs, *holdout]
    with Workers() as workers:
        flights = workers.map(_loaded, zip(given, names_of(given), strict=True), robot, p, fix)
    unusable = [flight for flight in flights if isinstance(flight, UnusableFlight)]
    if unusable:
        # A verdict from the other flights would be read as one from all of them.
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
    """A flight, or the error that makes it unusable."""
    path, name = named
    try:
        return load_flight(path, robot, p, fix, name)
    except UnusableFlight as error:
        return error




def _print(console, result):
    console.print(headline(result), style='bold', highlight=False, markup=False)
    console.print(result['summary'], highlight=False, markup=False)
    for finding in dict.fromkeys(result['findings']):
        console.print(finding, style='dim', highlight=False, markup=False)
    print_grids(grids(result), console)
    if result['next_experiment']:
        console.print(f"Next: {result['next_experiment']}", highlight=False, markup=False)
