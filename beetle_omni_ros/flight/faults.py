"""`beetle_omni faults`: flies listed faults, landings or healthy flights; writes one page."""

from collections import Counter
from datetime import datetime, timezone
from math import ceil
from pathlib import Path
import shlex
import sys

import numpy as np
from rich.console import Console

from beetle_omni_ros import __version__
from beetle_omni_ros.control import registry
from beetle_omni_ros.control.base import guidance_of
from beetle_omni_ros.flight import fault_flights as flights
from beetle_omni_ros.flight.campaign import file_digest, Store, sweep
from beetle_omni_ros.flight.fault_flights import PLAN
from beetle_omni_ros.model.files import write_json, write_text
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.model.resources import commit
from beetle_omni_ros.model.schema import ParameterError
from beetle_omni_ros.show import page
from beetle_omni_ros.show.figures import AMBER, GREEN, RED
from beetle_omni_ros.sim.faults import Case, chosen, load_cases

# --- page ----------------------------------------------------------------------------------------

NOTE = ('good: flights with the expected outcome or a better one. impact: speed of base_link at '
        'the fastest touchdown of a flight. named: median time until the supervisor detected a '
        'fault.')
FAULT, PARTLY, SUCCESS = RED, AMBER, GREEN
SOFTLY = f'{PLAN.impact_speed:g} m/s and {np.degrees(PLAN.inclination):.0f} deg'
# Outcome -> meaning, the best outcome first.
OUTCOMES = {
    'flies_on': f'still flying when the landing was requested; it ended below {SOFTLY}',
    'refused': 'the same, and the request was refused',
    'lands': f'landed by itself, below {SOFTLY}',
    'stops': f'broke at the floor; the motors were off within {PLAN.stop_time:g} s and stayed off',
    'hard': f'touched down intact, above {PLAN.impact_speed:g} m/s',
    'tilted': f'touched down softly but beyond {np.degrees(PLAN.inclination):.0f} deg',
    'does not land': 'motors on long after the landing was requested',
    'crash, motors on': f'broke, and thrust was commanded for more than {PLAN.stop_time:g} s',
    'takes off': f'rose by {PLAN.rise:g} m after lying on the floor for {PLAN.rest_time:g} s',
    'flyaway': f'{PLAN.fence_margin:g} m outside the fence, or {PLAN.distance:g} m away',
    'error': 'a part of the flight stack raised an exception'}


def summary(flights: list[dict], cases: dict[str, Case]) -> dict:
    """
    Summarise flights.

    Returns:
        ``faults``: name of the fault, or landing or healthy flight with its conditions -> numbers
        of its flights; ``total``: the sums.

    """
    groups: dict[str, list[dict]] = {}
    for one in flights:
        name = one['case'] if one['start'] else f"{one['case']}, {one['conditions']}"
        groups.setdefault(name, []).append(one)
    return {'faults': {name: _row(flown, cases) for name, flown in groups.items()}, 'total': {
        'flights': len(flights), 'good': sum(one['good'] for one in flights),
        'flyaways': sum(one.get('flyaway', False) for one in flights),
        'motors_on_after_crash': sum(
            one.get('overrun_s', 0.0) > PLAN.stop_time for one in flights),
        'takeoffs': sum(one.get('takeoffs', 0) > 0 for one in flights),
        'errors': sum(bool(one['error']) for one in flights)}}


def _row(flown, cases):
    def known(key):
        return [one[key] for one in flown if one.get(key) is not None]

    def median(key):
        return float(np.median(known(key))) if known(key) else None

    case = cases[flown[0]['case']]
    alarms = Counter(text for one in flown for *_, text in one.get('alarms', ()))
    return {
        'what': case.what, 'expected': case.expected,
        'flights': len(flown), 'good': sum(one['good'] for one in flown),
        'outcomes': dict(Counter(one['outcome'] for one in flown).most_common()),
        'impact_median_m_s': median('impact_m_s'),
        'impact_worst_m_s': max(known('impact_m_s'), default=None),
        'inclination_worst_deg': None if flown[0]['start'] else max(known('inclination_deg'),
                                                                    default=None),
        'named': dict(Counter(filter(None, known('named'))).most_common()),
        'named_s': median('named_s'),
        'hours': sum(known('flown_s')) / 3600, 'alarms': dict(alarms.most_common())}


def grid(results: dict, narrow: bool = False) -> page.Grid:
    """Table of the summary; ``narrow``: for 80 columns. Columns without content are left out."""
    rows = results['summary']['faults']
    cells = [[
        name, row['expected'], f"{row['good']}/{row['flights']}",
        _counted(row['outcomes'], '\n' if narrow else ', '), page.number(row['impact_worst_m_s']),
        page.number(row['inclination_worst_deg']), page.number(row['named_s']),
        _counted(row['alarms']),
        *([] if narrow else [page.number(row['impact_median_m_s']), row['what']])]
        for name, row in rows.items()]
    header = ['fault', 'expected', 'good', 'outcomes', 'impact worst [m/s]',
              'inclination worst [deg]', 'named [s]', 'alarms', 'impact median [m/s]',
              'what happens']
    shown = [k for k in range(len(cells[0]))
             if any(row[k] not in ('', page.ABSENT) for row in cells)]
    return page.Grid('', [header[k] for k in shown], [[row[k] for k in shown] for row in cells],
                     note=NOTE)


