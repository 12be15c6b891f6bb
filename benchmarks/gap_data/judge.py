"""One answer against one sealed label."""

from __future__ import annotations

import numpy as np

LARGEST_SET = 4  # a set of more names than this decides nothing
# A wrong place: the right effect on another rotor or joint is a wrong name.
PLACES = ('rotor', 'joint')
# The described value, from which an effect's size is counted; others count from zero.
NOMINAL = {
    ('mass', 'mass'): 3.0386, ('inertia', 'inertia'): [0.0627958, 0.0620796, 0.0948795],
    ('thrust_coefficient', 'scale'): 1.0, ('rotor_thrust_coefficient', 'scale'): 1.0,
    ('torque_coefficient', 'torque_to_thrust_ratio'): 0.0165,
    ('rotor_lag', 'time_constant'): 0.0942,
    ('joint_bandwidth', 'kp'): 0.3449, ('joint_bandwidth', 'kd'): 0.0094}
# Parameters that the interface defines; others of a label are notes.
PUBLIC = {
    'mass': ('mass',), 'centre_of_mass': ('offset',), 'inertia': ('inertia',),
    'thrust_coefficient': ('scale',), 'rotor_thrust_coefficient': ('scale',),
    'torque_coefficient': ('torque_to_thrust_ratio',), 'rotor_drag': ('coefficient',),
    'body_drag': ('coefficient',), 'wind': ('force',), 'ground_effect': ('gain_at_0.25m',),
    'tilt_thrust_loss': ('loss_at_60deg',), 'axial_inflow': ('per_rotor',),
    'propeller_gyroscopic_torque': ('angular_momentum_at_hover',),
    'module_reaction': ('module_inertia',), 'rotor_lag': ('time_constant',),
    'voltage_sag': ('exponent',), 'joint_friction': ('coulomb', 'stiction'),
    'joint_backlash': ('gap',), 'joint_velocity_limit': ('velocity_limit',),
    'joint_bandwidth': ('kp', 'kd'), 'joint_offset': ('offset',),
    'joint_deflection': ('deflection_per_newton',), 'command_latency': ('delay',),
    'joint_command_latency': ('delay',), 'rotor_dead_time': ('delay',),
    'joint_feedback_delay': ('delay',), 'mocap_time_offset': ('delay',),
    'imu_filter_lag': ('delay',), 'imu_accelerometer_bias': ('bias',),
    'imu_gyroscope_bias': ('bias',), 'imu_misalignment': ('rotation',),
    'mocap_misalignment': ('rotation',)}
COMMAND_DELAYS = ('command_latency', 'joint_command_latency', 'rotor_dead_time')


def judge(label: dict, run: dict) -> dict:
    """
    Everything that the score counts about one case.

    Args:
        label: of :func:`gap_data.campaign.open_label`.
        run: of :func:`gap_data.campaign.ask`.

    """
    case, truths = label['case'], label['effects']
    answer = run['answer'] or {}
    refused = (run['status'] == 2 and run['answer'] is None and not run['traceback']
               and bool(run['message']) and '\n' not in run['message'].strip())
    verdict = answer.get('verdict') or ('refused' if refused else 'nothing')
    found = answer.get('effects', [])
    matches = [_match(truth, found) for truth in truths]
    used = {id(effect) for effect in matches if effect is not None}
    allowed = set(label['allowed'])
    wrong = [effect for effect in found
             if id(effect) not in used and not allowed & set(effect['names'])]
    # naming the right one twice (two rotors, say) is wrong as well: it is not in `used`
    named = [effect is not None for effect in matches]
    judged = {
        'kind': case['kind'], 'difficulty': case['difficulty'], 'multiple': case['multiple'],
        'noise': case['noise'], 'gust': case['gust'], 'conditions': case['conditions'],
        'multibody': case['multibody'], 'damage': case['damage'], 'course': case['course'],
        'truth': [t['name'] for t in truths], 'shapes': [t['shape'] for t in truths],
        'sizes': [t['size'] for t in truths],
        'verdict': verdict, 'chance': answer.get('false_alarm_probability'),
        'named': named, 'wrong': [e['names'] for e in wrong],
        'exact': [e is not None and len(e['names']) == 1 for e in matches],
        'answers': [e['names'] for e in found],
        'accepted_verdict': verdict in label['accept'],
        'set_right': _set_right(label, verdict, found),
        'next_experiment': bool(answer.get('next_experiment')),
        'crashed': run['traceback'] or verdict == 'nothing', 'problems': run['problems'],
        'closure': answer.get('closure'), 'gap_before': answer.get('gap_before'),
        'gap_after': answer.get('gap_after'), 'noise_floor': answer.get('noise_floor'),
        'wall_s': run['wall_s'], 'cpu_s': run['cpu_s'], 'message': run['message'][-200:],
        'parameters': [p for truth, effect in zip(truths, matches) if effect is not None
                       for p in _parameters(case, truth, effect)],
    }
    judged['right'] = _right(judged, label)
    return judged


