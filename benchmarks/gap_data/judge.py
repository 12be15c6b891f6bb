"""One answer against one sealed label."""

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
COMMAND_DELAYS = ('command_latency', 'joint_command_latency', 'rotor_dead_time')
COMMAND_AGE = 0.010     # [s] of numbers.yaml: answers may count from the stamp


def judge(label: dict, run: dict) -> dict:
    """
    Everything that the score counts about one case.

    Args:
        label: of :func:`gap_data.campaign.open_label`; its ``command_age`` [s] is that from which
            answers may count, instead of that of these flights.
        run: of :func:`gap_data.campaign.ask`.

    """
    truths, answer = label['effects'], run['answer'] or {}
    found = answer.get('effects', [])
    matches = [_match(truth, found) for truth in truths]
    # naming the right one twice (two rotors, say) is wrong as well
    used = {id(effect) for effect in matches if effect is not None}
    judged = {
        **label['case'], 'truth': truths, 'verdict': answer.get('verdict', 'nothing'),
        'chance': answer.get('false_alarm_probability'),
        'answers': [effect['names'] for effect in found],
        'named': [effect is not None for effect in matches],
        'wrong': [effect['names'] for effect in found if id(effect) not in used
                  and not set(label['allowed']) & set(effect['names'])],
        'next_experiment': bool(answer.get('next_experiment')),
        'crashed': run['traceback'] or not answer, 'problems': run['problems'],
        'closure': answer.get('closure'), 'gap_before': answer.get('gap_before'),
        'gap_after': answer.get('gap_after'), 'wall_s': run['wall_s'], 'cpu_s': run['cpu_s'],
        'message': run['message'],
        'parameters': [_row(truth['name'], name, true, effect['parameters'][name],
                            label.get('command_age', COMMAND_AGE))
                       for truth, effect in zip(truths, matches) if effect is not None
                       for name, true in truth['parameters'].items()
                       if name in effect['parameters']]}
    return {**judged, 'right': _right(judged, label, found)}


def _match(truth, found):
    """The answer's effect that holds a true name; exact before set, then by evidence."""
    fitting = [effect for effect in found
               if truth['name'] in effect['names'] and len(effect['names']) <= LARGEST_SET
               and all(effect.get(place) in (None, truth[place])
                       for place in PLACES if place in truth)]
    return min(fitting, key=lambda effect: len(effect['names']), default=None)


def _right(judged, label, found):
    """The case's own criterion."""
    kind, accepted = judged['kind'], judged['verdict'] in label['accept']
    if kind in ('singles', 'pairs'):
        return all(judged['named'])
    if kind == 'none':
        return not judged['wrong'] and (
            accepted or judged['verdict'] in ('named', 'named_set'))
    if kind == 'undecidable':
        by_name = label.get('name_is_right') and all(judged['named']) and not judged['wrong']
        by_set = any(len(e['names']) > 1 and set(e['names']) & set(label['sets'])
                     and label['effects'][0]['name'] in e['names'] for e in found)
        return accepted or by_set or by_name
    return accepted


def _row(effect, name, true, entry, age):
    """Error and coverage of a true parameter that the answer gives."""
    true = np.atleast_1d(true)
    value = np.atleast_1d(entry['value'])
    interval = np.reshape(entry['interval'], (len(true), 2))
    if effect in COMMAND_DELAYS and abs(value[0] - true[0]) > abs(
            value[0] - true[0] - age):
        true = true + age
    size = np.linalg.norm(true - NOMINAL.get((effect, name), np.zeros(len(true))))
    error = float(np.linalg.norm(value - true))
    inside = (interval[:, 0] <= true) & (true <= interval[:, 1])
    return {'effect': effect, 'parameter': name, 'true': true.tolist(), 'value': value.tolist(),
            'interval': interval.tolist(), 'error': error, 'delay': name == 'delay',
            'of_effect': error / size if size > 0 else None, 'inside': inside.tolist()}
