"""The page in a headless browser: rendering, motion, and dragged targets."""

from concurrent.futures import ThreadPoolExecutor
import threading

import numpy as np
import pytest
from synthetic_flights import fly, write_command, write_joints, write_state, write_truth
from view_browser import at_rest, opened, rendered, started, until

from beetle_omni_ros.robot import rotations
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.robot.urdf import Model
from beetle_omni_ros.runs.bag_writer import BagWriter
from beetle_omni_ros.runs.tasks import make_task
from beetle_omni_ros.view.live import Live
from beetle_omni_ros.view.page import Page
from beetle_omni_ros.view.playback import Player
from beetle_omni_ros.view.recording import Recording

pytestmark = [pytest.mark.timeout(600), pytest.mark.flaky(reruns=1)]
UP, ROBOT = np.array([0.0, 0, 0, 1]), RobotParameters.load()
STRANGE, NEAR = 25, 0.02    # share of 255; [m]
ANTIALIASED = """() => [...document.querySelectorAll('canvas')].map(
    canvas => canvas.getContext('webgl2')).filter(gl => gl).map(
    gl => gl.getContextAttributes().antialias)"""


@pytest.fixture(scope='module')
def bag(tmp_path_factory):
    folder = tmp_path_factory.mktemp('page') / 'flight'
    with BagWriter(folder, {'task': 'waypoints'}) as writer:
        fly(writer, make_task('waypoints'), duration=20.0, start=50.0)
    return folder


@pytest.fixture(scope='module')
def chromium():
    """A browser for all tests."""
    with started() as browser:
        yield browser


@pytest.fixture
def drawn():
    """Run the drawing of a page in a thread, and stop it afterwards."""
    pages = []

    def start(page, drawer):
        pages.append((page, drawer))
        threading.Thread(target=drawer.run, daemon=True).start()
        return drawer
    yield start
    for page, drawer in pages:
        drawer.stop()
        page.close()


class Graph:
    """Stand-in for a ROS graph with a hovering robot."""

    def __init__(self, refuses=''):
        self.targets, self.selected, self.refuses, self.t = [], [], refuses, 100.0

    def take(self, sampler):
        self.t += 0.03
        write_state(sampler, self.t, 'flying:nmpc') if not sampler.states else None
        write_truth(sampler, self.t, np.array([0.0, 0.0, 1.0]), UP, np.zeros(3), np.zeros(3))
        write_joints(sampler, self.t, np.zeros(4), np.zeros(4))
        write_command(sampler, self.t, np.zeros(4), np.full(4, 7.5))
        if self.refuses and self.targets:
            sampler.write_diagnostic(self.t, 'nmpc_node: inputs', {}, 1, self.refuses)

    def controllers(self):
        return ['nmpc', 'rl']

    def publish_target(self, target):
        self.targets.append(target)

    def select(self, controller, answer):
        self.selected.append(controller)
        answer('it is silent')


def pixel(client, point):
    """Position of a point in world on the page."""
    camera = client.camera
    seen = rotations.matrix(np.roll(camera.wxyz, -1)).T @ (point - camera.position)
    scale = camera.image_height / 2 / np.tan(camera.fov / 2) / seen[2]
    return np.array([camera.image_width, camera.image_height]) / 2 + scale * seen[:2]


def changed(before, after):
    """Share of pixels that differ."""
    return np.mean(np.abs(before - after).max(axis=2) > STRANGE)


