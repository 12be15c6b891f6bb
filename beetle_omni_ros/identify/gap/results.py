"""The analysis as JSON, as tables, and as one sentence."""

from dataclasses import asdict
import math

import numpy as np

from beetle_omni_ros import __version__
from beetle_omni_ros.identify.gap.analysis import Analysis, JUDGED
from beetle_omni_ros.identify.gap.candidates import Trial
from beetle_omni_ros.identify.gap.parameters import GapParameters
from beetle_omni_ros.identify.gap.rollouts import HORIZONS
from beetle_omni_ros.identify.gap.verdict import hidden
from beetle_omni_ros.pages.page import ABSENT, Grid
from beetle_omni_ros.robot.effects import CATALOGUE, separating_experiment
from beetle_omni_ros.robot.parameters import RobotParameters

CANDIDATES = 'Candidates, after the last step'     # title of a table
WORDS = {'no_gap': 'no gap', 'named': 'named', 'named_set': 'one of a set',
         'unknown': 'unknown: none of the known effects', 'not_decidable': 'not decidable',
         'bad_data': 'bad data: a recording cannot be used'}
MOST_NAMED = 6          # entries of a list in a sentence
LOPSIDED = 0.2          # asymmetry of an interval from which a sentence states both ends
SPELLED = {'imu': 'IMU', 'mocap': 'MoCap'}


def results(a: Analysis, robot: RobotParameters, p: GapParameters, meta: dict) -> dict:
    """Plain data of ``gap --json``; ``meta`` is added."""
    judged = a.gaps.get(HORIZONS[JUDGED], {})
    result = {
        'verdict': a.verdict, 'reason': a.reason, 'closure': judged.get('closure'),
        'gap_before': judged.get('before'), 'gap_after': judged.get('after'),
        'noise_floor': 1.0 if judged else None,
        'effects': [_effect(a, trial, robot) for trial in a.accepted],
        'partial': [_effect(a, trial, robot) for trial in a.partial],
        'where': a.where[:40],
        'candidates': _candidates(a),
        'next_experiment': a.experiment,
        'horizons': {f'{h:g} s': values for h, values in a.gaps.items()},
        'regimes': a.regimes, 'held_out': a.held_out, 'findings': a.findings,
        'bad_data': [{'run': d.run, 'topic': d.topic, 'cause': d.cause, 'at_s': d.at_s,
                      'sure': d.sure, 'fix': d.fix} for d in a.damages],
        'modules_of_the_file': bool(a.models[0] and a.models[0][0].modules),
        'meta': {**meta, 'version': __version__}}
    if a.problem is not None:
        count, remainder = len(a.problem.time), a.remainder
        before, after, floor = a.found.cost
        result |= {'explained': a.found.explained if a.found.accepted else None,
                   'excess': {'samples': count, 'before': before, 'after': after,
                              'everything': floor},
                   'hidden': [*hidden(a, p), *a.undetectable], 'tolerances': _tolerances(a),
                   'remainder': {'gain': remainder.gain, 'positive': remainder.positive,
                                 'frame': remainder.frame, 'channels': dict(remainder.channels),
                                 'terms': dict(remainder.terms)},
                   'patterns': [asdict(pattern) for pattern in a.patterns],
                   'rhythm': asdict(a.spectral_line)}
    result['summary'] = summary(result)
    return result


def headline(result: dict) -> str:
    """Verdict and named effects."""
    names = ', '.join(_label(effect) for effect in result['effects'])
    return f"{WORDS[result['verdict']]}{': ' + names if names else ''}"


def _label(effect):
    """Names of an effect or candidate with the number of its rotor or joint."""
    member = effect.get('rotor') or effect.get('joint')
    names = ' or '.join(effect.get('names') or [effect['name']])
    return names + (f' {member}' if member else '')


def _effect(a, trial, robot):
    c = trial.candidate
    rivals = a.found.rivals.get(c.label, [])
    names = list(dict.fromkeys([c.name, *(t.candidate.name for t in rivals)]))
    result = {'names': names, 'parameters': parameters(a, c.name, c.keys, a.found.theta, robot),
            'evidence': evidence(a, trial), 'layer': CATALOGUE[c.name].layer}
    if c.member is not None:
        result[CATALOGUE[c.name].each] = c.member
    if rivals:
        result['rivals'] = [{
            'name': t.candidate.name, 'gain': t.gain,
            **({CATALOGUE[t.candidate.name].each: t.candidate.member}
               if t.candidate.member else {}),
            'parameters': parameters(a, t.candidate.name, t.candidate.keys, t.theta, robot,
                                     with_intervals=False)} for t in rivals]
        result['separated_by'] = separating_experiment(names)
    return result


