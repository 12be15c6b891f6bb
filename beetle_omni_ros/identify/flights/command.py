"""`beetle_omni gap --format`: flights as tables to verdict and robot file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import exp, log
from pathlib import Path

import numpy as np
from rich.console import Console

from beetle_omni_ros import __version__
from beetle_omni_ros.identify.flights.balance import Balance, SLOW
from beetle_omni_ros.identify.flights.engine import Engine, Solution
from beetle_omni_ros.identify.flights.priors import entries_of, keys_of, spread
from beetle_omni_ros.identify.flights.residual import COMPARED, GROUPS, TableFlight
from beetle_omni_ros.identify.flights.table import Format, read_flight
from beetle_omni_ros.identify.gap.apply import write_corrected
from beetle_omni_ros.identify.gap.body import BodyModel
from beetle_omni_ros.identify.gap.keys import all_keys, extra_keys, Key, tolerances
from beetle_omni_ros.identify.gap.parameters import GapParameters
from beetle_omni_ros.identify.robot_file import check_differs
from beetle_omni_ros.pages.page import Grid, print_grids, Terminal
from beetle_omni_ros.robot.effects import CATALOGUE, separating_experiment
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.robot.schema import ParameterError
from beetle_omni_ros.runs.files import write_json

ALPHA = 0.05
CROWD = 4               # members of a set from which the flights do not decide
# Entries of each group of channels. Those of the torques also need the forces.
FORCES = ('mass', 'thrust_coefficient', 'ground_effect', 'rotor_drag', 'body_drag',
          'axial_inflow', 'translational_lift', 'wind', 'voltage_sag', 'rotor_lag',
          'rotor_dead_time', 'command_latency', 'imu_accelerometer_bias', 'imu_misalignment')
TORQUES = ('inertia', 'centre_of_mass', 'rotor_thrust_coefficient', 'torque_coefficient',
           'rotor_hub_moment', 'propeller_gyroscopic_torque', 'rotor_acceleration_torque')
EXPLAINED = 0.5         # share of the angular acceleration: below, errors exceed what is explained
FEEDBACK = ('the commands explain less than half of the angular acceleration: a controller that '
            'feeds back what the model lacks would be taken for the robot')
LAGS = ('rotor_lag', 'rotor_dead_time', 'command_latency')
# Entries of the comparison of IMU and MoCap.
SENSORS = ('imu_gyroscope_bias', 'mocap_misalignment')


def table_results(runs: Sequence[Path], holdout: Sequence[Path], form: str,
                  robot: Path | None = None, apply: Path | None = None,
                  json_path: Path | None = None, alpha: float = ALPHA,
                  console: Console | None = None) -> dict:
    """
    Find differences between the model and flights that were read from tables.

    Args:
        runs: CSV files of flights, plain or .gz.
        holdout: flights that only judge the corrected model.
        form: name or file of the format of all of them.
        robot: robot file; None: the shipped one.
        apply: robot file to write with the named effects.
        json_path: file of the results.
        alpha: probability of a false alarm that is accepted.
        console: for the tables.

    Returns:
        the results that are written as JSON.

    Raises:
        ParameterError: unusable file, with row and column or key.

    """
    console = console or Terminal()
    check_differs(apply, robot)
    if not 0 < alpha < 1:
        raise ParameterError(f'--alpha {alpha:g}: expected a probability between 0 and 1')
    model, declared = RobotParameters.load(robot), Format.load(form)
    if not {'duty', 'thrust'} & set(declared.signals):
        raise ParameterError(f"--format {form}: expected the key 'duty' or 'thrust'")
    body = BodyModel(model, {**all_keys(model), **extra_keys()}, (0.0, 0.0))
    meta = {'runs': [str(r) for r in runs], 'holdout': [str(h) for h in holdout],
            'robot': str(robot) if robot else 'params/robot.yaml', 'format': declared.name,
            'version': __version__}
    with console.status('reading') as status:
        flights, judging = ([TableFlight(read_flight(path, declared), model, body,
                                         body_keys(model)) for path in paths]
                            for paths in (runs, holdout))
        result = _judged(flights, judging, model, declared, alpha, status.update)
    result['meta'] = meta
    write_json(json_path, result)
    if apply and result['effects']:
        write_corrected(apply, result, model, robot)
    console.print(headline(result), style='bold', highlight=False, markup=False)
    console.print(result['summary'], highlight=False, markup=False)
    for finding in result['findings']:
        console.print(finding, style='dim', highlight=False, markup=False)
    print_grids(grids(result), console)
    if result['next_experiment']:
        console.print(f"Next: {result['next_experiment']}", highlight=False, markup=False)
    if apply:
        console.print(f'corrected robot: {apply}' if result['effects'] else
                      'no effect is named: no robot file is written', highlight=False)
    return result


def body_keys(robot: RobotParameters) -> dict[str, Key]:
    """Keys that the flights of a table may have."""
    return keys_of(robot, {*FORCES, *TORQUES, *SENSORS})


def _engine(flights, robot, declared, alpha, progress):
    """Engine of the flights with the entries that their channels and signals can show."""
    torque = any(name.startswith('torque') for name in flights[0].channels)
    names = set(FORCES) | set(TORQUES if torque else ())
    if any(name.startswith(COMPARED) for name in flights[0].channels):
        names |= set(SENSORS)
    if 'position' not in declared.signals:
        names -= {'ground_effect'}
    if not {'position', 'velocity'} & set(declared.signals):
        names -= {'rotor_drag', 'body_drag', 'axial_inflow', 'translational_lift',
                  'rotor_hub_moment'}
    if 'voltage' not in declared.signals:
        names -= {'voltage_sag'}
    if 'force_x' not in flights[0].channels:
        names -= {'imu_misalignment', 'wind', 'rotor_drag', 'body_drag'}
    keys = keys_of(robot, names)
    tolerance = {key: float(np.max(prior.deviation))
                 for key, prior in tolerances(GapParameters.load()).items()}
    spreads = {name: spread(robot, key, tolerance.get(name, 0.0), declared.clock_deviation)
               for name, key in keys.items()}
    free = LAGS if 'specific_force' not in declared.signals else ()  # the lag of an estimator
    spreads |= {name: replace(spreads[name], narrow=spreads[name].typical)
                for name, key in keys.items() if key.effect in free}
    entries = [entry for entry in entries_of(keys) if entry.name not in free]
    positive = frozenset(name for name, key in keys.items() if key.ends_at_none)
    # A mass is weighed, air is still and sensors have data sheets; maps of thrust differ by half.
    far = frozenset(name for name, key in keys.items() if key.effect not in (
        'mass', 'inertia', 'wind') and CATALOGUE[key.effect].layer not in ('sensor', 'timing'))
    return Engine(flights, list(keys), spreads, entries, positive, far, alpha, progress), keys


def _judged(flights, judging, robot, declared, alpha, progress):
    usable = [flight for flight in flights if flight.usable]
    if all(flight.apart for flight in usable):
        for flight in [*flights, *judging]:
            flight.without(COMPARED, flight.apart)
    groups = _groups(flights[0] if not usable else usable[0], declared)
    if not usable:
        return result_of('bad_data', groups, summary=(
            f'No flight can be used: {flights[0].name} has no block of commands and measurements '
            'in the air.'), false_alarm_probability=None)
    for flight in [*usable, *judging]:
        if flight.usable and flight.channels != usable[0].channels:
            raise ParameterError(f'{flight.name}: its channels are '
                                 f"{', '.join(flight.channels)}, expected those of "
                                 f"{usable[0].name}: {', '.join(usable[0].channels)}")
    findings = [f'{flight.name}: not used, no block of commands and measurements in the air'
                for flight in [*flights, *judging] if not flight.usable] + [
        f'{flight.name}: {flight.apart}, so they are not compared'
        for flight in [*flights, *judging] if flight.apart]
    engine, keys = _engine(usable, robot, declared, alpha, progress)
    solution = engine.run()
    if groups['torque']['used'] and engine.explained(solution, 'torque') < EXPLAINED:
        for flight in [*usable, *judging]:
            flight.without(('torque',), FEEDBACK)
        groups = _groups(usable[0], declared)
        engine, keys = _engine(usable, robot, declared, alpha, progress)
        solution = engine.run()
    progress('judging')
    tests: list[tuple] = [(engine, solution, keys)]
    if slow := [part for f in usable if (part := f.balance(list(keys_of(robot, SLOW))))]:
        groups['torque'] = {'used': True, 'channels': ['torque_x', 'torque_y'],
                            'reason': 'no gyroscope: means of 2 s, by the attitude'}
        tests.append(((balance := Balance(slow, robot)), balance, balance.keys))
    e_value = float(np.logaddexp.reduce([s.e_value for _, s, _ in tests])) - log(len(tests))
    found = [(e, s, own, k, members) for e, s, own in tests if e_value >= log(1 / alpha)
             for k, members in named_of(e, s, alpha)]
    sets = [[s.entries[j] for j in members] for _, s, _, _, members in found]
    error = exp(min(0.0, -e_value))
    verdict = 'not_decidable'
    if found:
        largest = max(map(len, sets))
        verdict = 'named' if largest == 1 else 'named_set' if largest < CROWD else 'not_decidable'
    elif max(s.e_value for _, s, _ in tests) <= log(alpha / (1 - alpha)):   # halves of the prior
        verdict = 'no_gap'
    effects = [effect_of(s, e, own, k, members) for e, s, own, k, members in found]
    gap = gaps_of(engine, solution, [k for e, _, _, k, _ in found if e is engine],
                [flight for flight in judging if flight.usable] or usable)
    unclear = [[entry.name for entry in members] for members in sets if len(members) > 1]
    return result_of(
        verdict, groups, effects=effects if verdict != 'not_decidable' else [],
        partial=effects if verdict == 'not_decidable' else [],
        candidates=[row for _, s, _ in tests for row in candidates_of(s, [
            (k, members) for _, of, _, k, members in found if of is s])],
        where=where_of(engine, solution),
        false_alarm_probability=error, held_out=bool(judging), findings=findings, **gap,
        next_experiment=separating_experiment(unclear[0]) if unclear else None,
        summary=summary_of(verdict, sets, error, solution))


def result_of(verdict: str, groups: dict, summary: str, **more) -> dict:
    """Results that are written as JSON."""
    return {'verdict': verdict, 'effects': [], 'partial': [], 'where': [], 'closure': None,
            'gap_before': None, 'gap_after': None, 'noise_floor': None, 'candidates': [],
            'next_experiment': None, 'groups': groups, 'summary': summary, 'findings': []} | more


def _groups(flight, declared):
    """Each group of channels: whether it is used, and why not."""
    groups = {}
    for group in GROUPS:
        own = {c: why for c, why in flight.reasons.items() if c.startswith(group)}
        used = [c for c, why in own.items() if not why]
        unused = sorted({why for why in own.values() if why})
        groups[group] = {'used': bool(used), 'channels': used,
                         **({'reason': '; '.join(unused)} if unused else {})}
    signals = declared.signals
    groups['joint'] = {'used': False, 'channels': [],
                       'reason': 'not compared for tables' if 'tilt' in signals
                       else 'the rotors do not tilt'}
    return groups


def named_of(engine: Engine, solution: Solution, alpha: float) -> list[tuple[int, list[int]]]:
    """
    Entries of the best set that the flights need, with those that could stand in their place.

    An entry is needed if the set without it is less probable by ``alpha``. Its rivals are the
    entries whose set in its place is more probable than ``alpha`` of the best one.
    """
    if solution.e_value < log(1 / alpha):
        return []
    best, gain = solution.best, engine.gain
    named = []
    for k in best:
        rest = set(best) - {k}
        needed = gain(solution.judge, best, tuple(sorted(rest)))
        if needed < log(1 / alpha):
            continue
        rivals = [(gain(solution.judge, tuple(sorted(rest | {j})), best), j)
                  for j in range(len(solution.entries))
                  if j not in best and j not in solution.banned]
        members = [k, *(j for less, j in sorted(rivals, reverse=True) if less > log(alpha))]
        named.append((-needed, k, members))
    return [(k, members) for _, k, members in sorted(named)]


def effect_of(solution: Solution, engine: Engine, keys: dict[str, Key], k: int,
              members: list[int], starts: dict[str, dict[str, float]] | None = None) -> dict:
    """Names, sizes and evidence of a named entry; ``starts`` as of :class:`BagFlight`."""
    best = solution.posteriors[solution.best]
    index = sorted(i for j in solution.best for i in engine.indices((j,)))
    entry, found = solution.entries[k], {}
    for parameter, spec in CATALOGUE[entry.name].parameters.items():
        own = [(name, key, part) for name in entry.keys
               for key, part in (starts or {}).get(name, {name: 1.0}).items()
               if keys[key].parameter == parameter]
        values, spans = [], []
        for name, of, part in own:
            key, at = keys[of], index.index(engine.index[name])
            middle, half = best.estimate[at] * part, 1.96 * best.deviation[at] * abs(part)
            values.append(key.value(float(middle)))
            spans.append([max(key.value(float(middle - half)), spec.low),
                          min(key.value(float(middle + half)), spec.high)])
        base = [keys[of].base for _, of, _ in own]
        if own:
            found[parameter] = {
                'value': values if len(own) > 1 else values[0], 'unit': spec.unit,
                'interval': spans if len(own) > 1 else spans[0],
                'file': base if len(own) > 1 else base[0]}
    gain = engine.gain(solution.judge, solution.best, tuple(sorted(set(solution.best) - {k})))
    names = list(dict.fromkeys(solution.entries[j].name for j in members))
    result: dict = {'names': names, 'members': [solution.entries[j].label for j in members],
              'parameters': found, 'layer': CATALOGUE[entry.name].layer,
              'evidence': {'ln_bayes_factor': gain, 'delta_bic': 2 * gain,
                           'constancy': -solution.unsteady.get(k, 0.0)}}
    if entry.member is not None:
        result[CATALOGUE[entry.name].each] = entry.member
    return result


def candidates_of(solution: Solution, named: list[tuple[int, list[int]]]) -> list[dict]:
    """Evidence of each entry alone, the largest first."""
    taken = {k for k, _ in named}
    rows = []
    for k, entry in enumerate(solution.entries):
        alone = solution.posteriors.get((k,))
        if alone is not None or k in solution.banned:
            rows.append({'name': entry.name, 'accepted': k in taken,
                         **({'rotor': entry.member} if entry.member else {}),
                         'reason': 'value differs between frequencies' if k in solution.banned
                         else '', 'evidence': {'delta_bic': None if alone is None
                                               else 2 * alone.gain}})
    return sorted(rows, key=lambda row: -(row['evidence']['delta_bic'] or 0.0))


def where_of(engine, solution):
    """Channels by the RMS of the generic discrepancy, which no entry explains."""
    rows = [{'channel': channel, 'regime': 'flight', 'excess': before, 'discrepancy_rms': rms}
            for channel, before, rms in engine.disagreement(solution)]
    return sorted(rows, key=lambda row: -row['excess'])


def gaps_of(engine: Engine, solution: Solution, named: list[int], flights: list) -> dict:
    """Errors over the noise floor without and with the named effects, and closure."""
    before, after, floor, closure = engine.errors(solution, named, flights)
    return {'gap_before': before / floor, 'gap_after': after / floor, 'noise_floor': 1.0,
            'closure': closure}


def summary_of(verdict: str, sets: list[list], error: float, solution: Solution) -> str:
    """The verdict as one sentence."""
    names = ' and '.join(' or '.join(dict.fromkeys(e.label.replace('_', ' ') for e in members))
                         for members in sets)
    chance = f'probability of a false alarm {error:.1g}' if error >= 1e-6 else \
        'probability of a false alarm below 1e-6'
    if verdict == 'named' or verdict == 'named_set':
        return f'{names[:1].upper()}{names[1:]} explain the disagreement ({chance}).'
    if verdict == 'no_gap':
        return f'Model and measurement agree to within noise and tolerance ({chance}).'
    if sets:
        return f'These flights do not separate {names} ({chance}).'
    return f'These flights do not decide whether the model lacks an effect ({chance}).'


def headline(result: dict) -> str:
    """Verdict and names."""
    names = ', '.join(' or '.join(effect['names']) + (f" {effect['rotor']}" if 'rotor' in effect
                                                       else '') for effect in result['effects'])
    return f"{result['verdict'].replace('_', ' ')}{': ' + names if names else ''}"


def grids(result: dict) -> list[Grid]:
    """Tables of effects, channels and groups."""
    tables = []
    rows = []
    for effect in result['effects'] or result['partial']:
        label = ' or '.join(effect['names']) + (f" {effect['rotor']}" if 'rotor' in effect else '')
        for k, (name, entry) in enumerate(effect['parameters'].items()):
            rows.append(['' if k else label, f"{name} [{entry['unit']}]", _text(entry['value']),
                         _span(entry['interval']), _text(entry['file']),
                         '' if k else f"{effect['evidence']['ln_bayes_factor']:.0f}"])
    if rows:
        tables.append(Grid('Effects', ['effect', 'parameter', 'value', '95 %', 'in the file',
                                       'ln B'], rows, note=(
            'ln B: logarithm of the evidence with the effect over that without it; 3 is 20 to '
            '1.')))
    if result['where']:
        tables.append(Grid('Channels', ['channel', 'before', 'unexplained RMS'], [
            [row['channel'], f"{row['excess']:.2f}", f"{row['discrepancy_rms']:.3g}"]
            for row in result['where']], note='before: residual of the robot file over the noise. '
            'unexplained: in m/s^2 or rad/s^2, repeatable and by no entry of the catalogue.'))
    tables.append(Grid('Groups of channels', ['group', 'used', 'reason'], [
        [name, 'yes' if group['used'] else 'no', group.get('reason', '')]
        for name, group in result['groups'].items()]))
    return tables


def _text(value):
    return ', '.join(f'{v:.4g}' for v in value) if isinstance(value, list) else f'{value:.4g}'


def _span(interval):
    pairs = interval if isinstance(interval[0], list) else [interval]
    return ', '.join(f'{low:.4g}..{high:.4g}' for low, high in pairs)
