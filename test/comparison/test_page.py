"""The page of a comparison: complete, self-contained, and the same numbers as the JSON."""

from html.parser import HTMLParser
import io
import json
import re

from made_flights import FAILED, made, made_sweep, TASKS
import numpy as np
import pytest
from rich.console import Console

from beetle_omni_ros.comparison import command, summary
from beetle_omni_ros.comparison import page as comparison_page
from beetle_omni_ros.comparison.flights import Flight
from beetle_omni_ros.runs import published

CONTROLLERS = ('rl', 'nmpc', 'nmpc_published')


def written(folder, flown, tasks=TASKS, controllers=CONTROLLERS, skipped=()):
    """Write the page of ``flown`` and read back page, JSON and Markdown."""
    conditions = list(dict.fromkeys(flight.conditions for flight in flown))
    seeds = sorted({flight.seed for flight in flown})
    results = command._results(flown, (controllers, tasks, conditions, seeds), list(controllers),
                               dict(skipped), None)
    folder.mkdir(exist_ok=True)
    command._write(results, flown, folder, Console(file=io.StringIO(), width=160))
    return (folder / 'comparison.html').read_text(), \
        json.loads((folder / 'comparison.json').read_text()), (folder / 'README.md').read_text()


@pytest.fixture(scope='module')
def whole(tmp_path_factory):
    """Folder, page, JSON and Markdown of a whole comparison, with coarse pictures to save time."""
    folder = tmp_path_factory.mktemp('comparison')
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(comparison_page, 'DOTS', 50)
        return folder, *written(folder, made_sweep())


class Page(HTMLParser):
    """Numbers with their keys, tags with their attributes, and the text of each table."""

    def __init__(self, text):
        super().__init__()
        self.numbers, self.tags, self._key = [], [], None
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        """Store tags, and the key of a number."""
        self.tags.append((tag, dict(attrs)))
        self._key = dict(attrs).get('data-key')

    def handle_data(self, data):
        """Store the text of a number."""
        if self._key:
            self.numbers.append((self._key, data))
            self._key = None


def looked_up(numbers, key):
    for part in key.split('/'):
        numbers = numbers[int(part) if isinstance(numbers, list) else part]
    return numbers


def test_every_number_on_the_page_equals_that_in_the_json(whole):
    _, page, numbers, _ = whole
    shown = Page(page).numbers
    assert len(shown) > 800
    for key, text in shown:
        value = looked_up(numbers, key)
        digits = len(text.partition('.')[2])
        assert value is not None and 'e' not in text, key
        assert abs(float(text) - value) <= 0.5 * 10 ** -digits + 1e-12, key


def test_summary_numbers_follow_from_the_flights(whole):
    _, page, numbers, _ = whole
    keys = {key for key, _ in Page(page).numbers}
    for conditions in ('nominal', 'published'):
        for controller in CONTROLLERS:
            poses = [pose['U_position_m'] for flight in numbers['flights']
                     for pose in flight['metrics']['poses']
                     if (flight['task'], flight['conditions'], flight['controller'])
                     == ('random3', conditions, controller)]
            assert len(poses) == 6
            path = f'summary/tasks/random3/{conditions}/{controller}/U_position_m'
            for name, reduce in (('mean', np.mean), ('min', min), ('max', max)):
                assert f'{path}/{name}' in keys
                assert looked_up(numbers, f'{path}/{name}') == pytest.approx(reduce(poses))


def test_the_page_needs_no_network(whole):
    _, page, _, _ = whole
    for part in ('http://', 'https://', '<script', '<link', 'url(', '@import'):
        assert part not in page
    for tag, attributes in Page(page).tags:
        assert attributes.get('src', 'data:').startswith('data:'), tag
        assert attributes.get('href', '#').startswith('#'), tag


def test_each_table_states_seeds_commands_and_source(whole):
    _, page, _, _ = whole
    tables = re.findall(r'<figure class="table">.*?</figure>', page, re.DOTALL)
    flown = [table for table in tables if 'conditions</figcaption>' in table]
    assert len(flown) == 2 * len(TASKS)
    for table in flown:
        assert 'Seeds 0, 4.' in table
        for seed in (0, 4):
            assert re.search(rf'beetle_omni evaluate --controllers {",".join(CONTROLLERS)} '
                             rf'--task \w+ --conditions \w+ --seed {seed}\b', table)
        assert 'ours, simulated' in table
    kinds = {task: [name for name in ('(Gazebo)', 'published, real robot')
                    if any(name in table for table in flown if f'--task {task}' in table)]
             for task in TASKS}
    assert kinds == {'random3': ['(Gazebo)'], 'force': ['(Gazebo)'], 'torque': ['(Gazebo)'],
                     'waypoints': ['published, real robot'],
                     'lemniscate': ['published, real robot'], 'payload': [], 'hover': []}