def parameters(a: Analysis, name: str, free: tuple[str, ...], theta: dict[str, float],
               robot: RobotParameters, with_intervals: bool = True) -> dict:
    """Parameter -> value, unit, 95 % interval of one effect."""
    result = {}
    own = [key for key in a.keys.values() if key.effect == name]
    member = bool(CATALOGUE[name].each)
    for parameter, spec in CATALOGUE[name].parameters.items():
        keys = [key for key in own if key.parameter == parameter
                and (not member or key.name in free)]
        values = [key.value(theta.get(key.name, 0.0)) for key in keys]
        bases = [key.base for key in keys]
        entry: dict = {'value': values if len(values) > 1 else values[0], 'unit': spec.unit,
                       'file': bases if len(bases) > 1 else bases[0]}
        if with_intervals:
            widths = [key.width(theta.get(key.name, 0.0), a.widths.get(key.name, 0.0))
                      if key.name in free else 0.0 for key in keys]
            # Clip intervals to the physical range.
            spans = [[max(v - w, min(v, spec.low)), min(v + w, max(v, spec.high))]
                     for v, w in zip(values, widths, strict=True)]
            entry['interval'] = spans if len(spans) > 1 else spans[0]
        result[parameter] = entry
    if name == 'joint_friction':
        at_least(result['stiction'], result['coulomb'])
    return result


def at_least(stiction: dict, coulomb: dict) -> None:
    """Raise the stiction to the Coulomb friction."""
    if stiction['value'] >= coulomb['value']:
        return
    stiction['value'] = coulomb['value']
    if 'interval' in stiction:
        low, high = coulomb['interval']
        stiction['interval'] = [low, max(high, stiction['interval'][1])]


def evidence(a: Analysis, trial: Trial) -> dict:
    """Numbers behind a decision."""
    count = len(a.fit.time)
    held = trial.held
    return {'delta_bic': trial.gain - len(trial.candidate.keys) * math.log(count),
            'delta_chi2': trial.gain, 'cv_gain': held.total, 'cv_gain_se': held.sigmas,
            'blocks_positive': held.positive, 'explained_share': trial.share}


def _candidates(a):
    result = []
    taken = {t.candidate.label for t in a.found.accepted}
    for label, trial in sorted(a.found.trials.items(), key=lambda lt: -lt[1].gain):
        seen = a.detectability.get(label)
        row = {'name': trial.candidate.name, 'accepted': label in taken,
               'evidence': evidence(a, trial), 'reason': trial.reason,
               'sigma_of_realistic_size': seen.sigma if seen else None,
               'sigma_beside_rivals': seen.rivals if seen else {}}
        if ' (' in label:
            row['form'] = label.partition(' (')[2].rstrip(')')
        if trial.candidate.member is not None:
            row[CATALOGUE[trial.candidate.name].each] = trial.candidate.member
        result.append(row)
    return result


def _tolerances(a):
    """Fitted tolerances of this robot, which are not named."""
    theta = a.found.theta
    return {name: {'deviation': theta.get(name, 0.0), 'relative': a.keys[name].relative}
            for name in a.problem.priors if abs(theta.get(name, 0.0)) > 0}


