"""The campaign from cases to report, with replacements of the workflow."""

import ast
from dataclasses import replace
import json
import os
from pathlib import Path

from gap_data.campaign import make_report, run_campaign
from gap_data.cases import Case, GENERATOR
from gap_data.make import make_case
from gap_data.page import markdown
from gap_data.workflow import Workflow
import pytest

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


ROOT = Path(__file__).resolve().parents[2] / 'benchmarks' / 'gap_data'


def imported(path):
    for node in ast.walk(ast.parse(path.read_text(encoding='utf-8'))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield node.module or ''


@pytest.mark.parametrize('path', sorted(ROOT.rglob('*.py')), ids=lambda path: path.stem)
def test_no_file_imports_the_package(path):
    assert not [name for name in imported(path) if name.split('.')[0] == 'beetle_omni_ros']


def test_the_cache_key_covers_every_file_of_the_generator():
    files, left = set(), ['make']
    while left:
        files.add(file := f'{left.pop()}.py')
        left += [name.removeprefix('gap_data.') for name in imported(ROOT / file)
                 if name.startswith('gap_data.')
                 and f'{name.removeprefix("gap_data.")}.py' not in files]
    # `cases` itself is in the key by its content: the case's fields
    assert files - {'cases.py'} <= set(GENERATOR)
