"""The page of a comparison: complete, self-contained, and the numbers of its flights."""

import io
import json
import re

from made_flights import FAILED, made, made_sweep, TASKS
import numpy as np
import pytest
from rich.console import Console
from scipy import stats

from beetle_omni_ros.flight import compare as command
from beetle_omni_ros.flight import comparison_page as page
from beetle_omni_ros.flight.compare import ComparedFlight
from beetle_omni_ros.flight.summary import compared, described

CONTROLLERS = ('rl', 'nmpc', 'nmpc_published')


def written(folder, flown, tasks=TASKS, skipped=()):
    """Write the page of ``flown`` and read back page, JSON and Markdown."""
    conditions = list(dict.fromkeys(flight.conditions for flight in flown))
    results = command.results_of(flown, tasks, conditions, dict.fromkeys(CONTROLLERS, 'none'),
                                 dict(skipped))
    folder.mkdir(exist_ok=True)
    command.write(results, flown, folder, Console(file=io.StringIO(), width=160))
    return (folder / 'comparison.html').read_text(), \
        json.loads((folder / 'comparison.json').read_text()), (folder / 'README.md').read_text()


@pytest.fixture(scope='module')
def whole(tmp_path_factory):
    """Folder, page, JSON and Markdown of a whole comparison, with coarse pictures to save time."""
    folder = tmp_path_factory.mktemp('comparison')
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(page, 'DOTS', 50)
        return folder, *written(folder, made_sweep(CONTROLLERS))


def table_of(results, title):
    return next(block for section in page.sections(results, {}) for block in section['blocks']
                if block.title.startswith(title))


def row_of(table, title):
    return next(k for k, row in enumerate(table.rows) if row[0] == title)


def test_numbers_of_a_table_follow_from_the_flights_and_are_on_both_pages(whole):
    _, html, numbers, text = whole
    for conditions in ('nominal', 'published'):
        table = table_of(numbers, f'3 random poses, {conditions}')
        assert table.rows[0][0].startswith('U ‖p error‖ [m]')
        means = []
        for column, controller in enumerate(CONTROLLERS, 1):
            found = [pose['U_position_m'] for flight in numbers['flights']
                     for pose in flight['metrics']['poses']
                     if (flight['task'], flight['conditions'], flight['controller'])
                     == ('random3', conditions, controller)]
            assert len(found) == 6
            cell, means = table.rows[0][column], [*means, np.mean(found)]
            low, high = map(float, re.fullmatch(r'[\d.]+ \[([\d.]+), ([\d.]+)\]', cell).groups())
            assert cell.startswith(f'{means[-1]:.4f} ') and low < means[-1] < high
            assert cell in html and cell in text
            assert table.rows[2][column] == f'{min(found):.4f} to {max(found):.4f}'
        # every flight of a later controller is worse than the same one of an earlier controller
        assert table.rows[1][1] == '–' and (0, 1) in table.best
        for column in (2, 3):
            assert table.rows[1][column].startswith(f'{means[column - 1] - means[0]:.4f} [0.')
    glance = table_of(numbers, 'All experiments')
    row = row_of(glance, '3 random poses, published: U ‖p error‖ [m]')
    assert glance.rows[row][1] == f'{means[0]:.4f}' and (row, 1) in glance.best


def test_the_page_needs_no_network(whole):
    _, html, _, _ = whole
    for part in ('http://', 'https://', '<script', '<link', 'url(', '@import'):
        assert part not in html
    assert set(re.findall(r'src="(\w+:)', html)) == {'data:'}


def test_pictures_named_in_the_markdown_exist(whole):
    folder, _, _, text = whole
    names = re.findall(r'!\[[^\]]*\]\(([^)]+)\)', text)
    assert len(names) == 14
    for name in names:
        assert (folder / name).read_bytes().startswith(b'\x89PNG')
    assert {path.name for path in folder.glob('*.png')} == set(names)


