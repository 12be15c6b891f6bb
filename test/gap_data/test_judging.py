"""The score follows its definition."""

import copy

from gap_data.intervals import median, share
from gap_data.judge import judge
from gap_data.score import answer_label, confusion, power, score
from gap_data.workflow import KEYS, read_answer, Workflow, WorkflowError
import pytest

CASE = {'kind': 'singles', 'difficulty': 'hard', 'multiple': 0.0, 'noise': 1.0, 'gust': True,
        'conditions': 'nominal', 'multibody': True, 'damage': '', 'course': 'poses',
        'command_age': 0.01}
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
    return {'answer': answer, 'problems': [], 'status': 0, 'wall_s': 5.0, 'cpu_s': 4.0,
            'traceback': False, 'message': ''}


def test_the_right_name_is_right():
    judged = judge(label(DRAG), run(effect('rotor_drag')))
    assert judged['right'] and judged['exact'] == [True] and not judged['wrong']
    row, = judged['parameters']
    assert row['of_effect'] == pytest.approx(0.025) and row['inside'] == [True]


def test_a_set_with_the_truth_is_right_but_not_exact():
    judged = judge(label(DRAG), run(effect('body_drag', 'rotor_drag'), verdict='named_set'))
    assert judged['right'] and judged['exact'] == [False] and not judged['wrong']


def test_a_set_of_all_names_is_wrong():
    many = effect('rotor_drag', 'a', 'b', 'c', 'd')
    assert not judge(label(DRAG), run(many))['right']


def test_another_name_is_wrong_even_beside_the_right_one():
    judged = judge(label(DRAG), run(effect('rotor_drag'), effect('wind', parameter='force')))
    assert judged['right'] and judged['wrong'] == [['wind']]
    assert not judge(label(DRAG), run(effect('wind', parameter='force')))['right']


def test_the_multibody_description_is_never_a_false_alarm():
    none = label(kind='none', accept=('no_gap',))
    assert judge(none, run(effect('module_reaction')))['right']
    assert not judge(none, run(effect('mass')))['right']
    assert judge(none, run(verdict='no_gap'))['right']
    assert not judge(none, run(verdict='unknown'))['right']
    assert not judge(label(kind='none', accept=('no_gap',), allowed=()),
                     run(effect('module_reaction')))['right']


def test_the_right_effect_on_another_rotor_is_wrong():
    entry = {'value': 0.9, 'interval': (0.89, 0.91), 'parameter': 'scale'}
    assert judge(label(ROTOR), run(effect(ROTOR['name'], rotor=2, **entry)))['right']
    other = judge(label(ROTOR), run(effect(ROTOR['name'], rotor=4, **entry)))
    assert not other['right'] and other['wrong']


def test_a_parameter_error_counts_from_the_described_value():
    judged = judge(label(ROTOR), run(effect(ROTOR['name'], value=0.92, interval=(0.91, 0.93),
                                            parameter='scale')))
    row, = judged['parameters']
    assert row['of_effect'] == pytest.approx(0.2)
    assert row['of_value'] == pytest.approx(0.02 / 0.9)
    assert row['inside'] == [False]


def test_command_delays_may_be_counted_from_the_stamp_or_beyond_the_nominal_age():
    for value, reading in ((0.0205, 'extra'), (0.0305, 'total')):
        row, = judge(label(LAG), run(effect('command_latency', parameter='delay', value=value,
                                            interval=(value - 1e-3, value + 1e-3))))['parameters']
        assert row['reading'] == reading
        assert row['error'] == pytest.approx(0.0005) and row['inside'] == [True]


def test_missing_and_malformed_parameters_are_noted():
    broken = effect('rotor_drag')
    broken['parameters'] = {'coefficient': {'value': [1, 2], 'interval': None}}
    row, = judge(label(DRAG), run(broken))['parameters']
    assert row['missing']


def test_hover_may_be_answered_by_verdict_or_set():
    hover = label({**ROTOR, 'name': 'mass', 'parameters': {'mass': 3.3}}, kind='undecidable',
                  accept=('not_decidable',), sets=('mass', 'thrust_coefficient'))
    assert judge(hover, run(verdict='not_decidable', next_experiment={'fly': 'x'}))[
        'next_experiment']
    assert judge(hover, run(verdict='not_decidable'))['right']
    assert judge(hover, run(effect('thrust_coefficient', 'mass'), verdict='named_set'))['right']
    assert not judge(hover, run(effect('mass')))['right']
    assert not judge(hover, run(verdict='no_gap'))['right']


