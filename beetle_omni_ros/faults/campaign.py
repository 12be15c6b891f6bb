"""Parallel flights, and the summaries of their results."""

from collections import Counter
from collections.abc import Callable, Iterable, Iterator

import joblib
import numpy as np

from beetle_omni_ros.sim.fault_lists import FaultList


def fly_all(function: Callable, trials: Iterable, *arguments, jobs: int | None = None,
            ) -> Iterator[dict]:
    """
    Call ``function(trial, *arguments)`` for each trial, in processes if there are several.

    Args:
        function: function at the top of a module.
        trials: one for each flight.
        arguments: common arguments.
        jobs: number of parallel flights; None: one on each core.

    Yields:
        results in the order of completion.

    """
    calls = [joblib.delayed(function)(trial, *arguments) for trial in trials]
    width = min(jobs or joblib.cpu_count(), max(1, len(calls)))
    with joblib.parallel_config('loky', n_jobs=width, inner_max_num_threads=1):
        yield from joblib.Parallel(return_as='generator_unordered', batch_size=1,
                                   pre_dispatch='all')(calls)


def summary(results: list[dict], listed: FaultList) -> dict:
    """
    Summarise trials.

    Returns:
        ``faults``: name -> what, expected, flights, good, outcomes, impact_median_m_s,
        impact_worst_m_s, named, named_s and said_s (medians); ``total``: flights, good, share,
        flyaways, motors_on_after_crash, takeoffs, errors, lost_bags (None without bags).

    """
    faults = {}
    for name, case in listed.cases.items():
        flown = [result for result in results if result['case'] == name]
        if flown:
            faults[name] = {'what': case.what, 'expected': case.expected, **_row(flown)}
    bags = [result['bag_lost'] for result in results if result['bag_lost'] is not None]
    good = sum(result['good'] for result in results)
    return {'faults': faults, 'total': {
        'flights': len(results), 'good': good, 'share': good / len(results) if results else None,
        'flyaways': sum(result.get('flyaway', False) for result in results),
        'motors_on_after_crash': sum(
            result.get('overrun_s', 0.0) > listed.limits.stop_time for result in results),
        'takeoffs': sum(result.get('takeoffs', 0) > 0 for result in results),
        'errors': sum(bool(result['error']) for result in results),
        'lost_bags': sum(bags) if bags else None}}


def _row(flown):
    impacts = [result['impact_m_s'] for result in flown
               if result.get('impact_m_s') is not None]
    named = [result for result in flown if result.get('named')]
    said = [result['said_s'] for result in flown if result.get('said_s') is not None]
    return {
        'flights': len(flown), 'good': sum(result['good'] for result in flown),
        'outcomes': dict(Counter(result['outcome'] for result in flown).most_common()),
        'impact_median_m_s': float(np.median(impacts)) if impacts else None,
        'impact_worst_m_s': max(impacts, default=None),
        'named': dict(Counter(result['named'] for result in named).most_common()),
        'named_s': float(np.median([result['named_s'] for result in named])) if named else None,
        'said_s': float(np.median(said)) if said else None}


def landing_summary(results: list[dict]) -> list[dict]:
    """Summarise landings by conditions and motion capture."""
    rows = []
    for conditions, without in sorted({(r['conditions'], r['without_mocap']) for r in results}):
        flown = [r for r in results if (r['conditions'], r['without_mocap'])
                 == (conditions, without)]
        touched = [r for r in flown if r.get('impact_m_s') is not None]
        rows.append({'conditions': conditions, 'mocap': not without, 'landings': len(flown),
                     'good': int(sum(r['good'] for r in flown)),
                     'outcomes': dict(Counter(r['outcome'] for r in flown).most_common()),
                     **_spread('impact', '_m_s', [r['impact_m_s'] for r in touched]),
                     **_spread('inclination', '_deg', [r['inclination_deg'] for r in touched])})
    return rows


def _spread(name, unit, values):
    return {f'{name}_median{unit}': float(np.median(values)) if values else None,
            f'{name}_worst{unit}': max(values, default=None)}


def healthy_summary(results: list[dict]) -> list[dict]:
    """Summarise healthy flights by conditions, with alarms by text."""
    rows = []
    for conditions in dict.fromkeys(r['conditions'] for r in results):
        flown = [r for r in results if r['conditions'] == conditions]
        rows.append({'conditions': conditions, 'flights': len(flown),
                     'hours': sum(r['flown_s'] for r in flown) / 3600,
                     'alarms': dict(Counter(text for r in flown
                                            for _, _, text in r['alarms']).most_common()),
                     'not_landed': sum(r['state'] != 'disarmed' for r in flown),
                     'errors': [r['error'] for r in flown if r['error']]})
    return rows