def _match(truth, found):
    """The answer's effect that holds a true name; exact before set, then by evidence."""
    fitting = [effect for effect in found
               if truth['name'] in effect['names'] and len(effect['names']) <= LARGEST_SET
               and all(effect.get(place) in (None, truth[place])
                       for place in PLACES if place in truth)]
    return min(fitting, key=lambda effect: len(effect['names']), default=None)


def _set_right(label, verdict, found):
    """An undecidable flight that is answered by a set with the truth in it."""
    return any(len(e['names']) > 1 and set(e['names']) & set(label['sets'])
               and label['effects'][0]['name'] in e['names'] for e in found)


def _right(judged, label):
    """The case's own criterion."""
    kind = judged['kind']
    if kind in ('singles', 'power'):
        return all(judged['named'])
    if kind == 'pairs':
        return all(judged['named'])
    if kind == 'none':
        return not judged['wrong'] and (
            judged['accepted_verdict'] or judged['verdict'] in ('named', 'named_set'))
    if kind == 'undecidable':
        by_name = label.get('name_is_right') and all(judged['named']) and not judged['wrong']
        return judged['accepted_verdict'] or judged['set_right'] or by_name
    if kind in ('short', 'damaged'):
        # never a name out of noise, never a traceback
        quiet = not judged['wrong'] and not judged['crashed']
        honest = judged['accepted_verdict'] or (
            bool(label['effects']) and all(judged['named']))
        return quiet and honest
    return judged['accepted_verdict']


def _parameters(case, truth, effect):
    """Error and coverage of each public parameter that the answer gives."""
    rows = []
    given = effect.get('parameters') or {}
    for name in PUBLIC.get(truth['name'], ()):
        true = np.atleast_1d(np.array(truth['parameters'][name], float))
        try:
            entry = given[name]
            value = np.atleast_1d(np.array(entry['value'], float))
            interval = np.array(entry['interval'], float).reshape(len(true), 2)
            if value.shape != true.shape:
                raise ValueError
        except (KeyError, TypeError, ValueError):
            rows.append({'effect': truth['name'], 'parameter': name, 'missing': True})
            continue
        rows.append(_row(case, truth['name'], name, true, value, interval))
    return rows


def _row(case, effect, name, true, value, interval):
    delay = name == 'delay'
    reading = 'extra'
    if effect in COMMAND_DELAYS and case['command_age'] > 0:
        total = true + case['command_age']
        if abs(value[0] - total[0]) < abs(value[0] - true[0]):
            true, reading = total, 'total'
    away = np.array(NOMINAL.get((effect, name), np.zeros(len(true))), float)
    size = np.linalg.norm(true - away)
    error = float(np.linalg.norm(value - true))
    inside = (interval[:, 0] <= true) & (true <= interval[:, 1])
    return {'effect': effect, 'parameter': name, 'missing': False, 'true': true.tolist(),
            'value': value.tolist(), 'interval': interval.tolist(), 'error': error,
            'of_effect': error / size if size > 0 else None,
            'of_value': error / float(np.linalg.norm(true)), 'delay': delay,
            'reading': reading if delay else None, 'inside': inside.tolist()}