def grids(result: dict) -> list[Grid]:
    """Tables: effects, free runs, largest residuals and best candidates."""
    tables = []
    if result.get('bad_data'):
        tables.append(_damages(result['bad_data']))
    if result['effects'] or result['partial']:
        rows = []
        for effect in result['effects'] or result['partial']:
            name = _label(effect)
            for k, (parameter, entry) in enumerate(effect['parameters'].items()):
                rows.append([name if k == 0 else '', f"{parameter} [{entry['unit']}]",
                             _numbers(entry['value']), _spans(entry.get('interval')),
                             _numbers(entry['file']),
                             f"{effect['evidence']['delta_bic']:.0f}" if k == 0 else ''])
            rows += [[f'or {_label(rival)}' if k == 0 else '', f"{parameter} [{entry['unit']}]",
                      _numbers(entry['value']), '', _numbers(entry['file']), '']
                     for rival in effect.get('rivals', [])
                     for k, (parameter, entry) in enumerate(rival['parameters'].items())]
        title = 'Effects' if result['effects'] else 'Partial explanation, not accepted'
        tables.append(Grid(
            title, ['effect', 'parameter', 'value', '95 %', 'in the file', 'delta BIC'], rows,
            note='95 %: interval that contains the true value in 95 of 100 cases. delta BIC: '
                 'gain minus the price of each parameter; 10 is strong evidence.'))
    if result['horizons']:
        tables.append(_horizons(result))
    if result['where']:
        named = bool(result['effects'])
        rows = [[w['channel'], w['regime'], _cell(w['excess']),
                 *([_cell(w['excess_after'])] if named else [])] for w in result['where'][:6]]
        tables.append(Grid('Largest residuals',
                           ['channel', 'regime', *(['before', 'after'] if named else ['RMS'])],
                           rows, note='RMS of measured minus expected, in standard deviations of '
                                      'the noise.'))
    if result['candidates']:
        tables.append(_evidence(result['candidates'], 8))
    return tables


def _horizons(result):
    """Errors of free runs; columns about effects only if an effect is named."""
    columns = {'before': ('before', 'before: without the named effects, tolerances as fitted.'),
               'after': ('after', 'after: with them.'),
               'effects_alone': ('file + effects', 'file + effects: the robot file with the '
                                 'effects and without fitted tolerances.'),
               'placebo': ('sign reversed', 'sign reversed: a control that must not help.'),
               'closure': ('closure', 'closure: closed share of the gap.')}
    rows = result['horizons']
    what = 'Simulation from measured states and commands; 1 is pure noise. '
    if 'joints' in result:
        what = 'Simulation of the servos over the log; 1 is the error of the most flexible fit. '
        columns['before'] = ('before', 'before: the robot file.')
        del columns['effects_alone']        # the same as after
    if result['effects']:
        columns = {k: v for k, v in columns.items()
                   if any(row[k] is not None for row in rows.values())}
    else:
        columns = {'before': ('error', '' if 'joints' in result else
                              'Tolerances of this robot as fitted.')}
    where = 'the held-out part' if 'joints' in result else \
        'held-out flights' if result['held_out'] else 'the fitted flights'
    return Grid(f'Free runs on {where}: error over noise floor',
                ['horizon', *(head for head, _ in columns.values())],
                [[h, *(_cell(row[k]) for k in columns)] for h, row in rows.items()],
                note=what + ' '.join(note for _, note in columns.values()))


def _evidence(rows, most):
    detectability = any(r['sigma_of_realistic_size'] is not None for r in rows)
    shown = [[_label(r) + (f" ({r['form']})" if r.get('form') else ''),
              f"{r['evidence']['delta_chi2']:.0f}",
              *([_cell(r['sigma_of_realistic_size'])] if detectability else []),
              'accepted' if r['accepted'] else r['reason']] for r in rows[:most]]
    note = 'gain of chi2: decrease of the squared residual over noise beside the accepted ' \
           'entries; of an accepted entry: increase without it. (2): second form of an entry.'
    if detectability:
        note += ' detectability: standard deviations that a typical size would show.'
    return Grid(CANDIDATES,
                ['entry', 'gain of chi2', *(['detectability [sigma]'] if detectability else []),
                 'decision'], shown, note=note)


def _damages(rows):
    shown = [[row['run'], row['topic'], row['cause'],
              ABSENT if row['at_s'] is None else f"{row['at_s']:.1f}", f"{row['sure']:.1%}",
              row['fix'] or 'no'] for row in rows]
    return Grid('Damages of the recordings',
                ['recording', 'topic', 'likely cause', 'from [s]', 'sure', '--fix'], shown,
                note='from: time after the first IMU message. sure: probability among the '
                     'compared causes. --fix: correction that the option applies.')


def _cell(value):
    return ABSENT if value is None or not np.isfinite(value) else f'{value:.2f}'


def _numbers(value):
    return ', '.join(f'{v:.4g}' for v in value) if isinstance(value, list) else f'{value:.4g}'