def test_published_numbers_keep_their_printed_form(whole):
    _, page, _, _ = whole
    shown = dict(Page(page).numbers)
    base = 'summary/tasks/random3/paper/published_nmpc'
    assert shown[f'{base}/U_orientation_deg/mean'] == '40.99'
    assert shown[f'{base}/U_orientation_deg/max'] == '136.97'
    poses = [float(shown[f'summary/tasks/waypoints/paper/published_rl/by_pose/{k}/U_position_m'
                         '/mean']) for k in range(5)]
    mean = published.WAYPOINTS['RL, real robot']['mean']['U_position_m']
    assert np.mean(poses) == pytest.approx(mean, abs=5e-4)


def test_pictures_named_in_the_markdown_exist(whole):
    folder, _, _, text = whole
    names = re.findall(r'!\[[^\]]*\]\(([^)]+)\)', text)
    assert len(names) > 12
    for name in names:
        assert (folder / name).read_bytes().startswith(b'\x89PNG')
    assert {path.name for path in folder.glob('*.png')} == set(names)


def test_failed_and_crashed_flights_are_reported_and_affect_no_other(tmp_path):
    fell = made('waypoints', duration=21.0)
    fell['metrics'].update(crashed=True, ended='emergency_stop: crash at 20.9 s')
    lost = made('force', duration=13.0)
    lost['metrics']['crashed'] = True
    flown = {Flight('waypoints', 'nominal', 'rl', 0): FAILED,
             Flight('waypoints', 'nominal', 'nmpc', 0): fell,
             Flight('waypoints', 'nominal', 'nmpc_published', 0): made('waypoints'),
             Flight('force', 'nominal', 'rl', 0): lost,
             Flight('force', 'nominal', 'nmpc', 0): FAILED,
             Flight('force', 'nominal', 'nmpc_published', 0): FAILED}
    page, numbers, text = written(tmp_path, flown, ('waypoints', 'force'),
                                  skipped={'rl_memory': 'no such file'})
    assert 'no take-off &lt;within&gt; 30 s' in page and '<within>' not in page
    assert 'touched the ground' in page and 'crash at 20.9 s' in page
    assert 'no such file' in page and 'no such file' in text
    waypoints = numbers['summary']['tasks']['waypoints']['nominal']
    assert waypoints['rl']['failures'] == {'0': FAILED['failure']}
    assert (waypoints['nmpc']['reached'], waypoints['nmpc']['poses']) == (2, 15)
    assert (waypoints['nmpc']['flown'], waypoints['nmpc_published']['flown']) == (2, 15)
    force = numbers['summary']['tasks']['force']['nominal']['rl']['force']
    assert force['lost_at'] == [30.0] and force['withstood_min'] == 20.0


def test_a_page_without_flights_is_written(tmp_path):
    flown = {Flight(task, 'nominal', controller, 0): FAILED for task in TASKS
             for controller in CONTROLLERS}
    page, numbers, _ = written(tmp_path, flown)
    assert all(flight['failure'] for flight in numbers['flights'])
    assert 'no take-off' in page


def test_the_level_of_lost_control_is_a_range_over_the_seeds():
    def flight(level):
        return {'metrics': {'levels': [], 'lost_at_N': level, 'withstood_N': (level or 110) - 10}}

    for levels, expected in (((80.0, 100.0), (80.0, 100.0)), ((80.0, None), (80.0, None)),
                             ((None, None), (None, None))):
        made_levels = summary._levels([flight(level)['metrics'] for level in levels], 'N')
        assert (made_levels['lost_min'], made_levels['lost_max']) == expected
    assert made_levels['withstood_min'] == 100.0


def test_pooled_mean_and_deviation_are_those_of_all_samples():
    samples = np.random.default_rng(0).normal(size=(3, 50)) + [[0.0], [2.0], [-1.0]]
    pooled = summary._pooled([{'m': part.mean(), 's': part.std()} for part in samples], 'm', 's')
    assert pooled == {'mean': pytest.approx(samples.mean()), 'std': pytest.approx(samples.std())}
