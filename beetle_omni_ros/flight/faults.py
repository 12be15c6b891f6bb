"""`beetle_omni faults`: flies listed faults, landings or healthy flights; writes one page."""

from datetime import datetime, timezone
from math import ceil
from pathlib import Path
import shlex
import sys

from rich.console import Console

from beetle_omni_ros import __version__
from beetle_omni_ros.control import registry
from beetle_omni_ros.control.base import guidance_of
from beetle_omni_ros.flight import fault_page as page
from beetle_omni_ros.flight.campaign import file_digest, Store, sweep
from beetle_omni_ros.flight.fault_flights import (
    ALL_STARTS,
    CONDITIONS,
    fly_trial,
    HEALTHY,
    LANDING,
    LANDING_BLIND,
    PLAN,
    STARTS,
    Trial,
)
from beetle_omni_ros.model.files import write_json, write_text
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.model.resources import commit
from beetle_omni_ros.model.schema import ParameterError
from beetle_omni_ros.show.page import print_grids
from beetle_omni_ros.sim.faults import chosen, load_cases

PAGE, FLIGHTS = 'faults.html', '.flights'


def run_faults(*, faults: Path | None = None, only: list[str] | None = None,
               starts: list[str] | None = None, seeds: int = 1, seed: int = 0,
               conditions: str = 'nominal', controller: str = registry.DEFAULT,
               jobs: int | None = None, output: Path | None = None,
               json_path: Path | None = None, bags: bool = False,
               landings: int = 0, without_mocap: bool = False, healthy: float = 0.0,
               plant: Path | None = None, console: Console | None = None) -> dict:
    """
    Fly the list of faults, or landings or healthy flights if requested.

    Arguments are the options of `beetle_omni faults`. Returned are ``meta``, ``flights`` and
    ``summary``; a ParameterError reports unusable input.
    """
    console = console or Console()
    cases = load_cases(faults)
    struck = chosen(cases, only or list(cases))
    entry = registry.find(controller)
    for start in starts or ():
        if start not in ALL_STARTS:
            raise ParameterError(f"--from '{start}': expected {', '.join(ALL_STARTS)}")
    if bags and output is None:
        raise ParameterError('--bags: expected --output DIR to record to')
    RobotParameters.load(plant)
    guidance = guidance_of(entry.make(RobotParameters.load()))  # refuses an unusable controller
    common = {'controller': entry.reference, 'plant': str(plant or ''),
              'listed': file_digest(faults) if faults else ''}
    under, begins, count = (conditions,), starts or STARTS, seeds
    if landings:
        struck, begins, count = [LANDING_BLIND if without_mocap else LANDING], ('',), landings
    elif healthy:
        struck, begins, under = [HEALTHY], ('',), CONDITIONS
        count = ceil(3600 * healthy / PLAN.healthy_time)
    calls = [(Trial(case.name, start, k, name, **common), case, output / 'bags' if bags else None)
             for case in struck for start in begins for name in under
             for k in range(seed, seed + count)]
    store = Store(output / FLIGHTS) if output else None
    flown = sweep(fly_trial, calls, store=None if bags else store, jobs=jobs,
                  console=console)      # a stored flight records no bag
    results = {'meta': {
        'command': shlex.join(['beetle_omni', *sys.argv[1:]]), 'version': __version__,
        'commit': commit(), 'date': datetime.now(timezone.utc).strftime('%Y-%m-%d'),
        'guidance': guidance, 'plant': str(plant) if plant else None},
        'flights': flown, 'summary': page.summary(flown, {case.name: case for case in struck})}
    write_json(json_path, results)
    if output:
        write_json(output / 'faults.json', results)
        write_text(output / PAGE, page.as_page(results, output), 'page')
        write_text(output / 'faults.md', page.as_markdown(results), 'page')
    print_grids([page.grid(results, narrow=True)], console)
    for text in (page.total_text(results), f'page: {output / PAGE}' if output
                 else 'no page written; --output DIR writes one'):
        console.print(text, highlight=False, markup=False, soft_wrap=True)
    return results
