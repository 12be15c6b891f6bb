"""A headless browser, and pictures of its page."""

from contextlib import contextmanager, nullcontext
import io
import os
import shutil
import time

import numpy as np
from PIL import Image
import pytest

NAMES = ('chromium', 'chromium-browser', 'google-chrome', 'google-chrome-stable')
# Drawn without a GPU and without network.
FLAGS = ('--headless', '--no-sandbox', '--disable-gpu', '--disable-quic', '--no-first-run',
         '--disable-background-networking', '--disable-component-update', '--disable-sync',
         '--use-gl=angle', '--use-angle=swiftshader', '--enable-unsafe-swiftshader')
PANEL = 350             # [px]
PATIENCE = 120.0        # [s] on a busy computer


def chromium():
    """Path of an installed browser; skips the test if there is none."""
    path = os.environ.get('CHROMIUM') or next(filter(None, map(shutil.which, NAMES)), None)
    if path is None:
        pytest.skip(f"no browser: none of {', '.join(NAMES)} in PATH, no variable CHROMIUM")
    return path


@contextmanager
def started():
    """Start the browser."""
    playwright = pytest.importorskip('playwright.sync_api', reason='no playwright: pip install '
                                     'playwright; its own browsers are not needed')
    path = chromium()
    with playwright.sync_playwright() as run:
        browser = run.chromium.launch(executable_path=path, args=list(FLAGS))
        try:
            yield browser
        finally:
            browser.close()


@contextmanager
def opened(url, width=900, height=560, browser=None):
    """Open a page, in a new browser if none is given; yield it and the list of its requests."""
    with started() if browser is None else nullcontext(browser) as browser:
        page = browser.new_page(viewport={'width': width, 'height': height})
        page.set_default_timeout(1e3 * PATIENCE)
        requests = []
        page.on('request', lambda request: requests.append(request.url))
        page.goto(url)
        page.add_style_tag(content='.mantine-Notifications-root {opacity: 0.01}')
        try:
            yield page, requests
        finally:
            page.close()


def picture(page):
    """Picture (H, W, 3) of the page, without the panel on its right."""
    image = Image.open(io.BytesIO(page.screenshot())).convert('RGB')
    return np.asarray(image, dtype=float)[:, :-PANEL]


def rendered(page):
    """Wait for a picture with many colours."""
    until(lambda: len(np.unique(picture(page).reshape(-1, 3), axis=0)) > 200,
          'a picture of many colours')
    page.wait_for_timeout(2000)


def until(condition, what, patience=PATIENCE):
    """Wait for a true value; return it."""
    deadline = time.monotonic() + patience
    while time.monotonic() < deadline:
        if value := condition():
            return value
        time.sleep(0.2)
    raise AssertionError(f'not within {patience:g} s: {what}')


def at_rest(page):
    """Picture of a page that has stopped changing."""
    last = picture(page)

    def same():
        nonlocal last
        before, last = last, picture(page)
        return np.abs(before - last).max() < 8
    until(same, 'a picture at rest')
    return last
