"""`beetle_omni gap`: from recordings to verdict, numbers, page and corrected robot file."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from rich.console import Console
from threadpoolctl import threadpool_limits

from beetle_omni_ros.bags.bag import names_of, runs_in
from beetle_omni_ros.identify.flights.apply import write_corrected
from beetle_omni_ros.identify.flights.learn import FORMULA, learned, write_effect
from beetle_omni_ros.identify.flights.next_flight import Planner
from beetle_omni_ros.identify.flights.page import grids, headline
from beetle_omni_ros.identify.flights.results import ALPHA, result_of
from beetle_omni_ros.identify.flights.verdict import judged, judged_tables, load_tables
from beetle_omni_ros.identify.recording.bag import read_recording
from beetle_omni_ros.identify.recording.flight import (
    check_apart,
    check_flights,
    prepare,
    UnusableFlight,
)
from beetle_omni_ros.identify.recording.parameters import GapParameters
from beetle_omni_ros.identify.recording.table import Format
from beetle_omni_ros.identify.robot_file import check_differs
from beetle_omni_ros.identify.servo.log import is_joint_log
from beetle_omni_ros.model.files import write_json, write_text
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.model.schema import ParameterError
from beetle_omni_ros.show.page import print_end, print_grids, Terminal

LEAST_FITTED = 2    # bags; with more, the last one is held out if none is given


def gap_results(runs: Sequence[Path], holdout: Sequence[Path] = (), robot: Path | None = None,
                apply: Path | None = None, json_path: Path | None = None,
                page: Path | None = None, console: Console | None = None,
                parameters: Path | None = None, fix: bool = False, tolerances: bool = False,
                form: str | None = None, alpha: float = ALPHA, next_task: Path | None = None,
                learn: Path | None = None,
                experiments: Callable[[RobotParameters], Any] | None = None) -> dict:
    """
    Find differences between model and measurement; arguments of `beetle_omni gap`.

    Args:
        runs: bags, joint logs, or tables of flights.
        holdout: flights that only judge; by default the last of three bags or more.
        robot: robot file; None: the shipped one.
        apply: robot file to write, with the named effects.
        json_path: file of the results.
        page: HTML page to write.
        console: for progress, sentence and tables.
        parameters: file with changes to params/gap.yaml.
        fix: whether certain corrections of bags are applied.
        tolerances: whether ``apply`` has this robot's own numbers, too.
        form: format of tables of flights, by name or file; None: bags or joint logs.
        alpha: probability of a false alarm that is accepted.
        learn: file of an effect to write, a formula for what no entry explains.
        next_task: task to write, a flight that decides what these left open.
        experiments: makes what draws and flies its poses, for ``next_task``.

    Returns:
        the results that are written as JSON.

    Raises:
        BagError: a run does not exist or is no recording of this robot.
        ParameterError, LogError: unusable file or value, or the same run twice.

    """
    console = console or Terminal()
    if not 0 < alpha < 1:
        raise ParameterError(f'--alpha {alpha:g}: expected a probability between 0 and 1')
    if form is not None and fix:
        raise ParameterError('--fix: expected without --format, because it corrects bags')
    check_differs(apply, robot)
    model, p = RobotParameters.load(robot), GapParameters.load(parameters)
    runs, holdout = (list(given) if form else runs_in(given) for given in (runs, holdout))
    check_apart([*runs, *holdout])
    if form is None and any(is_joint_log(run) for run in runs):
        for option, path in (('--next', next_task), ('--learn', learn)):
            if path:
                raise ParameterError(f'{option} {path}: expected flights, not logs of joints')
        from beetle_omni_ros.identify.servo.compare import analyse_joint_logs
        with console.status('comparing the servos'):
            result, made_page = analyse_joint_logs(runs, holdout, model)
    else:
        then = Planner(model, p, experiments(model), next_task) \
            if next_task and experiments else None
        # On small matrices, several threads only take more CPU time.
        with console.status('reading') as status, threadpool_limits(1):
            def results(robot, then):
                return _tables(runs, holdout, robot, p, form, alpha, status.update, then) \
                    if form else _bags(runs, holdout, robot, p, fix, alpha, status.update, then)
            result = results(model, then)
            result = learned(results, model, result) if learn else result
        result['meta']['alpha'] = alpha
        made_page = partial(_page, result, [*runs, *holdout])
    result['meta'] |= {'runs': [str(r) for r in runs], 'holdout': [str(h) for h in holdout],
                       'robot': str(robot) if robot else 'params/robot.yaml'}
    write_json(json_path, result)
    if page:
        write_text(page, made_page(), 'page')
    written = learn if result.get(FORMULA, {}).get('ranges') else None
    if written:
        write_effect(written, result, model)
    corrected = apply if result['effects'] else None
    if corrected:
        write_corrected(corrected, result, model, robot, tolerances)
    _print(console, result)
    print_end(console, (corrected, written, page, json_path),
              *([f'open {page} in a browser'] if page else []),
              ('evaluate', '--robot', corrected) if corrected
              else 'no robot file, because no effect is named' if apply
              else 'the same with ' + ', with '.join(_further(result, page, learn)))
    return result


def _further(result, page, learn):
    """Options that may come next, and what they write."""
    if not page:
        yield '--report FILE writes a page'
    if result['effects']:
        yield '--apply FILE writes a robot file'
    elif result['held_out'] and not learn and 'joints' not in result:
        yield '--learn FILE writes an effect that no entry has'
    else:
        yield '--json FILE writes all numbers'


def _tables(runs, holdout, robot, p, form, alpha, progress, then):
    declared = Format.load(form)
    flights, judging = (load_tables(paths, robot, declared) for paths in (runs, holdout))
    progress('weighing effects')
    result = judged_tables(flights, judging, robot, p, declared, alpha, then)
    result['meta']['format'] = declared.name
    return result


def _bags(runs, holdout, robot, p, fix, alpha, progress, then):
    given = [*runs, *holdout]
    flights, errors = [], []
    for path, name in zip(given, names_of(given), strict=True):
        try:
            flights.append(prepare(replace(read_recording(path), name=name), robot, p, fix))
        except UnusableFlight as error:
            errors.append(error)
    if errors:
        # A verdict from the other flights would be read as one from all of them.
        damages = [damage for error in errors for damage in error.problems]
        return result_of('bad_data', {}, str(errors[0]), bad_data=[
            {key: getattr(damage, key) for key in ('run', 'topic', 'cause', 'at_s', 'sure', 'fix')}
            for damage in damages])
    check_flights(given, flights, p.same_flight)
    fitted, judging = flights[:len(runs)], flights[len(runs):]
    if not judging and len(fitted) > LEAST_FITTED:
        fitted, judging = fitted[:-1], fitted[-1:]
    progress('weighing effects')
    result = judged(fitted, judging, robot, p, alpha, then)
    result['findings'] += [text for flight in flights for text in flight.findings]
    return result


def _page(result, given):
    """The page, with a picture of the first damage if there is one."""
    from beetle_omni_ros.identify.flights.picture import gap_page
    damages = result['bad_data']
    return gap_page(result, (read_recording(given[names_of(given).index(
        damages[0]['run'])]), damages[0]) if damages else None)


def _print(console, result):
    console.print(headline(result), style='bold', highlight=False, markup=False)
    console.print(result['summary'], highlight=False, markup=False)
    for finding in dict.fromkeys(result['findings']):
        console.print(finding, style='dim', highlight=False, markup=False)
    print_grids(grids(result), console)
    if result['next_experiment']:
        console.print(f"Next: {result['next_experiment']}", highlight=False, markup=False)
    if result.get('next_flight'):
        console.print(f"Next flight: {result['next_flight']['sentence']}", highlight=False,
                      markup=False, soft_wrap=True)