def total_text(results: dict) -> str:
    """Summary of the campaign in one sentence."""
    total = results['summary']['total']
    return (f"{total['good']} of {total['flights']} flights ended as expected; "
            f"{total['flyaways']} flyaways, {total['motors_on_after_crash']} with motors on after "
            f"a crash, {total['takeoffs']} take-offs without arming, {total['errors']} errors.")


def as_page(results: dict, folder: Path | None = None) -> str:
    """All results as one HTML page; ``folder`` is its folder, which contains recorded bags."""
    meta, total, flights = results['meta'], results['summary']['total'], results['flights']
    severe = any(total[key] for key in ('flyaways', 'motors_on_after_crash', 'takeoffs', 'errors'))
    colour = FAULT if severe else SUCCESS if total['good'] == total['flights'] else PARTLY
    made = [meta['command'], meta['date'], f"version {meta['version']}"
            + (f", commit {meta['commit']}" if meta['commit'] else '')]
    bags = f'Page of one flight: beetle_omni report {folder}/bags/BAG --output flight.html' \
        if any(one['bag'] for one in flights) else ''
    bad = [one for one in flights if not one['good']]
    return page.page(
        'Faults', ' · '.join(made), [grid(results)],
        [f'{name}: {text}' for name, text in OUTCOMES.items()],
        [*([page.section('Flights that did not end as expected', '', page.html(_flights(bad)))]
           if bad else []), page.section('Each flight', bags, page.html(_flights(flights)))],
        page.verdict_head(f"{total['good']} of {total['flights']} as expected", colour,
                          total_text(results)))


def _flights(flights):
    """Table with one row for each flight."""
    return page.Grid('', ['fault', 'from', 'seed', 'conditions', 'expected', 'outcome',
                          'impact [m/s]', 'first message', 'bag'], [
        [*(str(one.get(key, page.ABSENT)) for key in (
            'case', 'start', 'seed', 'conditions', 'expected', 'outcome')),
         page.number(one.get('impact_m_s')), one.get('said') or one['error'] or page.ABSENT,
         one['bag'] or page.ABSENT] for one in flights])


def _counted(counts, between=', '):
    return between.join(f'{count} {text}' for text, count in counts.items())


# --- command -------------------------------------------------------------------------------------

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
        if start not in flights.ALL_STARTS:
            raise ParameterError(f"--from '{start}': expected {', '.join(flights.ALL_STARTS)}")
    if bags and output is None:
        raise ParameterError('--bags: expected --output DIR to record to')
    RobotParameters.load(plant)
    guidance = guidance_of(entry.make(RobotParameters.load()))  # refuses an unusable controller
    common = {'controller': entry.reference, 'plant': str(plant or ''),
              'listed': file_digest(faults) if faults else ''}
    under, begins, count = (conditions,), starts or flights.STARTS, seeds
    if landings:
        struck = [flights.LANDING_BLIND if without_mocap else flights.LANDING]
        begins, count = ('',), landings
    elif healthy:
        struck, begins, under = [flights.HEALTHY], ('',), flights.CONDITIONS
        count = ceil(3600 * healthy / PLAN.healthy_time)
    folder = output / 'bags' if bags else None
    calls = [(flights.FaultFlight(case.name, start, k, name, **common), case, folder)
             for case in struck for start in begins for name in under
             for k in range(seed, seed + count)]
    store = Store(output / FLIGHTS) if output else None
    flown = sweep(flights.fly_case, calls, store=None if bags else store, jobs=jobs,
                  console=console)      # a stored flight records no bag
    results = {'meta': {
        'command': shlex.join(['beetle_omni', *sys.argv[1:]]), 'version': __version__,
        'commit': commit(), 'date': datetime.now(timezone.utc).strftime('%Y-%m-%d'),
        'guidance': guidance, 'plant': str(plant) if plant else None},
        'flights': flown, 'summary': summary(flown, {case.name: case for case in struck})}
    write_json(json_path, results)
    if output:
        write_json(output / 'faults.json', results)
        write_text(output / PAGE, as_page(results, output), 'page')
        write_text(output / 'faults.md', f"# Faults\n\n{results['meta']['command']}\n\n"
                   f'{total_text(results)}\n\n{page.markdown(grid(results))}', 'page')
    page.print_grids([grid(results, narrow=True)], console)
    console.print(total_text(results), highlight=False, markup=False, soft_wrap=True)
    page.print_end(console, [output and output / PAGE, json_path],
                   f'open {output / PAGE} in a browser' if output else
                   'the same with --output DIR writes a page')
    return results
