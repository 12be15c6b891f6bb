"""Results of a campaign: summary, table, Markdown and one self-contained page."""

from collections import Counter
from pathlib import Path

import numpy as np

from beetle_omni_ros.faults.flight import HEALTHY, LANDING, Trial
from beetle_omni_ros.pages.page import ABSENT, Grid, markdown, rendered
from beetle_omni_ros.sim.fault_lists import FaultList, OutcomeLimits

NOTE = ('as expected: flights with the expected outcome or a better one. outcomes: with their '
        'number of flights. impact: speed of base_link at the fastest touchdown of a flight. '
        'named after: median time until the supervisor detected a fault.')
SHORT = ('good: as expected or better. impact: the worst. named: median time until a fault was '
         'detected.')
FAULT, PARTLY, SUCCESS = '#b3261e', '#d98a1c', '#2f8f5b'
# Outcome -> meaning, the best outcome first.
OUTCOMES = {
    'flies_on': 'still flying when the landing was requested; it ended below {impact_speed:g} m/s '
                'and {degrees:.0f} deg',
    'refused': 'the same, and the request was refused',
    'lands': 'landed by itself, below {impact_speed:g} m/s and {degrees:.0f} deg',
    'stops': 'broke at the floor; the motors were off within {stop_time:g} s and stayed off',
    'hard': 'touched down intact, above {impact_speed:g} m/s',
    'tilted': 'touched down softly but beyond {degrees:.0f} deg',
    'does not land': 'motors on long after the landing was requested',
    'crash, motors on': 'broke, and thrust was commanded for more than {stop_time:g} s',
    'takes off': 'rose by {rise:g} m after lying on the floor for {rest_time:g} s',
    'flyaway': '{fence_margin:g} m outside the fence, or {distance:g} m away',
    'error': 'a part of the flight stack raised an exception'}


def summary(flights: list[dict], listed: FaultList) -> dict:
    """
    Summarise flights.

    Returns:
        ``faults``: name of the fault, or landing or healthy flight with its conditions -> numbers
        of its flights; ``total``: the sums, with lost_bags None without bags.

    """
    groups: dict[str, list[dict]] = {}
    for one in flights:
        case = listed.cases.get(one['case'])
        name = one['case'] if case else f"{one['case']}, {one['conditions']}"
        groups.setdefault(name, []).append(one)
    bags = [one['bag_lost'] for one in flights if one['bag_lost'] is not None]
    return {'faults': {name: _row(flown, listed) for name, flown in groups.items()}, 'total': {
        'flights': len(flights), 'good': sum(one['good'] for one in flights),
        'flyaways': sum(one.get('flyaway', False) for one in flights),
        'motors_on_after_crash': sum(
            one.get('overrun_s', 0.0) > listed.limits.stop_time for one in flights),
        'takeoffs': sum(one.get('takeoffs', 0) > 0 for one in flights),
        'errors': sum(bool(one['error']) for one in flights),
        'lost_bags': sum(bags) if bags else None}}


def _row(flown, listed):
    def known(key):
        return [one[key] for one in flown if one.get(key) is not None]

    def median(key):
        return float(np.median(known(key))) if known(key) else None

    name = flown[0]['case']
    case, healthy = listed.cases.get(name), name == HEALTHY
    what = case.what if case else 'poses without a fault' if healthy else \
        'landing from a random attitude' + ', motion capture is lost' * (name != LANDING)
    alarms = Counter(text for one in flown for *_, text in one.get('alarms', ()))
    return {
        'what': what, 'expected': case.expected if case else 'flies_on',
        'flights': len(flown), 'good': sum(one['good'] for one in flown),
        'outcomes': dict(Counter(one['outcome'] for one in flown).most_common()),
        'impact_median_m_s': median('impact_m_s'),
        'impact_worst_m_s': max(known('impact_m_s'), default=None),
        'inclination_worst_deg': None if case else max(known('inclination_deg'), default=None),
        'named': dict(Counter(filter(None, known('named'))).most_common()),
        'named_s': median('named_s'), 'said_s': median('said_s'),
        'hours': sum(known('flown_s')) / 3600, 'alarms': dict(alarms.most_common())}


