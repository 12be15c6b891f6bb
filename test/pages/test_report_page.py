"""The report in a real browser: drawing, playback, zoom, switching off runs."""

import io

from browser import browser, cut_off, opened, WIDTHS
import numpy as np
import pytest
from rich.console import Console
from synthetic_flights import fly, write_state

from beetle_omni_ros.runs.bag_writer import BagWriter
from beetle_omni_ros.runs.report import run_report
from beetle_omni_ros.runs.tasks import make_task


@pytest.fixture(scope='module')
def page_file(tmp_path_factory):
    """Two flights, one of which ends in a fault."""
    folder = tmp_path_factory.mktemp('report')
    for name, offset in (('near', 0.01), ('far', 0.3)):
        with BagWriter(folder / name, {'task': 'waypoints', 'seed': 0}) as writer:
            fly(writer, make_task('waypoints'), offset=offset, duration=24.5)
            if name == 'far':
                write_state(writer, 25.6, 'landing:rotor2_lost')
    run_report([folder / 'near', folder / 'far'], folder / 'page.html',
               console=Console(file=io.StringIO()))
    return folder / 'page.html'


@pytest.fixture(scope='module')
def chromium():
    with browser() as started:
        yield started


def picture(page, selector):
    """Pixels of an element."""
    from PIL import Image
    shot = page.locator(selector).first.screenshot()
    return np.asarray(Image.open(io.BytesIO(shot)).convert('RGB')).astype(int)


def coloured(pixels, colour):
    """Number of pixels with about this colour."""
    return int((np.abs(pixels - colour).max(axis=2) < 30).sum())


def seek(page, t):
    """Move the slider."""
    page.locator('#slider').evaluate('(e, t) => { e.value = t; '
                                     'e.dispatchEvent(new Event("input")); }', t)
    page.wait_for_timeout(300)




@pytest.mark.parametrize('width', WIDTHS)
def test_the_page_draws_everything_and_fits(chromium, page_file, width):
    with opened(chromium, page_file, width) as page:
        page.locator('[data-chart] canvas').first.wait_for()
        assert page.locator('[data-chart]').count() == page.locator('[data-chart] canvas').count()
        assert page.locator('[data-chart]').count() > 12
        assert page.evaluate('document.documentElement.scrollWidth') == width
        assert not cut_off(page)
        blue = coloured(picture(page, '[data-chart="chart0"]'), (0x1f, 0x5f, 0xa8))
        red = coloured(picture(page, '[data-chart="chart0"]'), (0xd1, 0x43, 0x2f))
        assert blue > 50 and red > 50
        assert 'rotor2_lost' in page.locator('.card').nth(1).inner_text()
        assert page.locator('.strip b').count() == 1
        assert '2 of' not in page.locator('.card').nth(1).inner_text()


def test_a_run_that_is_switched_off_is_hidden(chromium, page_file):
    with opened(chromium, page_file, 1280) as page:
        seek(page, 12)
        both, scene = picture(page, '[data-chart="chart0"]'), page.locator('#errors')
        assert 'near' in scene.inner_text() and 'far' in scene.inner_text()
        page.locator('input[data-run="1"]').uncheck()
        page.wait_for_timeout(300)
        one = picture(page, '[data-chart="chart0"]')
        red, blue = (0xd1, 0x43, 0x2f), (0x1f, 0x5f, 0xa8)
        assert coloured(one, red) < 0.2 * coloured(both, red)
        assert coloured(one, blue) >= 0.9 * coloured(both, blue)
        assert 'far' not in scene.inner_text() and page.locator('.lane').nth(1).is_hidden()
        page.locator('input[data-run="1"]').check()
        page.wait_for_timeout(300)
        assert coloured(picture(page, '[data-chart="chart0"]'), red) == coloured(both, red)


def test_the_flight_plays_and_stops(chromium, page_file):
    with opened(chromium, page_file, 1280) as page:
        seek(page, 8.0)
        before, shown = picture(page, '#scene canvas'), page.locator('#time').inner_text()
        page.locator('#speed').select_option('4')
        page.locator('#play').click()
        page.wait_for_timeout(1200)
        page.locator('#play').click()
        after, later = picture(page, '#scene canvas'), page.locator('#time').inner_text()
        assert shown == '8.0 s' and 8.2 < float(later.split()[0]) < 24
        assert (np.abs(after - before).max(axis=2) > 40).sum() > 100
        mark = page.locator('[data-chart="chart0"] .now')
        assert 'translateX(0px)' not in mark.get_attribute('style')
        page.wait_for_timeout(300)
        assert page.locator('#time').inner_text() == later


def test_the_scene_shows_the_error_of_the_metrics(chromium, page_file):
    with opened(chromium, page_file, 1280) as page:
        seek(page, 15.2)
        near, far = page.locator('#errors span').all_inner_texts()
        assert near == 'near: 10 mm, 3.0°' and far == 'far: 300 mm, 3.0°'


def test_time_axes_zoom_together_and_a_tap_sets_the_time(chromium, page_file):
    with opened(chromium, page_file, 1280) as page:
        seek(page, 12.0)
        holder = page.locator('[data-chart="chart5"]')
        whole = picture(page, '[data-chart="chart5"]')
        page.locator('#nearer').click()
        page.locator('#nearer').click()
        page.wait_for_timeout(300)
        assert (np.abs(picture(page, '[data-chart="chart5"]') - whole).max(axis=2) > 40).sum() > 50
        page.locator('#all').click()
        page.wait_for_timeout(300)
        over = holder.locator('.u-over')
        box = over.bounding_box()
        over.click(position={'x': 0.9 * box['width'], 'y': 0.5 * box['height']})
        assert float(page.locator('#time').inner_text().split()[0]) > 18
        plot = page.locator('[data-chart="chart0"] .u-over')
        box = plot.bounding_box()
        plot.hover(position={'x': 0.6 * box['width'], 'y': 40})
        page.wait_for_timeout(300)
        legend = page.locator('[data-chart="chart0"] .u-value').all_inner_texts()
        assert float(legend[1]) < 1.0 and float(legend[2]) >= 0.29


def test_a_logarithmic_axis_has_lines_at_powers_of_ten_only(chromium, page_file):
    with opened(chromium, page_file, 1280) as page:
        pixels = picture(page, '[data-chart="chart0"]').astype(int)
    grey = np.abs(pixels - (0xe6, 0xe9, 0xed)).max(axis=2) < 3
    lines = np.flatnonzero(np.diff((grey.mean(axis=1) > 0.3).astype(int)) == 1)
    assert 2 <= len(lines) <= 8 and np.diff(lines).min() > 20