def test_failed_and_crashed_flights_are_reported_and_affect_no_other(tmp_path):
    fell = made('waypoints', duration=21.0)
    fell['metrics'].update(crashed=True, ended='emergency_stop: crash at 20.9 s')
    lost = made('force', duration=13.0)
    lost['metrics']['crashed'] = True
    flown = {ComparedFlight('waypoints', 'nominal', 'rl', 0): FAILED,
             ComparedFlight('waypoints', 'nominal', 'nmpc', 0): fell,
             ComparedFlight('waypoints', 'nominal', 'nmpc_published', 0): made('waypoints'),
             ComparedFlight('force', 'nominal', 'rl', 0): lost,
             ComparedFlight('force', 'nominal', 'nmpc', 0): FAILED,
             ComparedFlight('force', 'nominal', 'nmpc_published', 0): FAILED}
    html, numbers, text = written(tmp_path, flown, ('waypoints', 'force'),
                                  skipped={'rl_any': 'no such file'})
    assert 'no take-off &lt;within&gt; 30 s' in html and '<within>' not in html
    assert 'touched the ground' in html and 'crash at 20.9 s' in html
    assert 'no such file' in html and 'no such file' in text
    waypoints = numbers['summary']['tasks']['waypoints']['nominal']
    assert waypoints['flights']['rl']['failures'] == {'0': FAILED['failure']}
    assert [waypoints['flights'][name]['lost'] for name in CONTROLLERS] == [0, 1, 0]
    reached = waypoints['metrics']['reached']
    assert reached['nmpc']['mean'] == pytest.approx(200 / 15)
    assert [reached[name]['count'] for name in CONTROLLERS[1:]] == [1, 1]
    force = numbers['summary']['tasks']['force']['nominal']['metrics']
    assert force['lost']['rl']['mean'] == 30.0


# --- statistics ----------------------------------------------------------------------------------

def sampled(values):
    return {(0, k): value for k, value in enumerate(values)}


@pytest.mark.parametrize('count', [10, 300])
def test_the_interval_of_normal_values_is_that_of_students_t(count):
    quantiles = stats.norm.ppf((np.arange(count) + 0.5) / count)    # an ideal normal sample
    values = 3.0 + 0.5 * quantiles
    found = described(values)
    low, high = stats.t.interval(0.95, count - 1, values.mean(), stats.sem(values))
    assert found['mean'] == pytest.approx(values.mean())
    width = 0.05 * (high - low)
    assert (found['low'], found['high']) == pytest.approx((low, high), abs=width)


def test_pairing_finds_a_small_difference_below_a_large_spread():
    generator = np.random.default_rng(0)
    poses = generator.uniform(0.0, 1.0, 300)    # the same poses are hard for both
    worse = poses + 0.01 + generator.normal(0, 0.02, 300)
    found = compared({'a': sampled(poses), 'b': sampled(worse)})
    assert found['a']['high'] > found['b']['low']       # the intervals of the means overlap
    assert found['a']['best'] and not found['b']['best']
    assert found['b']['difference']['mean'] == pytest.approx(np.mean(worse - poses))
    shuffled = dict(zip(sampled(worse), generator.permutation(worse), strict=True))
    assert not compared({'a': sampled(poses), 'b': shuffled})['a']['best']


def test_only_what_both_flew_to_the_end_is_paired():
    a, b = sampled([1.0, 2.0, 3.0, 4.0]), sampled([1.5, None, 3.4, np.nan])
    difference = compared({'a': a, 'b': b, 'none': sampled([None] * 4)})
    assert difference['b']['mean'] == pytest.approx(2.45)   # less than that of a, on fewer poses
    assert difference['a']['difference']['count'] == 2
    assert difference['a']['difference']['mean'] == pytest.approx(-0.45)
    assert difference['none']['count'] == 0 and difference['none']['mean'] is None
    assert not any(entry['best'] for entry in difference.values())


def test_a_best_number_differs_from_every_other():
    values = np.linspace(1.0, 2.0, 10)
    near = values + np.where(np.arange(10) % 2, 0.1, -0.09)
    far = values + 1.0
    assert compared({'a': sampled(values), 'far': sampled(far)})['a']['best']
    assert not compared({'a': sampled(values), 'near': sampled(near),
                         'far': sampled(far)})['a']['best']
    assert compared({'a': sampled(values), 'far': sampled(far)}, more=True)['far']['best']
    assert not compared({'a': sampled(values)})['a']['best']
    for count, best in ((1, False), (5, False), (6, True)):     # few flights: no interval
        few = compared({'a': sampled([1.0] * count), 'far': sampled([9.0] * count)})
        assert few['a']['best'] == best and (few['a']['low'] is not None) == best
    same = compared({'a': sampled(values), 'b': sampled(values)})
    assert not same['a']['best'] and not same['b']['best']