def grid(results: dict, narrow: bool = False) -> Grid:
    """Table of the summary; ``narrow``: for 80 columns. Columns without content are left out."""
    rows = results['summary']['faults']
    columns = {
        'what happens': ['' if narrow else row['what'] for row in rows.values()],
        'expected': [row['expected'] for row in rows.values()],
        'flights': ['' if narrow else str(row['flights']) for row in rows.values()],
        'good' if narrow else 'as expected': [
            f"{row['good']}/{row['flights']}" if narrow else str(row['good'])
            for row in rows.values()],
        'outcomes': [_counted(row['outcomes'], '\n' if narrow else ', ')
                     for row in rows.values()],
        'impact median [m/s]': ['' if narrow else _number(row['impact_median_m_s'])
                                for row in rows.values()],
        'impact [m/s]' if narrow else 'impact worst [m/s]': [
            _number(row['impact_worst_m_s']) for row in rows.values()],
        'inclination [deg]' if narrow else 'inclination worst [deg]': [
            _number(row['inclination_worst_deg']) for row in rows.values()],
        'named [s]' if narrow else 'named after [s]': [
            _number(row['named_s']) for row in rows.values()],
        'alarms': [_counted(row['alarms']) for row in rows.values()]}
    shown = {title: cells for title, cells in columns.items() if any(cells)}
    return Grid('', ['fault', *shown], list(map(list, zip(rows, *shown.values(), strict=True))),
                note=SHORT if narrow else NOTE)


def total_text(results: dict) -> str:
    """Summary of the campaign in one sentence."""
    total = results['summary']['total']
    bags = '' if total['lost_bags'] is None else f"{total['lost_bags']} lost bags, "
    return (f"{total['good']} of {total['flights']} flights ended as expected; "
            f"{total['flyaways']} flyaways, {total['motors_on_after_crash']} with motors on after "
            f"a crash, {total['takeoffs']} take-offs without arming, {bags}"
            f"{total['errors']} errors.")


def as_markdown(results: dict) -> str:
    """All results as Markdown."""
    return (f"# Faults\n\n{results['meta']['command']}\n\n{total_text(results)}\n\n"
            + markdown(grid(results)))


def as_page(results: dict, folder: Path | None = None) -> str:
    """All results as one HTML page; ``folder`` is its folder, which contains recorded bags."""
    meta, total = results['meta'], results['summary']['total']
    limits = OutcomeLimits(**meta['limits'])
    severe = any(total[key] for key in ('flyaways', 'motors_on_after_crash', 'takeoffs', 'errors',
                                        'lost_bags'))
    made = [meta['command'], meta['date'], f"version {meta['version']}"
            + (f", commit {meta['commit']}" if meta['commit'] else '')]
    values = {**vars(limits), 'degrees': np.degrees(limits.inclination)}
    flights = results['flights']
    bags = any(one.get('bag_lost') is not None for one in flights)
    return rendered(
        'faults.html', title='Faults', subtitle=' · '.join(made), total=total,
        sentence=total_text(results), grid=grid(results), folder=folder if bags else None,
        colour=FAULT if severe else SUCCESS if total['good'] == total['flights'] else PARTLY,
        outcomes={name: text.format(**values) for name, text in OUTCOMES.items()},
        bad=_flights([one for one in flights if not one['good']], bags),
        flights=_flights(flights, bags))


def _flights(flights, bags):
    """Table with one row for each flight."""
    header = ['fault', 'from', 'seed', 'conditions', 'expected', 'outcome', 'impact [m/s]',
              'first message', *['bag'] * bags]
    return Grid('', header, [
        [*(str(one.get(key, ABSENT)) for key in (
            'case', 'start', 'seed', 'conditions', 'expected', 'outcome')),
         _number(one.get('impact_m_s')), one.get('said') or one['error'] or ABSENT,
         *(['lost' if one['bag_lost'] else Trial(*(one[key] for key in (
             'case', 'start', 'seed', 'conditions', 'controller', 'plant'))).name] * bags)]
        for one in flights])


def _counted(counts, between=', '):
    return between.join(f'{count} {text}' for text, count in counts.items())


def _number(value):
    return '' if value is None else f'{value:.2f}'
