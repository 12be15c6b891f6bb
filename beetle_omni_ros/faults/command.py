"""`beetle_omni faults`: flies listed faults, landings or healthy flights; writes one page."""

from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import asdict
from datetime import datetime, timezone
from inspect import getfile
import json
from math import ceil
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from beetle_omni_ros import __version__
from beetle_omni_ros.comparison.fingerprint import code_fingerprint, commit, file_digest
from beetle_omni_ros.control import registry
from beetle_omni_ros.control.base import guidance_of
from beetle_omni_ros.faults import campaign, page
from beetle_omni_ros.faults.flight import ALL_STARTS, STARTS
from beetle_omni_ros.faults.landings import (
    CONDITIONS,
    fly_healthy,
    fly_landing,
    HealthyTrial,
    LandingTrial,
)
from beetle_omni_ros.faults.trial import fly_trial, Trial
from beetle_omni_ros.pages.page import print_grids
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.robot.schema import ParameterError
from beetle_omni_ros.runs.files import check_writable, write_json
from beetle_omni_ros.sim.fault_lists import FaultList

PAGE = 'faults.html'


def run_faults(*, faults: Path | None = None, only: list[str] | None = None,
               starts: list[str] | None = None, seeds: int = 1, seed: int = 0,
               conditions: str = 'nominal', controller: str = registry.DEFAULT,
               jobs: int | None = None, output: Path | None = None,
               json_path: Path | None = None, docs: Path | None = None, bags: bool = False,
               landings: int = 0, without_mocap: bool = False, healthy: float = 0.0,
               plant: Path | None = None,
               console: Console | None = None) -> dict:
    """
    Fly the list of faults, or landings or healthy flights if requested.

    Arguments are the options of `beetle_omni faults`. ``starts`` are of ALL_STARTS, ``healthy`` is
    in hours.

    Returns:
        ``meta``; ``flights`` and ``summary``, or ``landings`` or ``healthy``.

    Raises:
        ParameterError: unusable input, one line.

    """
    console = console or Console()
    listed = FaultList.load(faults)
    cases = listed.chosen(only)
    entry = registry.find(controller)
    controller = entry.reference
    _check(starts, output, json_path, docs, bags)
    true = RobotParameters.load(plant)
    guidance = guidance_of(entry.make(RobotParameters.load()))  # refuses an unusable controller
    meta = {'command': _described(faults, only, starts, seeds, seed, conditions, controller,
                                  landings, without_mocap, healthy, plant),
            'version': __version__, 'commit': commit(),
            'date': datetime.now(timezone.utc).strftime('%Y-%m-%d'), 'guidance': guidance,
            'plant': str(plant) if plant else None, 'limits': asdict(listed.limits)}
    own = str(plant) if plant else None
    fly = _Flyer(console, jobs, output, file_digest(faults) if faults else '', true.hash())
    results: dict = {'meta': meta}
    if landings:
        flown = fly('landings', fly_landing, [
            LandingTrial(k, conditions, controller, without_mocap, own)
            for k in range(seed, seed + landings)], listed)
        results['landings'] = {'flights': flown, 'summary': campaign.landing_summary(flown)}
    if healthy:
        number = ceil(3600 * healthy / listed.healthy.flight_time)
        flown = fly('healthy flights', fly_healthy, [
            HealthyTrial(k, name, controller, own) for name in CONDITIONS
            for k in range(seed, seed + number)], listed)
        results['healthy'] = {'flights': flown, 'summary': campaign.healthy_summary(flown)}
    if not landings and not healthy:
        flown = fly('faults', fly_trial, [
            Trial(case.name, start, k, conditions, controller, own) for case in cases
            for start in starts or STARTS for k in range(seed, seed + seeds)], listed,
            output / 'bags' if bags else None)
        flown.sort(key=lambda one: (list(listed.cases).index(one['case']), one['start'],
                                    one['seed']))
        results.update(flights=flown, summary=campaign.summary(flown, listed))
    _write(results, output, json_path, docs)
    print_grids(page.terminal_grids(results), console)
    for text in (page.total_text(results), f'page: {output / PAGE}' if output
                 else 'no page written; --output DIR writes one'):
        console.print(text, highlight=False, markup=False, soft_wrap=True)
    return results


def _check(starts, output, json_path, docs, bags):
    for start in starts or ():
        if start not in ALL_STARTS:
            raise ParameterError(f"--from '{start}': expected {', '.join(ALL_STARTS)}")
    if bags and output is None:
        raise ParameterError('--bags: expected --output DIR to record to')
    check_writable(json_path)
    if docs and page.BEGIN not in _text(docs):
        raise ParameterError(f"{docs}: no line '{page.BEGIN}'")
    if output:
        try:
            output.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ParameterError(f'{output}: cannot be made ({error.strerror})') from None
        check_writable(output / 'faults.json')


