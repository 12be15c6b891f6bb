"""Refusals of messages and parameters, after which the previous values remain."""

import time
from types import SimpleNamespace

from geometry_msgs.msg import PoseStamped
import numpy as np
import pytest

pytest.importorskip('pymavlink')
pytest.importorskip('serial')

from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import JointState
from std_msgs.msg import String

from beetle_omni_ros.bags.bag import read_bag, read_messages
from beetle_omni_ros.bags.messages import from_bytes
from beetle_omni_ros.bags.topics import ALL, COMMAND, EVENT, LATCHED
from beetle_omni_ros.control.base import Command, PoseTarget
from beetle_omni_ros.control.registry import ControllerEntry
from beetle_omni_ros.flight.component import ERROR, IDENTITY
from beetle_omni_ros.model.schema import RunError
from beetle_omni_ros.ros import wire
from beetle_omni_ros.ros.bridge_nodes import joint_bridge_node
from beetle_omni_ros.ros.node import FlightNode
from beetle_omni_ros.ros.nodes import controller_node, RecorderNode

pytestmark = pytest.mark.real_time
LEVEL = np.array([0.0, 0.0, 0.0, 1.0])
SOON = 10       # s; a busy test machine must not cause a fault


def still():
    """Make the controller node without a solver."""
    return controller_node(ControllerEntry(name='nmpc', controller=lambda: SimpleNamespace(
        period=0.01, step=lambda state, target: None, reset=lambda: None,
        set_health=lambda health: None)))


def pose(height=1.0, stamp=0.0, frame='world', x=0.0):
    return wire.serialized('target_pose', PoseTarget([x, 0, height], LEVEL, stamp), frame)


def test_a_target_with_a_wrong_frame_is_refused_and_the_next_one_is_flown(bench):
    node = bench.add(still())
    poses, component = bench.publisher(PoseStamped, 'target_pose'), node.component
    poses.publish(pose())
    assert bench.wait(lambda: component.target is not None)
    first, entry = component.target, component.inputs['target_pose']
    for message, expected in ((pose(-5.0), 'z = -5 m, expected at least'),
                              (pose(frame='map'), "frame_id 'map'")):
        before = entry.rejected.total()
        poses.publish(message)
        assert bench.wait(lambda before=before: entry.rejected.total() > before), expected
        assert expected in entry.last_refusal and component.target is first
    poses.publish(pose(1.5, time.time(), frame=''))
    assert bench.wait(lambda: component.target.position[2] == 1.5)


@pytest.fixture
def log(monkeypatch):
    """Warnings of all nodes, and a clock of their throttle, a list with the present time [s]."""
    lines, now = [], [100.0]
    logger = SimpleNamespace(warning=lines.append, **dict.fromkeys(
        ('debug', 'info', 'error'), lambda *_, **__: None))
    monkeypatch.setattr(FlightNode, 'get_logger', lambda self: logger)
    monkeypatch.setattr(wire, 'time', SimpleNamespace(monotonic=lambda: now[0]))
    return SimpleNamespace(lines=lines, now=now)


def test_refusals_of_a_kind_are_logged_again_after_two_seconds_with_their_number(bench, log):
    node = bench.add(still()).component

    def refuse(*reasons, kind='cannot be flown', topic='target_pose'):
        before = len(log.lines)
        for reason in reasons:
            node.reject(topic, reason, kind)
        return log.lines[before:]

    assert refuse('z = 9 m', 'z = -1 m', 'z = -2 m') == ['target_pose: message refused, z = 9 m']
    assert len(refuse('too far', topic='target_trajectory')) == 1
    assert len(refuse('NaN', kind='not finite')) == 1
    log.now[0] += wire.QUIET
    assert refuse('z = -3 m') == ['target_pose: message refused, z = -3 m (2 more before)']
    log.now[0] += wire.QUIET
    assert refuse('z = -4 m') == ['target_pose: message refused, z = -4 m']
    node.inputs['odom'].received = 1
    for kind in ('stale stamp', 'not finite'):
        assert len(refuse(kind, kind=kind, topic='odom')) == 1
        log.now[0] += wire.QUIET    # readings come by the hundred
        assert not refuse(kind, kind=kind, topic='odom')
    assert node.inputs['target_pose'].rejected == {'cannot be flown': 5, 'not finite': 1}


