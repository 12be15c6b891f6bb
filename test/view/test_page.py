"""Scene and report in a headless browser: rendering, motion, and dragged targets."""

import io
import threading
import time

from browser import browser, cut_off, opened, WIDTHS
import numpy as np
from PIL import Image
import pytest
from rich.console import Console
from synthetic_flights import fly, write_command, write_joints, write_state, write_truth

from beetle_omni_ros.robot import rotations
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.robot.urdf import Model
from beetle_omni_ros.runs.bag_writer import BagWriter
from beetle_omni_ros.runs.log import LogRecorder
from beetle_omni_ros.runs.tasks import make_task
from beetle_omni_ros.view.live import Live
from beetle_omni_ros.view.recorded import recorded_scene
from beetle_omni_ros.view.report import run_report
from beetle_omni_ros.view.scene import close, serve

pytestmark = [pytest.mark.timeout(600), pytest.mark.flaky(reruns=1)]
UP, ROBOT, NEAR = np.array([0.0, 0, 0, 1]), RobotParameters.load(), 0.02
PATIENCE = 120.0        # [s] on a busy computer
BLUE, RED = (0x1f, 0x5f, 0xa8), (0xd1, 0x43, 0x2f)


@pytest.fixture(scope='module')
def chromium():
    with browser() as started:
        yield started


@pytest.fixture(scope='module')
def page_file(tmp_path_factory):
    """Report of two flights, one of which ends in a fault."""
    folder = tmp_path_factory.mktemp('report')
    for name, offset in (('near', 0.01), ('far', 0.3)):
        with BagWriter(folder / name, {'task': 'waypoints', 'seed': 0}) as writer:
            fly(writer, make_task('waypoints'), offset=offset, duration=24.5)
            if name == 'far':
                write_state(writer, 25.6, 'landing:rotor2_lost')
    run_report([folder / 'near', folder / 'far'], folder / 'page.html',
               console=Console(file=io.StringIO()))
    return folder / 'page.html'


def picture(element):
    """Pixels of an element or a page."""
    return np.asarray(Image.open(io.BytesIO(element.screenshot())).convert('RGB')).astype(int)


def coloured(pixels, colour):
    """Number of pixels with about this colour."""
    return int((np.abs(pixels - colour).max(axis=2) < 30).sum())


def until(condition, what):
    """Wait for a true value; return it."""
    deadline = time.monotonic() + PATIENCE
    while time.monotonic() < deadline:
        if value := condition():
            return value
        time.sleep(0.2)
    raise AssertionError(f'not within {PATIENCE:g} s: {what}')


@pytest.mark.parametrize('width', WIDTHS)
def test_the_report_draws_every_chart_and_fits(chromium, page_file, width):
    with opened(chromium, page_file, width) as page:
        charts = page.locator('.plotly-graph-div')
        page.locator('.main-svg').first.wait_for()
        assert charts.count() > 6 and charts.count() == page.locator('.plot-container').count()
        assert page.evaluate('document.documentElement.scrollWidth') == width
        assert not cut_off(page)
        both = picture(charts.first)
        assert coloured(both, BLUE) > 50 and coloured(both, RED) > 50
        assert 'rotor2_lost' in page.locator('.card').nth(1).inner_text()


def test_a_run_is_hidden_by_a_click_in_the_legend(chromium, page_file):
    with opened(chromium, page_file, 1280) as page:
        chart = page.locator('.plotly-graph-div').first
        page.locator('.legendtoggle').first.wait_for()
        both = picture(chart)
        chart.locator('.legendtoggle').nth(1).click()
        page.wait_for_timeout(1500)
        assert coloured(picture(chart), RED) < 0.2 * coloured(both, RED)


def test_the_recorded_flight_plays(chromium, tmp_path):
    recorder = LogRecorder()
    fly(recorder, make_task('waypoints'), duration=12.0)
    (tmp_path / 'scene.html').write_text(recorded_scene({'a': recorder.log()}))
    with opened(chromium, tmp_path / 'scene.html', 400) as page:
        until(lambda: len(np.unique(picture(page).reshape(-1, 3), axis=0)) > 200,
              'a picture of many colours')
        before = picture(page)
        until(lambda: (np.abs(picture(page) - before).max(axis=2) > 40).sum() > 100, 'motion')


class Graph:
    """Stand-in for a ROS graph with a hovering robot."""

    def __init__(self):
        self.targets, self.selected, self.t = [], [], 100.0

    def take(self, newest):
        self.t += 0.03
        write_state(newest, self.t, 'flying:nmpc')
        write_truth(newest, self.t, np.array([0.0, 0.0, 1.0]), UP, np.zeros(3), np.zeros(3))
        write_joints(newest, self.t, np.zeros(4), np.zeros(4))
        write_command(newest, self.t, np.zeros(4), np.full(4, 7.5))

    def controllers(self):
        return ['nmpc', 'rl']

    def publish_target(self, target):
        self.targets.append(target)

    def select(self, controller, answer):
        self.selected.append(controller)
        answer('it is silent')


@pytest.fixture
def live_page(chromium):
    """Function that shows a graph; yields its page."""
    started = []

    def show(graph, allow_targets):
        server = serve('127.0.0.1', 8320)
        live = Live(server, graph, Model.load(), ROBOT, allow_targets)
        started.append((server, live))
        threading.Thread(target=live.run, daemon=True).start()
        page = chromium.new_page(viewport={'width': 900, 'height': 560})
        page.set_default_timeout(1e3 * PATIENCE)
        page.goto(f'http://127.0.0.1:{server.get_port()}')
        page.add_style_tag(content='.mantine-Notifications-root {opacity: 0.01}')
        page.get_by_text('flying:nmpc').first.wait_for()
        return page, server
    yield show
    for server, live in started:
        live.stop()
        close(server)


def pixel(client, point):
    """Position of a point in world on the page."""
    camera = client.camera
    seen = rotations.matrix(np.roll(camera.wxyz, -1)).T @ (point - camera.position)
    scale = camera.image_height / 2 / np.tan(camera.fov / 2) / seen[2]
    return np.array([camera.image_width, camera.image_height]) / 2 + scale * seen[:2]


def test_a_target_that_is_dragged_with_the_mouse_arrives(live_page):
    graph = Graph()
    page, server = live_page(graph, True)
    page.wait_for_timeout(4000)
    client = until(lambda: list(server.get_clients().values()), 'a client')[0]
    # The arrow of the gizmo along world x, and the end of the drag.
    shaft, there = (pixel(client, np.array([x, 0.0, 1.0])) for x in (0.33, 0.93))
    page.mouse.move(*shaft)
    page.mouse.down()
    for part in np.linspace(0.1, 1.0, 10):
        page.mouse.move(*(shaft + part * (there - shaft)))
        page.wait_for_timeout(100)
    assert not graph.targets        # not before the mouse button is released
    page.mouse.up()
    target, = until(lambda: graph.targets, 'a target')
    assert target.position[0] == pytest.approx(0.6, abs=0.1)
    np.testing.assert_allclose(target.position[1:], [0.0, 1.0], atol=NEAR)
    np.testing.assert_allclose(np.abs(target.quaternion), UP, atol=NEAR)
    assert 100.0 < target.stamp <= graph.t


def test_without_permission_the_page_has_no_controls_for_targets(live_page):
    page, _ = live_page(Graph(), False)
    assert not page.get_by_text('controller').count()
