"""The campaign from cases to report, with a replacement of the tool."""

from dataclasses import replace
import json
from pathlib import Path
import sys

from gap_data.campaign import run_campaign
from gap_data.cases import Case, OTHERS
from gap_data.make import make_case
from gap_data.score import markdown, score
import pytest
from test_imports import imports

STUB = """
import json, pathlib, sys
words = iter(sys.argv[1:])
assert next(words) == 'gap'
given, place = {{'runs': []}}, 'runs'
for word in words:
    if word.startswith('--'):
        place = word[2:]
    else:
        given.setdefault(place, []).append(word)
assert all(pathlib.Path(run, 'metadata.yaml').is_file()
           for run in given['runs'] + given['holdout'])
assert pathlib.Path(*given['robot']).read_text().startswith('#')
assert len(given['runs']) == 2 and len(given['holdout']) == 1
names = {names}
pathlib.Path(*given['json']).write_text(json.dumps({{
    'verdict': 'named' if names else 'no_gap', 'closure': 0.9, 'where': [], 'candidates': [],
    'effects': [{{'names': [n], 'evidence': {{}}, 'parameters': {{'mass': {{
        'value': 3.3, 'unit': 'kg', 'interval': [3.2, 3.5]}}}}}} for n in names],
    'gap_before': 2.0, 'gap_after': 1.0, 'noise_floor': 1.0, 'next_experiment': None}}))
"""
SMALL = Case('singles', 'hard', 3, (('mass', 0.3, 'plain'),), course='hover', duration=2.0,
             multibody=True, gust=True, tolerance=True)


@pytest.fixture(scope='module')
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp('campaign')


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


def test_a_campaign_keeps_and_scores_the_answers_of_a_tool(folder, tmp_path):
    none = replace(SMALL, kind='none', effects=())
    judged = {}
    for names in (['mass'], []):
        (tmp_path / 'stub.py').write_text(STUB.format(names=names))
        judged[bool(names)] = list(run_campaign(
            [SMALL, none], f'{sys.executable} {tmp_path}/stub.py', folder, version=str(names)))
    assert [j['right'] for j in judged[True]] == [True, False]
    assert [j['right'] for j in judged[False]] == [False, True]
    assert judged[True][1]['wrong'] == [['mass']]
    assert judged[True][0]['parameters'][0]['inside'] == [True]
    (tmp_path / 'stub.py').unlink()
    assert list(run_campaign([SMALL, none], f'{sys.executable} {tmp_path}/stub.py', folder,
                             version='[]')) == judged[False]
    report = json.loads(json.dumps({'meta': {'cases': 2, 'command': 'x'},
                                    'criteria': score(judged[True])}))
    assert '| none: false alarm | <= 0.05 |' in markdown(report)


ROOT = Path(__file__).resolve().parents[2] / 'benchmarks' / 'gap_data'


@pytest.mark.parametrize('path', sorted(ROOT.rglob('*.py')), ids=lambda path: path.stem)
def test_only_messages_and_writer_of_bags_are_those_of_the_package(path):
    names = {name.rpartition('.')[0] for name, _ in imports(path)
             if name.split('.')[0] == 'beetle_omni_ros'}
    shared = 'control.base', 'model.readings', 'bags.bag_writer'
    assert names == ({f'beetle_omni_ros.{name}' for name in shared} if path.stem == 'bags'
                     else set())


def test_the_cache_key_covers_every_file_of_the_generator():
    files, left = set(), ['make']
    while left:
        files.add(file := left.pop())
        left += {name.split('.')[1] for name, _ in imports(ROOT / f'{file}.py')
                 if name.startswith('gap_data.')} - files
    assert {f'{file}.py' for file in files} & OTHERS == {'cases.py'}
