"""Pages in a real browser without a window: no error, nothing from outside, nothing clipped."""

import io
from pathlib import Path
import shutil

import numpy as np
from PIL import Image
import pytest
from rich.console import Console
from rotor_logs import bench
from rotor_logs import write as write_bench
from synthetic_flights import fly

from beetle_omni_ros import cli
from beetle_omni_ros.bags.bag_writer import BagWriter
from beetle_omni_ros.control.tasks import make_task
from beetle_omni_ros.show.page import Grid, page, section, verdict_head
from beetle_omni_ros.show.report import run_report

ROOT = Path(__file__).parents[2]
LONG = 'a text of many words that says what was found and what to do about it ' * 3
BROWSERS = 'chromium', 'chromium-headless-shell', 'google-chrome'
# Software rendering, so that a scene is drawn on any computer.
ARGUMENTS = ['--no-sandbox', '--use-angle=swiftshader', '--enable-unsafe-swiftshader']
CUT_OFF = """() => [...document.querySelectorAll('main *')].filter(e => {
    if (e.closest('.scroll, .plotly-graph-div') || e.closest('[hidden]')) return false;
    const box = e.getBoundingClientRect();
    return box.width > 0 && box.right > innerWidth + 1;
}).map(e => e.outerHTML.slice(0, 80))"""


@pytest.fixture(scope='module')
def chromium():
    playwright = pytest.importorskip('playwright.sync_api', reason='playwright is not installed')
    path = next(filter(None, map(shutil.which, BROWSERS)), None)
    if path is None:
        pytest.skip('no browser on the PATH')
    with playwright.sync_playwright() as started:
        browser = started.chromium.launch(executable_path=path, args=ARGUMENTS)
        yield browser
        browser.close()


def report(folder, file):
    for name in ('near', 'far'):
        with BagWriter(folder / name, {'task': 'waypoints', 'seed': 0}) as writer:
            fly(writer, make_task('waypoints'), duration=24.5)
    run_report([folder / 'near', folder / 'far'], file, console=Console(file=io.StringIO()))


def rotor(folder, file):
    log = write_bench(folder / 'bench.csv', bench(np.random.default_rng(0)))
    assert cli.main(['identify', 'rotor', str(log), '--report', str(file)]) == 0


def comparison(folder, file):
    shutil.copy(ROOT / 'docs' / 'comparison' / 'comparison.html', file)


def verdict(folder, file):
    grid = Grid('Candidates', ['entry', *(f'a number of kind {k} [rad/s]' for k in range(6))],
                [['rotor_acceleration_torque', *['12345.678'] * 6], [LONG, *['1'] * 6]])
    file.write_text(page(
        'Gap', 'fitted: ' + '/a/long/path/without/a/space' * 6, [grid], [LONG],
        [section('Evidence', LONG, '')], verdict_head('named: x or y', '#123456', LONG)))


def test_a_zoomed_chart_shows_every_sample_and_the_way_back(chromium, tmp_path):
    report(tmp_path, tmp_path / 'page.html')
    shown, samples = chromium.new_page(), """range => {
        const {data, layout} = document.getElementById('charts'), [from, to] = layout.xaxis.range;
        return data.filter(line => line.name === 'near' && line.yaxis === 'y5').map(line => [
            line.x.length, line.x.filter(t => from <= t && t <= to).length, from, to])[0];
    }"""
    shown.goto((tmp_path / 'page.html').as_uri(), timeout=60_000)
    shown.locator('.main-svg').first.wait_for(timeout=60_000)
    whole, all_visible, *_ = shown.evaluate(samples)
    assert whole == all_visible <= 900
    chart = shown.locator('.nsewdrag').nth(5)
    chart.scroll_into_view_if_needed()
    box = chart.bounding_box()
    x, y = box['x'] + box['width'] / 3, box['y'] + box['height'] / 2
    shown.mouse.move(x, y)
    shown.mouse.down()
    shown.mouse.move(x + box['width'] / 30, y, steps=4)
    shown.mouse.up()
    shown.wait_for_function("document.getElementById('charts').data.some(a => a.x.length > 900)")
    _, visible, begin, end = shown.evaluate(samples)
    assert end - begin < 2 and visible == pytest.approx(200 * (end - begin), abs=2)     # 200 Hz
    shown.mouse.dblclick(x, y)
    shown.wait_for_function("!document.getElementById('charts').data.some(a => a.x.length > 900)")
    assert shown.evaluate(samples)[:2] == [whole, all_visible]


@pytest.mark.parametrize('made', [report, rotor, comparison, verdict],
                         ids=lambda made: made.__name__)
def test_a_page_is_complete_without_errors(chromium, made, tmp_path):
    file, wrong = tmp_path / 'page.html', []
    made(tmp_path, file)
    shown = chromium.new_page()
    shown.on('console', lambda message: wrong.append(message.text)
             if message.type == 'error' else None)
    shown.on('pageerror', lambda error: wrong.append(str(error)))
    shown.on('request', lambda request: wrong.append(request.url)
             if not request.url.startswith(('file:', 'data:', 'blob:')) else None)
    for width in (1280, 400):
        shown.set_viewport_size({'width': width, 'height': 800})
        shown.goto(file.as_uri(), timeout=60_000)
        if made is report:
            shown.locator('.main-svg').first.wait_for(timeout=60_000)
            assert shown.locator('.plot-container').count() == 1
            assert shown.evaluate("[...document.querySelectorAll('section > figure .scroll')]"
                                  '.every(table => table.scrollWidth <= table.clientWidth)')
        assert shown.evaluate('document.documentElement.scrollWidth') == width
        assert shown.locator('section').count() >= 1 and not shown.evaluate(CUT_OFF)
    assert not wrong
    shown.emulate_media(color_scheme='dark')
    shown.evaluate("document.querySelector('img')?.scrollIntoView()")
    shot = Image.open(io.BytesIO(shown.screenshot(timeout=120_000)))
    assert np.mean(shot.convert('L')) < 128     # darker than middle grey, its pictures too
