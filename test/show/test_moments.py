"""What a picture shows agrees with the recording, and with the newest messages."""

from types import SimpleNamespace

import numpy as np
import pytest
from synthetic_flights import fly, write_truth

from beetle_omni_ros.bags.log import LogRecorder
from beetle_omni_ros.control.tasks import make_task
from beetle_omni_ros.model import rotations
from beetle_omni_ros.model.parameters import JOINT_NAMES
from beetle_omni_ros.show.figures import COLOURS
from beetle_omni_ros.show.recorded import draw, recorded_scene
from beetle_omni_ros.show.scene import close, moments, NEWTON_PER_METRE, Room, serve


@pytest.fixture(scope='module')
def log():
    recorder = LogRecorder()
    fly(recorder, make_task('waypoints'), duration=12.0, start=50.0)
    return recorder.log()


def test_moments_agree_with_the_log(log):
    before, first, later, after = moments(log, np.array([3.0, 50.5, 60.0, 99.0]))
    assert before is None and after is None
    k = np.searchsorted(log.truth.t, 60.0 - 1e-6)
    np.testing.assert_allclose(later.position, log.truth.position[k])
    np.testing.assert_allclose(later.quaternion, log.truth.quaternion[k])
    np.testing.assert_allclose(first.target[0], log.targets[0].position)
    np.testing.assert_allclose(later.target[0], log.targets[1].position)
    away = 1e3 * np.linalg.norm(later.position - log.targets[1].position)
    assert later.text() == f'flying:nmpc, {away:.0f} mm, 3.0° off target'


def test_the_drawn_robot_tilts_and_its_arrows_are_as_long_as_the_thrusts(log):
    server = serve('127.0.0.1', 8300)
    try:
        room = Room(server, COLOURS[:2])
        moment, = moments(log, np.array([55.0]))
        moment.tilt, moment.thrust = np.array([0.3, -1.2, 2.5, 0.0]), np.array([8.0, 4.0, 0.0, 1])
        room.show([moment, None])
        drawn, hidden = room.robots
        np.testing.assert_allclose(room._world.position, -moment.position)
        moment.position = moment.position + 1.0
        room.show([moment, None], follow=False)
        np.testing.assert_allclose(room._world.position, 1.0 - moment.position)
        assert drawn._root.visible and not hidden._root.visible
        for k, name in enumerate(JOINT_NAMES):
            link, node = drawn._joints[name]
            np.testing.assert_allclose(rotations.geodesic_angle(
                np.roll(node.wxyz, -1), link.turned(moment.tilt[k])), 0, atol=1e-6)
            begin, end = drawn._arrows[f'rotor{k + 1}'].points[0]
            np.testing.assert_allclose(NEWTON_PER_METRE * (end - begin), [0, 0, moment.thrust[k]],
                                       atol=1e-5)
    finally:
        close(server)


def test_a_recorded_scene_refers_to_nothing_outside(log):
    scene = recorded_scene({'a</script>': log})
    assert '__VISER_EMBED_DATA__="' in scene
    assert 'a</script>' not in scene and 'a&lt;/script&gt;' in scene
    assert len(scene) < 2e6


def test_a_running_graph_is_drawn_until_ctrl_c():
    server, taken = serve('127.0.0.1', 8320), []

    def take(newest):
        if taken:
            raise KeyboardInterrupt
        taken.append(write_truth(newest, 7.0, np.array([0.5, 0, 1]), np.array([0.0, 0, 0, 1]),
                                 np.zeros(3), np.zeros(3)))
    try:
        with pytest.raises(KeyboardInterrupt):
            draw(server, SimpleNamespace(take=take))
        robot = server.scene._handle_from_node_name['/world/robot0']
        assert robot.visible and robot.position[0] == pytest.approx(0.5)
        path = server.scene._handle_from_node_name['/world/path0'].points
        np.testing.assert_allclose(path[-1], [[0.5, 0, 1], [0.5, 0, 1]])
    finally:
        close(server)
