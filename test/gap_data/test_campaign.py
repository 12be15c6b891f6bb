"""The campaign from cases to report, with replacements of the workflow."""

from collections import Counter
from dataclasses import replace
import json
import os
import sys

from gap_data.campaign import make_report, run_campaign
from gap_data.cases import Case, DAMAGED, KINDS, load_settings, make_cases
from gap_data.effects import CATALOGUE, OUTSIDE
from gap_data.make import make_case
from gap_data.page import markdown
from gap_data.workflow import run_workflow, Workflow
import pytest

from beetle_omni_ros.robot.parameters import RobotParameters

SETTINGS = load_settings()
META = {'set': 'test', 'seed': 0, 'cases': 2, 'command_age': 0.01, 'command': 'none'}
STUB = """
import json, os, sys
def run_gap(runs, holdout, robot, apply, json_path, page, console):
    assert all((run / 'metadata.yaml').is_file() for run in [*runs, *holdout])
    assert robot.read_text().startswith('#') and len(runs) == 2 and len(holdout) == 1
    names = {names}
    json_path.write_text(json.dumps({{
        'verdict': 'named' if names else 'no_gap', 'closure': 0.9, 'where': [], 'candidates': [],
        'effects': [{{'names': [n], 'evidence': {{}}, 'parameters': {{'mass': {{
            'value': 3.3, 'unit': 'kg', 'interval': [3.2, 3.5]}}}}}} for n in names],
        'gap_before': 2.0, 'gap_after': 1.0, 'noise_floor': 1.0, 'next_experiment': None}}))
    return 0
def noisy(**_):
    raise RuntimeError('a bug')
class Unusable(ValueError):
    pass
def complain(**_):
    raise Unusable('bag: nothing in it')
def refuse(**_):
    print('bag: nothing in it', file=sys.stderr)
    return 2
"""
SMALL = Case('singles', 'hard', 3, (('mass', 0.3, 'plain'),), course='slow', duration=2.0,
             multibody=True, gust=True, tolerance=True, command_age=0.01)


@pytest.fixture(scope='module')
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp('campaign')


@pytest.fixture
def stub(tmp_path, monkeypatch):
    def make(names):
        name = 'stub_' + '_'.join(names or ['nothing'])
        (tmp_path / f'{name}.py').write_text(STUB.format(names=names))
        monkeypatch.setenv('PYTHONPATH', f'{tmp_path}{os.pathsep}'
                           + os.environ.get('PYTHONPATH', ''))
        return name
    return make


def test_cases_follow_from_the_seed():
    one, two = (make_cases(SETTINGS, 'full', 4, 0.01) for _ in range(2))
    assert one == two and len({c.key() for c in one}) == len(one)
    assert {c.key() for c in make_cases(SETTINGS, 'full', 5, 0.01)}.isdisjoint(
        c.key() for c in one)


def test_the_full_set_contains_every_name_and_kind():
    cases = make_cases(SETTINGS, 'full', 0, 0.01)
    for difficulty in ('clean', 'hard'):
        names = {c.effects[0][0] for c in cases
                 if c.kind == 'singles' and c.difficulty == difficulty}
        assert names == set(CATALOGUE)
    assert {c.effects[0][0] for c in cases if c.kind == 'outside'} == set(OUTSIDE)
    assert {c.damage for c in cases if c.kind == 'damaged'} == set(DAMAGED)
    assert set(Counter(c.kind for c in cases)) == set(KINDS)
    hard = [c for c in cases if c.difficulty == 'hard' and c.kind == 'singles']
    assert all(c.multibody and c.gust and c.tolerance for c in hard)
    assert {c.conditions for c in hard} == {'nominal', 'published'}
    assert {c.noise for c in cases if c.kind == 'none'} == {1.0, 2.0}


def test_ordinary_sizes_are_three_detection_limits_or_more():
    for case in make_cases(SETTINGS, 'full', 1, 0.01):
        if case.kind in ('singles', 'pairs'):
            for name, size, _ in case.effects:
                assert abs(size) >= 2.99 * SETTINGS['effects'][name]['limit'], name


def test_a_case_is_generated_once_and_reproducibly(folder, tmp_path):
    first = make_case(SMALL, folder / 'flights', folder / 'sealed')
    assert sorted(p.name for p in first.iterdir()) == ['fit_1', 'fit_2', 'holdout_1', 'robot.yaml']
    changed = {p: p.stat().st_mtime_ns for p in first.rglob('*.mcap')}
    assert make_case(SMALL, folder / 'flights', folder / 'sealed') == first
    assert {p: p.stat().st_mtime_ns for p in first.rglob('*.mcap')} == changed
    again = make_case(SMALL, tmp_path / 'flights', tmp_path / 'sealed')
    for path in changed:
        assert (again / path.relative_to(first)).read_bytes() == path.read_bytes()
    label = json.loads((folder / 'sealed' / f'{SMALL.key()}.json').read_text())
    assert label['effects'][0]['parameters']['mass'] == pytest.approx(3.0386 + 0.3, abs=0.02)
    assert not [p for p in first.rglob('*') if p.suffix == '.json']


@pytest.mark.parametrize('name', ['mass', 'module_reaction'])
def test_the_given_robot_file_describes_no_hidden_effect(tmp_path, name):
    case = replace(SMALL, effects=((name, 0.3 if name == 'mass' else 1.0, 'plain'),), fit=1,
                   duration=2.0)
    made = make_case(case, tmp_path / 'flights', tmp_path / 'sealed')
    given = RobotParameters.load(made / 'robot.yaml')
    assert (given.multibody is None) == (name == 'module_reaction')
    assert not given.effects