def _spans(interval):
    if interval is None:
        return ABSENT
    if not np.ptp(interval, axis=-1).any():
        return 'not fitted'
    if isinstance(interval[0], list):
        return ', '.join(f'{a:.3g}..{b:.3g}' for a, b in interval)
    return f'{interval[0]:.4g}..{interval[1]:.4g}'


def summary(result: dict) -> str:
    """The verdict as one or two sentences."""
    verdict = result['verdict']
    if verdict in ('named', 'named_set'):
        parts = [_effect_text(effect) for effect in result['effects']]
        explain = 'explain' if len(parts) > 1 else 'explains'
        return f'{_capital(listed(parts))} {explain} the disagreement. {_closing(result)}'
    if verdict == 'no_gap':
        undetectable = result.get('hidden') or []
        text = 'Model and measurement agree to within noise and manufacturing tolerance.'
        if not undetectable:
            return f'{text} Every known effect of typical size would have been detected.'
        return (f'{text} An effect of typical size of {listed(undetectable, "or")} would not have '
                'been detected in these data.')
    reason = result['reason']
    if verdict == 'not_decidable':
        return f'These data cannot decide: {reason}.'
    if verdict == 'unknown':
        partial = [' or '.join(e['names']) for e in result.get('partial') or []
                   if e['names'][0] not in reason]
        tried = f' {_capital(listed(partial))} would explain a part.' if partial else ''
        return f'No known effect explains the disagreement: {reason}.{tried}'
    further = len(result['bad_data']) - 1
    return (reason if reason.endswith('?') else f'{reason}.') + (
        f' {further} more {"fault is" if further == 1 else "faults are"} listed below.'
        if further > 0 else '')


def listed(words: list[str], last: str = 'and') -> str:
    """Join words as 'a, b and c'; a long list ends with the number of others."""
    words = list(words)
    if len(words) > MOST_NAMED:
        words = [*words[:MOST_NAMED - 1], f'{len(words) - MOST_NAMED + 1} others']
    words = [_spelled(word) for word in words]
    return f' {last} '.join(filter(None, [', '.join(words[:-1]), words[-1] if words else '']))


def _spelled(name):
    return ' '.join(SPELLED.get(word, word) for word in name.replace('_', ' ').split(' '))


def _of_file(found):
    """Value of the robot file for a parameter."""
    own = found['file'] if isinstance(found['file'], list) else [found['file']]
    if not any(own):
        return 'none'
    text = ', '.join(f'{value:.3g}' for value in own)
    return text if found['unit'] == '1' else f'{text} {found["unit"]}'


def _effect_text(effect):
    names = [_spelled(name) for name in effect['names']]
    member = next((f' of {kind} {effect[kind]}' for kind in ('rotor', 'joint')
                   if effect.get(kind)), '')
    parameter, found = next(iter(effect['parameters'].items()))
    shapes = CATALOGUE[effect['names'][0]].parameters
    value = found['value'] if isinstance(found['value'], list) else [found['value']]
    spans = found.get('interval') or []
    spans = spans if spans and isinstance(spans[0], list) else [spans]
    sizes = ', '.join(_size(v, span) for v, span in zip(value, spans, strict=False))
    unit = '' if found['unit'] == '1' else f' {found["unit"]}'
    what = f'{parameter}; ' if len(shapes) > 1 else ''
    return (f'{" or ".join(names)}{member} of {sizes}{unit} ({what}robot file: '
            f'{_of_file(found)})')


def _size(value, span):
    if not span:
        return f'{value:.3g}'
    below, above = value - span[0], span[1] - value
    if abs(above - below) > LOPSIDED * (above + below):
        return f'{value:.3g} ({span[0]:.2g} to {span[1]:.2g})'
    return f'{value:.3g} +- {(below + above) / 2:.2g}'


def _closing(result):
    if result.get('closure') is None:
        return 'The gap in free runs is at its noise floor before and after.'
    flights = 'the held-out part of the log' if 'joints' in result else \
        'the held-out flight' if result.get('held_out') else 'the fitted flights'
    return f'Adding it closes {result["closure"]:.0%} of the gap on {flights}.'


def _capital(text):
    return text[:1].upper() + text[1:]