def _text(path):
    try:
        return path.read_text(encoding='utf-8')
    except (OSError, UnicodeDecodeError) as error:
        raise ParameterError(f'{path}: cannot be read ({type(error).__name__})') from None


def _described(faults, only, starts, seeds, seed, conditions, controller, landings,
                without_mocap, healthy, plant):
    parts = ['beetle_omni faults']
    parts += [f'--faults {faults}'] if faults else []
    parts += [f"--only {','.join(only)}"] if only else []
    parts += [f"--from {','.join(starts)}"] if starts else []
    parts += [f'--landings {landings}'] if landings else []
    parts += ['--without-mocap'] if without_mocap else []
    parts += [f'--healthy {healthy:g}'] if healthy else [f'--conditions {conditions}']
    parts += [] if landings or healthy else [f'--seeds {seeds}']
    parts += [f'--seed {seed}'] if seed else []
    parts += [f'--plant {plant}'] if plant else []
    return ' '.join([*parts, f'--controller {controller}'])


class _Flyer:
    """
    Flies trials with a progress bar; each finished result is stored at once.

    Stored results of the same code, parameters and list are not flown again, so that an
    interrupted campaign continues, and further seeds extend it.
    """

    def __init__(self, console, jobs, output, listed, plant):
        """``listed``: digest of an own list, '' for the shipped one; ``plant``: robot's hash."""
        self._console, self._jobs, self._listed = console, jobs, listed
        self._plant = plant
        self._file = output / 'flights.jsonl' if output else None

    def __call__(self, title: str, function: Callable, trials: list, *arguments) -> list[dict]:
        """Fly; returns the stored results, then the new ones in the order of completion."""
        columns = (TextColumn('{task.description}'), BarColumn(), MofNCompleteColumn(),
                   TimeRemainingColumn())
        with ExitStack() as stack:
            stored, kind, results = None, dict[str, str](), list[dict]()
            if self._file:
                kind = {'code': code_fingerprint(flown_by=(Path(getfile(function)),)),
                        'list': self._listed, 'plant': self._plant,
                        'flown': title + ' with bags' * any(
                            isinstance(argument, Path) for argument in arguments)}
                lines, results = self._stored(kind, trials)
                stored = stack.enter_context(open(self._file, 'w', encoding='utf-8'))
                print(*lines, sep='', end='', file=stored, flush=True)
            if results:
                self._console.print(f'{len(results)} of {len(trials)} {title} are in '
                                    f'{self._file} already', markup=False, highlight=False)
            done = [_trial(result, trials[0]) for result in results]
            left = [trial for trial in trials if asdict(trial) not in done]
            bars = stack.enter_context(Progress(*columns, console=self._console, transient=True))
            bar = bars.add_task(title, total=len(trials), completed=len(results))
            for result in campaign.fly_all(function, left, *arguments, jobs=self._jobs):
                results.append(result)
                bars.advance(bar)
                if stored:
                    print(json.dumps({**kind, 'result': result}), file=stored, flush=True)
        return results

    def _stored(self, kind, trials):
        """Stored lines of the same code and list, and the results of ``trials`` among them."""
        lines, results = [], []
        wanted = [asdict(trial) for trial in trials]
        for line in _text(self._file).splitlines(keepends=True) if self._file.exists() else ():
            try:
                entry = json.loads(line)
                result, own = entry['result'], {key: entry[key] for key in kind}
            except (ValueError, KeyError, TypeError):
                continue        # the rest of a line that was interrupted
            if (own['code'], own['list']) == (kind['code'], kind['list']):
                lines.append(line)
                if own == kind and _trial(result, trials[0]) in wanted:
                    results.append(result)
        return lines, results


def _trial(result, like):
    """Fields of the trial that gave a result, a trial as ``like``."""
    return {name: result.get(name) for name in asdict(like)}


def _write(results, output, json_path, docs):
    for path in filter(None, (json_path, output and output / 'faults.json')):
        write_json(path, results)
    if output:
        (output / PAGE).write_text(page.as_page(results, output), encoding='utf-8')
        (output / 'faults.md').write_text(page.as_markdown(results), encoding='utf-8')
    if docs and results.get('summary'):
        table = page.markdown(page.COLUMNS, page.fault_rows(results))
        docs.write_text(page.in_docs(_text(docs), table), encoding='utf-8')