def test_a_recording_is_rendered_and_moves_with_the_slider(bag, drawn, chromium):
    recordings = [Recording(bag, 'a'), Recording(bag, 'b')]
    try:
        for recording in recordings:
            recording.wait(120.0, whole=True)
        page = Page(['a', 'b'], Model.load(), ROBOT, port=8300)
        player = drawn(page, Player(page, recordings, start=6.0, play=False))
        player.look()
        with opened(page.url, browser=chromium) as (browser, requests):
            rendered(browser)
            # The CPU draws this page.
            assert set(browser.evaluate(ANTIALIASED)) == {False}
            first = at_rest(browser)
            # The slider's number, as typed by a user.
            field = browser.locator('.mantine-NumberInput-input').first
            until(lambda: browser.get_by_text('a: 6.0 s of').count(), 'the status')
            field.fill('14')
            field.press('Enter')
            until(lambda: browser.get_by_text('a: 14.0 s of').count(), 'the new time')
            assert player.time == 14.0
            second = at_rest(browser)
            assert 0.003 < changed(first, second) < 0.5
            # The playback runs.
            player._play.value = True
            until(lambda: player.time > 14.5, 'a time that runs')
            assert all(url.startswith((page.url, page.url.replace('localhost', '127.0.0.1'),
                                       'blob:', 'data:')) for url in requests), requests
    finally:
        for recording in recordings:
            recording.close()


def test_a_target_that_is_dragged_with_the_mouse_arrives(drawn, chromium):
    page = Page(['live'], Model.load(), ROBOT, title='Flight', port=8320)
    page.look_at_room()
    graph = Graph()
    drawn(page, Live(page, graph, ROBOT, allow_targets=True))
    with opened(page.url, browser=chromium) as (browser, _):
        rendered(browser)
        client = until(lambda: list(page.server.get_clients().values()), 'a client')[0]
        # The arrow of the gizmo along world x, and the end of the drag.
        shaft, there = (pixel(client, np.array([x, 0.0, 1.0])) for x in (0.33, 0.93))
        browser.mouse.move(*shaft)
        browser.mouse.down()
        for part in np.linspace(0.1, 1.0, 10):
            browser.mouse.move(*(shaft + part * (there - shaft)))
            browser.wait_for_timeout(100)
        assert not graph.targets        # not before the mouse button is released
        browser.mouse.up()
        until(lambda: graph.targets, 'a target')
        target, = graph.targets
        assert target.position[0] == pytest.approx(0.6, abs=0.1)
        np.testing.assert_allclose(target.position[1:], [0.0, 1.0], atol=NEAR)
        np.testing.assert_allclose(np.abs(target.quaternion), UP, atol=NEAR)
        assert 100.0 < target.stamp <= graph.t


def test_a_refused_target_is_reported_and_reset(drawn, chromium):
    page = Page(['live'], Model.load(), ROBOT, title='Flight', port=8340)
    graph = Graph(refuses='target_pose: 1 rejected, 9 m from the robot')
    live = drawn(page, Live(page, graph, ROBOT, allow_targets=True))
    with opened(page.url, 400, 800, chromium) as (browser, _):
        until(lambda: page.server.get_clients(), 'a client')
        live._send(np.array([0.0, 0.0, -5.0]), UP)      # below the floor: not sent
        until(lambda: browser.get_by_text('target not sent').count(), 'a note')
        assert not graph.targets
        live._send(np.array([9.0, 0.0, 1.0]), UP)
        until(lambda: browser.get_by_text('9 m from the robot').count(), 'the reason')
        assert len(graph.targets) == 1
        until(lambda: live._sampler.target is None, 'the target before')


def test_without_permission_the_page_has_no_controls_for_targets(drawn, chromium):
    page = Page(['live'], Model.load(), ROBOT, title='Flight', port=8360)
    live = drawn(page, Live(page, Graph(), ROBOT, allow_targets=False))
    with opened(page.url, browser=chromium) as (browser, _):
        until(lambda: browser.get_by_text('flying:nmpc').count(), 'the state')
        assert not browser.get_by_text('fly there').count()
        assert not browser.get_by_text('controller').count()
    assert live._gizmo is None


def test_a_port_in_use_passes_on_to_the_next():
    with ThreadPoolExecutor(2) as pool:
        pages = list(pool.map(lambda _: Page(['a'], Model.load(), ROBOT, port=8380), range(2)))
    assert len({page.url for page in pages}) == 2
    for page in pages:
        page.close()
