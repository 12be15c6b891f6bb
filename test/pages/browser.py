"""A real browser without a window, for tests of pages."""

from contextlib import contextmanager
import shutil

import pytest

BROWSERS = ('chromium', 'chromium-browser', 'google-chrome')
# Software rendering, so that a scene is drawn on any computer.
ARGUMENTS = ['--no-sandbox', '--use-angle=swiftshader', '--enable-unsafe-swiftshader']
WIDTHS = (1280, 400)


@contextmanager
def browser():
    """Start the browser, or skip the test with the reason."""
    playwright = pytest.importorskip('playwright.sync_api', reason='playwright is not installed')
    path = next(filter(None, map(shutil.which, BROWSERS)), None)
    if path is None:
        pytest.skip(f'no browser on the PATH: {", ".join(BROWSERS)}')
    with playwright.sync_playwright() as started:
        chromium = started.chromium.launch(executable_path=path, args=ARGUMENTS)
        try:
            yield chromium
        finally:
            chromium.close()


@contextmanager
def opened(chromium, file, width):
    """Show a page; fail if it logs an error or requests anything outside it."""
    page = chromium.new_page(viewport={'width': width, 'height': 800})
    page.set_default_timeout(60_000)
    wrong = []
    page.on('console', lambda message: wrong.append(message.text)
            if message.type == 'error' else None)
    page.on('pageerror', lambda error: wrong.append(str(error)))
    page.on('request', lambda request: wrong.append(request.url)
            if not request.url.startswith(('file:', 'data:', 'blob:')) else None)
    page.goto(file.as_uri(), timeout=60_000)
    try:
        yield page
        assert not wrong
    finally:
        page.close()


def cut_off(page):
    """Elements beyond the width of the page that cannot be scrolled to."""
    return page.evaluate("""() => [...document.querySelectorAll('main *')].filter(e => {
        if (e.closest('.scroll, .plotly-graph-div') || e.closest('[hidden]')) return false;
        const box = e.getBoundingClientRect();
        return box.width > 0 && box.right > innerWidth + 1;
    }).map(e => e.outerHTML.slice(0, 80))""")
