"""Pages of identify, gap, faults and compare in a real browser: complete, without errors."""

from dataclasses import asdict
import json
from pathlib import Path

from browser import browser, cut_off, opened, WIDTHS
import numpy as np
import pytest
from rotor_logs import bench
from rotor_logs import write as write_bench

from beetle_omni_ros import cli
from beetle_omni_ros.comparison.page import as_page as comparison_page
from beetle_omni_ros.comparison.page import compute, glance, Section
from beetle_omni_ros.faults.page import as_page
from beetle_omni_ros.pages.page import Grid, page, section, verdict_head
from beetle_omni_ros.sim.fault_lists import FaultList

ROOT = Path(__file__).parents[2]
LONG = 'a text of many words that says what was found and what to do about it ' * 3


def rotor(folder):
    log = write_bench(folder / 'bench.csv', bench(np.random.default_rng(0)))
    assert cli.main(['identify', 'rotor', str(log), '--report', str(folder / 'rotor.html')]) == 0
    return (folder / 'rotor.html').read_text()


def comparison(folder):
    results = json.loads((ROOT / 'docs' / 'comparison' / 'comparison.json').read_text())
    return comparison_page(results, [Section('At a glance', LONG, [glance(results)]),
                                     Section('Time', '', [compute(results)])])


def faults(folder):
    flight = {'case': 'rotor_1_stops', 'start': 'upside_down', 'seed': 0, 'conditions': 'nominal',
              'expected': 'lands', 'controller': 'nmpc', 'bag_lost': False,
              'outcome': 'crash', 'good': False, 'error': '', 'said': LONG, 'impact_m_s': 3.0,
              'plant': ''}
    row = {'what': LONG, 'expected': 'lands', 'flights': 3, 'good': 2, 'outcomes': {'crash': 1},
           'impact_median_m_s': 1.0, 'impact_worst_m_s': 3.0, 'named_s': 0.2,
           'inclination_worst_deg': None, 'alarms': {}}
    total = dict.fromkeys(('good', 'flights', 'flyaways', 'motors_on_after_crash', 'takeoffs',
                           'lost_bags', 'errors'), 1)
    meta = {'command': 'beetle_omni faults ' + '--only a_long_name_of_one ' * 3, 'commit': None,
            'date': '2026-11-25', 'version': '0', 'limits': asdict(FaultList.load().limits)}
    return as_page({'meta': meta,
                    'flights': [flight], 'summary': {'faults': {'rotor_1_stops': row},
                                                     'total': total}})


def verdict(folder):
    grid = Grid('Candidates', ['entry', *(f'a number of kind {k} [rad/s]' for k in range(6))],
                [['rotor_acceleration_torque', *['12345.678'] * 6], [LONG, *['1'] * 6]])
    return page('Gap', 'fitted: ' + '/a/long/path/without/a/space' * 6, [grid], [LONG],
                [section('Evidence', LONG, '')], verdict_head('named: x or y', '#123456', LONG))


def committed_comparison(folder):
    return (ROOT / 'docs' / 'comparison' / 'comparison.html').read_text()


@pytest.mark.parametrize('made', [rotor, comparison, committed_comparison, faults, verdict],
                         ids=lambda made: made.__name__)
def test_no_content_is_clipped(made, tmp_path):
    file = tmp_path / 'page.html'
    file.write_text(made(tmp_path))
    with browser() as chromium:
        for width in WIDTHS:
            with opened(chromium, file, width) as shown:
                assert shown.evaluate('document.documentElement.scrollWidth') == width
                assert not cut_off(shown)
                assert shown.locator('section').count() >= 1