def test_lost_messages_are_one_line_in_two_seconds_and_an_unknown_number_counts_once(
        make_bench, tmp_path, log):
    recorder = make_bench(f'bag:={tmp_path}/bag').add(RecorderNode())
    for change in (3, 2**31 - 1, 1):        # as Fast DDS reports
        recorder._on_lost(SimpleNamespace(total_count_change=change))
    assert log.lines == ['3 messages lost so far'] and recorder._bag_status()[2]['lost'] == 5
    log.now[0] += wire.QUIET
    recorder._on_lost(SimpleNamespace(total_count_change=2))
    assert log.lines[1:] == ['7 messages lost so far (2 more before)']


def test_a_recorder_that_cannot_write_keeps_no_messages(make_bench, tmp_path, monkeypatch):
    recorder = make_bench(f'bag:={tmp_path}/bag').add(RecorderNode())

    def full(*_):
        raise RunError('bag: No space left on device')
    monkeypatch.setattr(recorder._bag, 'write_raw', full)
    for _ in range(3):
        recorder._keep('/odom', ALL['odom'].type, b'')
        recorder._write()
    assert not recorder._received and recorder._bag_status()[0] == ERROR


def test_commands_come_with_the_identity_of_their_publisher(make_bench):
    """Component refuses those of others, see test/flight."""
    bench, own = make_bench('port:=/tmp/none/a'), 'supervisor_node:0123abcd'
    node = bench.add(joint_bridge_node())
    commands = bench.publisher(JointState, 'command', wire.profile(COMMAND))
    identities = bench.publisher(String, IDENTITY, wire.profile(LATCHED))
    entry = node.component.inputs['command']

    def answer(source):
        before = entry.received, entry.rejected.total()
        end = time.monotonic() + SOON
        # A message older than 0.1 s is refused as late, and is sent again.
        while (entry.received, entry.rejected.total()) == before and time.monotonic() < end:
            commands.publish(wire.serialized(
                'command', Command(time.time(), np.zeros(4), np.full(4, 7.0)), source))
            bench.wait(lambda: (entry.received, entry.rejected.total()) != before, 0.5)
        return 'taken' if entry.received > before[0] else 'refused'

    assert bench.wait(lambda: answer('') == 'taken')    # no supervisor yet
    identities.publish(String(data=own))
    assert bench.wait(lambda: answer('') == 'refused')
    assert bench.wait(lambda: answer(own) == 'taken') and answer('x' * 100_000) == 'refused'
    assert any('2nd publisher' in one.message for one in node.component.diagnostics())


BEST_EFFORT = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)


def test_the_log_of_the_nodes_is_in_the_bag(make_bench, tmp_path):
    bench = make_bench(f'bag:={tmp_path}/bag')
    bench.user.get_logger().warning('before the recorder')
    recorder = bench.add(RecorderNode())
    bench.user.get_logger().error('beside the recorder')
    assert bench.wait(lambda: recorder._bag.counts.get('/rosout', 0) >= 2)
    recorder.close()
    lines = [from_bytes(one.data, one.type).msg for one in read_messages(tmp_path / 'bag')
             if one.topic == '/rosout']
    assert {'before the recorder', 'beside the recorder'} <= set(lines)


@pytest.mark.parametrize('profile', [wire.profile(EVENT), wire.profile(LATCHED), BEST_EFFORT])
def test_each_target_is_recorded_once_with_any_quality_of_service(make_bench, tmp_path, profile):
    bench, heights = make_bench(f'bag:={tmp_path}/bag'), [1.0, 1.1, 1.2]
    publisher = bench.user.create_publisher(PoseStamped, 'target_pose', profile)
    if profile.durability == wire.profile(LATCHED).durability:
        heights.insert(0, 0.9)
        publisher.publish(pose(0.9))    # before the subscription
    recorder = bench.add(RecorderNode())
    assert bench.wait(lambda: publisher.get_subscription_count()
                      and recorder.count_publishers('target_pose')
                      and recorder._bag.counts['/target_pose'] == len(heights) - 3)
    for height in heights[-3:]:
        before = recorder._bag.counts['/target_pose']
        publisher.publish(pose(height))
        assert bench.wait(lambda n=before: recorder._bag.counts['/target_pose'] == n + 1)
    bench.wait(lambda: False, 0.3)
    recorder.close()
    targets = read_bag(tmp_path / 'bag').targets
    assert [target.position[2] for target in targets] == heights
    assert targets[-1].stamp == pytest.approx(time.time(), abs=60)   # time of receipt
