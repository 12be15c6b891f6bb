"""The score follows its definition."""

from gap_data.campaign import KEYS, read_answer
from gap_data.judge import judge
from gap_data.score import score
import pytest

CASE = {'kind': 'singles', 'difficulty': 'hard'}
DRAG = {'name': 'rotor_drag', 'shape': 'plain', 'size': 0.4, 'in_catalogue': True,
        'parameters': {'coefficient': 0.4}}
LAG = {'name': 'command_latency', 'shape': 'plain', 'size': 0.02, 'in_catalogue': True,
       'parameters': {'delay': 0.02}}
ROTOR = {'name': 'rotor_thrust_coefficient', 'shape': 'plain', 'size': -0.1, 'rotor': 2,
         'in_catalogue': True, 'parameters': {'scale': 0.9}}


def label(*effects, kind='singles', accept=(), allowed=('module_reaction',), sets=()):
    return {'case': {**CASE, 'kind': kind}, 'effects': list(effects), 'allowed': list(allowed),
            'accept': list(accept), 'sets': list(sets)}


def effect(*names, value=0.41, interval=(0.38, 0.44), parameter='coefficient', **place):
    return {'names': list(names), 'evidence': {}, **place, 'parameters': {
        parameter: {'value': value, 'unit': '', 'interval': list(interval)}}}


def run(*effects, verdict='named', **more):
    answer = {'verdict': verdict, 'effects': list(effects), 'closure': 0.9, 'gap_before': 4.0,
              'gap_after': 1.2, 'noise_floor': 1.0, 'next_experiment': None, **more}
    return {'answer': answer, 'problems': [], 'wall_s': 5.0, 'cpu_s': 4.0, 'traceback': False,
            'message': ''}


NONE = label(kind='none', accept=('no_gap',))
HOVER = label({**ROTOR, 'name': 'mass', 'parameters': {'mass': 3.3}}, kind='undecidable',
              accept=('not_decidable',), sets=('mass', 'thrust_coefficient'))
WIND = effect('wind', parameter='force')
SECOND, FOURTH = (effect(ROTOR['name'], value=0.9, interval=(0.89, 0.91), parameter='scale',
                         rotor=rotor) for rotor in (2, 4))


@pytest.mark.parametrize(('truth', 'answer', 'right', 'wrong'), [
    (label(DRAG), run(effect('rotor_drag')), True, []),
    (label(DRAG), run(effect('body_drag', 'rotor_drag'), verdict='named_set'), True, []),
    (label(DRAG), run(effect('rotor_drag', 'a', 'b', 'c', 'd')), False, None),
    (label(DRAG), run(effect('rotor_drag'), WIND), True, [['wind']]),
    (label(DRAG), run(WIND), False, [['wind']]),
    (label(ROTOR), run(SECOND), True, []), (label(ROTOR), run(FOURTH), False, None),
    # the multibody description is never a false alarm
    (NONE, run(effect('module_reaction')), True, []), (NONE, run(effect('mass')), False, None),
    (NONE, run(verdict='no_gap'), True, []), (NONE, run(verdict='unknown'), False, []),
    ({**NONE, 'allowed': []}, run(effect('module_reaction')), False, None),
    (HOVER, run(verdict='not_decidable'), True, []), (HOVER, run(verdict='no_gap'), False, []),
    (HOVER, run(effect('thrust_coefficient', 'mass'), verdict='named_set'), True, []),
    (HOVER, run(effect('mass')), False, None)])
def test_an_answer_is_judged_by_its_names(truth, answer, right, wrong):
    judged = judge(truth, answer)
    assert bool(judged['right']) == right
    assert judged['wrong'] == wrong or wrong is None


def test_a_parameter_error_counts_from_the_described_value():
    judged = judge(label(ROTOR), run(effect(ROTOR['name'], value=0.92, interval=(0.91, 0.93),
                                            parameter='scale')))
    row, = judged['parameters']
    assert row['of_effect'] == pytest.approx(0.2)
    assert row['inside'] == [False]


def test_command_delays_may_be_counted_from_the_stamp_or_beyond_the_nominal_age():
    for value in (0.0205, 0.0305):
        row, = judge(label(LAG), run(effect('command_latency', parameter='delay', value=value,
                                            interval=(value - 1e-3, value + 1e-3))))['parameters']
        assert row['error'] == pytest.approx(0.0005) and row['inside'] == [True]


def test_scores_of_a_perfect_workflow_and_of_one_without_answers():
    none = label(kind='none', accept=('no_gap',))
    pair = label(DRAG, LAG, kind='pairs')
    right = [judge(label(DRAG), run(effect('rotor_drag'))), judge(none, run(verdict='no_gap')),
             judge(pair, run(effect('rotor_drag'), effect('command_latency', parameter='delay',
                                                          value=0.02, interval=(0.019, 0.021))))]
    silent = [judge(x, run(verdict='no_gap', closure=None)) for x in (label(DRAG), none, pair)]

    def value(rows, name):
        return next(r for r in score(rows)['hard'] if r['name'] == name)['value']

    for name, good, bad in (('single: named, or the right set', 1, 0),
                            ('none: false alarm', 0, 0), ('pair: both named', 1, 0),
                            ('closure, single', 0.9, 0.0), ('interval covers the truth', 1, None)):
        assert value(right, name) == (pytest.approx(good))
        assert value(silent, name) == (bad if bad is None else pytest.approx(bad))


def test_an_answer_is_checked_against_the_interface(tmp_path):
    path = tmp_path / 'gap.json'
    assert read_answer(path)[0] is None
    path.write_text('{"verdict": "named", "effects": [{"names": ["mass"], "parameters": '
                    '{"mass": {"value": 3.0}}}]}')
    answer, problems = read_answer(path)
    assert answer['verdict'] == 'named' and 'mass without interval' in problems
    assert {f'no key {key}' for key in KEYS if key not in ('verdict', 'effects')} <= set(problems)