def test_bad_bags_need_the_verdict_or_one_line():
    bad = label(kind='damaged', accept=('bad_data', 'refused'))
    refused = {'answer': None, 'problems': ['no JSON'], 'status': 2, 'wall_s': 1.0, 'cpu_s': 1.0,
               'traceback': False, 'message': 'bag/: topic imu/data_raw is missing'}
    assert judge(bad, refused)['right']
    assert not judge(bad, {**refused, 'message': 'a\nb'})['right']
    assert not judge(bad, {**refused, 'traceback': True})['right']
    assert judge(bad, run(verdict='bad_data'))['right']
    assert not judge(bad, run(effect('mass')))['right']


def test_scores_of_a_perfect_workflow_and_of_one_without_answers():
    none = label(kind='none', accept=('no_gap',))
    pair = label(DRAG, LAG, kind='pairs')
    right = [judge(label(DRAG), run(effect('rotor_drag'))), judge(none, run(verdict='no_gap')),
             judge(pair, run(effect('rotor_drag'), effect('command_latency', parameter='delay',
                                                          value=0.02, interval=(0.019, 0.021))))]
    silent = [judge(x, run(verdict='no_gap', closure=None)) for x in (label(DRAG), none, pair)]

    def value(rows, name):
        return next(r for r in score(rows)['criteria']['hard'] if r['name'] == name)['value']

    for name, good, bad in (('single: named, or the right set', 1, 0),
                            ('none: false alarm', 0, 0), ('pair: both named', 1, 0),
                            ('pair: at least one named', 1, 0), ('closure, single', 0.9, 0.0),
                            ('interval covers the truth', 1, None)):
        assert value(right, name) == (pytest.approx(good))
        assert value(silent, name) == (bad if bad is None else pytest.approx(bad))


def test_confusion_and_power_count_the_answers():
    right = judge(label(DRAG), run(effect('rotor_drag')))
    wrong = judge(label(DRAG), run(effect('wind')))
    lost = judge(label(DRAG), run(verdict='unknown'))
    assert [answer_label(j) for j in (right, wrong, lost)] == ['rotor_drag', 'wind', 'unknown']
    assert confusion([right, wrong, lost, lost]) == {
        'rotor_drag': {'rotor_drag': 1, 'wind': 1, 'unknown': 2}}
    strong, weak = copy.deepcopy(right), copy.deepcopy(lost)
    strong.update(kind='power', multiple=3.0)
    weak.update(kind='power', multiple=0.5)
    assert [(row['multiple'], row['named']['value']) for row in power([strong, weak])] == [
        (0.5, 0.0), (3.0, 1.0)]


def test_coverage_of_intervals():
    assert share([])['value'] is None
    half = share([True] * 50 + [False] * 50)
    assert half['value'] == 0.5 and half['interval'] == pytest.approx([0.404, 0.596], abs=1e-3)
    assert share([True] * 20)['interval'][1] == pytest.approx(1.0)
    middle = median([1.0, 2.0, None, 3.0])
    assert middle['value'] == 2.0 and middle['count'] == 3


def test_an_answer_is_checked_against_the_interface(tmp_path):
    path = tmp_path / 'gap.json'
    assert read_answer(path) == (None, ['no JSON'])
    path.write_text('{"verdict": "maybe", "effects": [{"names": ["mass"], "parameters": '
                    '{"mass": {"value": 3.0}}}, 7], "closure": NaN}')
    answer, problems = read_answer(path)
    assert len(answer['effects']) == 1 and answer['closure'] is None
    assert {f'no key {key}' for key in KEYS if key not in ('verdict', 'effects', 'closure')} <= (
        set(problems))
    assert any('maybe' in p for p in problems) and any('interval' in p for p in problems)


def test_workflows_are_parsed_from_the_command_line():
    assert Workflow.parse('mine=a.b:c').name == 'mine'
    assert Workflow.parse('tool {runs} --json {json}').name == 'gap'
    for wrong in ('tool --json x', 'tool {runs}'):
        with pytest.raises(WorkflowError):
            Workflow.parse(wrong)


def test_hover_may_be_named_if_force_and_torque_decide():
    hover = label(ROTOR, kind='undecidable', accept=('not_decidable',)) | {'name_is_right': True}
    entry = {'value': 0.9, 'interval': (0.89, 0.91), 'parameter': 'scale', 'rotor': 2}
    assert judge(hover, run(effect(ROTOR['name'], **entry)))['right']
    assert not judge(hover, run(effect(ROTOR['name'], **entry), effect('mass')))['right']