def test_a_campaign_scores_workflows_side_by_side(folder, stub):
    none = replace(SMALL, kind='none', effects=())
    right, silent = stub(['mass']), stub([])
    workflows = [Workflow('right', f'{right}:run_gap'), Workflow('silent', f'{silent}:run_gap')]
    seen = []
    judged = run_campaign([SMALL, none], workflows, folder,
                          done=lambda case, name, j, kept: seen.append((name, kept)))
    assert [j['right'] for j in judged['right']] == [True, False]
    assert [j['right'] for j in judged['silent']] == [False, True]
    assert judged['right'][1]['wrong'] == [['mass']]
    assert judged['right'][0]['parameters'][0]['inside'] == [True]
    assert len(seen) == 4 and not any(kept for _, kept in seen)
    run_campaign([SMALL, none], workflows, folder, done=lambda c, n, j, kept: seen.append(
        (n, kept)))
    assert all(kept for _, kept in seen[4:])
    report = json.loads(json.dumps(make_report(judged, META)))
    assert '| none: false alarm | <= 0.05 |' in markdown(report)
    assert 'Power' not in markdown(report)
    for rows in judged.values():
        rows[:] = [{**row, 'kind': 'power', 'multiple': 3.0} for row in rows if row['truth']]
    table = markdown(make_report(judged, META)).partition('## Power')[2].splitlines()
    assert table[2] == '| times the limit | right | right, wrong name | silent | ' \
                       'silent, wrong name |'
    assert [cell.split()[0] for cell in table[4].strip('| ').split(' | ')] == \
        ['3', '1', '0', '0', '0']


def test_a_bug_in_the_workflow_is_counted_and_does_not_stop_the_campaign(folder, stub):
    name = stub([])
    case = make_case(SMALL, folder / 'flights', folder / 'sealed')
    crashed = run_workflow(Workflow('x', f'{name}:noisy'), case)
    assert crashed['traceback'] and crashed['answer'] is None
    for way in ('refuse', 'complain'):
        refused = run_workflow(Workflow('x', f'{name}:{way}'), case)
        assert refused['status'] == 2 and refused['message'] == 'bag: nothing in it'
        assert not refused['traceback']
    endless = f'{sys.executable} -c "import time; time.sleep(60)" {{runs}} {{json}}'
    assert run_workflow(Workflow('x', endless, timeout=0.5), case)['status'] == 124


@pytest.mark.parametrize('damage', ['missing_imu', 'cut', 'rest', 'broken_robot'])
def test_damaged_cases_are_made(tmp_path, damage):
    case = Case('damaged', 'clean', 5, damage=damage, duration=2.0, fit=1,
                course='rest' if damage == 'rest' else 'slow')
    made = make_case(case, tmp_path / 'flights', tmp_path / 'sealed')
    assert (made / 'fit_1').is_dir()
    assert ('\nmass:' in (made / 'robot.yaml').read_text()) == (damage != 'broken_robot')


@pytest.mark.parametrize('only, fits', [
    ('singles,hard', lambda c: c.kind == 'singles' and c.difficulty == 'hard'),
    ('none,pairs,hard', lambda c: c.kind in ('none', 'pairs') and c.difficulty == 'hard'),
    ('clean', lambda c: c.difficulty == 'clean'),
    ('mass,wake', lambda c: {'mass', 'wake'} & {e[0] for e in c.effects}),
    ('singles,mass', lambda c: c.kind == 'singles' and c.effects[0][0] == 'mass')])
def test_a_case_must_match_one_value_of_each_given_filter(only, fits):
    import gap_campaign
    cases = make_cases(load_settings(), 'full', 0, 0.0)
    chosen = gap_campaign.select(cases, only)
    assert chosen == [c for c in cases if fits(c)] and 0 < len(chosen) < len(cases)


def test_the_command_refuses_what_it_cannot_run(capsys, monkeypatch):
    import gap_campaign
    monkeypatch.setenv('PYTHONPATH', '')
    for arguments, text in ((['--set', 'huge'], "--set 'huge'"),
                            (['--robot', 'nowhere.yaml'], 'no such file'),
                            (['--workflow', 'no.such:thing'], 'no module no.such'),
                            (['--backend', 'mars'], 'expected processes or ray'),
                            (['--only', 'singles,bananas'], 'effect is called bananas')):
        assert gap_campaign.main([*arguments, '--cases', '0']) == 2
        assert text in ' '.join(capsys.readouterr().err.split())


def test_the_command_makes_flights_and_a_report(tmp_path, stub, monkeypatch, capsys):
    import gap_campaign
    name = stub([])
    monkeypatch.syspath_prepend(os.environ['PYTHONPATH'].split(os.pathsep)[0])
    settings = load_settings()
    settings['flights']['duration'] = 2.0
    settings['sets']['test'] = {'clean': {'none': 2}}
    monkeypatch.setattr(gap_campaign, 'load_settings', lambda: settings)
    assert gap_campaign.main(['--set', 'test', '--workflow', f'quiet={name}:run_gap', '--jobs',
                              '1', '--folder', str(tmp_path)]) == 0
    report = json.loads((tmp_path / 'report.json').read_text())
    assert [j['right'] for j in report['cases']['quiet']] == [True, True]
    assert str(tmp_path) not in json.dumps(report['meta'])
    assert 'none: false alarm' in capsys.readouterr().out
    assert (tmp_path / 'report.md').is_file()
