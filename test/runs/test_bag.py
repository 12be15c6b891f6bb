"""Bags: round trip, independent readers, truncated files, refusals."""

import os
from pathlib import Path
import signal
import subprocess
import sys
import time
import tracemalloc

from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer
from mcap_ros2.decoder import DecoderFactory
import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from synthetic_flights import (
    fly,
    write_battery,
    write_command,
    write_imu,
    write_joints,
    write_request,
    write_state,
    write_wrench,
)
import yaml

from beetle_omni_ros.control.base import PoseTarget, TrajectoryTarget
from beetle_omni_ros.messages import conversions
from beetle_omni_ros.messages.bag_types import BAG, to_bytes, TYPESTORE
from beetle_omni_ros.messages.topics import TOPICS
from beetle_omni_ros.messages.values import Odom
from beetle_omni_ros.robot.readings import ImuReading
from beetle_omni_ros.runs.bag import (
    add_meta,
    BagError,
    BagWriter,
    check_new,
    read_bag,
    read_messages,
)
from beetle_omni_ros.runs.bag_files import read_together
from beetle_omni_ros.runs.bag_reader import replay
from beetle_omni_ros.runs.log import FlightLog
from beetle_omni_ros.runs.recorder import LogRecorder, Tee
from beetle_omni_ros.runs.tasks import make_task

META = {'task': 'lemniscate', 'conditions': 'nominal', 'seed': 4, 'version': '0.1.0'}


@pytest.fixture(scope='module')
def recorded(tmp_path_factory):
    """One short flight in memory and in a bag."""
    folder = tmp_path_factory.mktemp('bags') / 'flight'
    memory = LogRecorder(META)
    with BagWriter(folder, META) as writer:
        fly(Tee(memory, writer), make_task('lemniscate'), duration=4.0, start=50.0)
        write_wrench(Tee(memory, writer), 53.0, [0, 0, 3.0], [0.5, 0, 0])
        counts = writer.counts
    return folder, memory.log(), counts


def assert_equal_logs(a: FlightLog, b: FlightLog):
    for name, mine in vars(a).items():
        theirs = getattr(b, name)
        if isinstance(mine, np.ndarray):
            tolerance = 1e-5 if name.startswith('battery') else 1e-9  # float32 in the message
            assert mine.shape == theirs.shape, name
            np.testing.assert_allclose(mine, theirs, rtol=0, atol=tolerance, err_msg=name)
    assert len(a.targets) == len(b.targets)
    for mine, theirs in zip(a.targets, b.targets, strict=True):
        assert type(mine) is type(theirs)
        for name, value in vars(mine).items():
            np.testing.assert_allclose(value, getattr(theirs, name), atol=1e-9)
    for name, mine in a.requests.items():
        np.testing.assert_allclose(mine.tilt, b.requests[name].tilt)
    assert a.states == b.states
    assert a.compute == b.compute
    assert len(a.diagnostics) == len(b.diagnostics)
    assert a.meta == b.meta


def test_a_flight_round_trips_through_its_bag(recorded):
    folder, memory, _ = recorded
    log = read_bag(folder)
    assert_equal_logs(memory, log)
    assert log.warnings == []


def test_a_replay_is_incremental_without_the_omitted_topics(recorded):
    folder, memory, _ = recorded
    recorder, warnings, known = LogRecorder(), [], []
    times = []
    for part in replay(folder, recorder, warnings, leave_out=('imu/data_raw',)):
        times.append(part)
        known.append(len(recorder.log().odom_t))
    log = recorder.log()
    assert not len(log.imu_t) and not log.requests and memory.requests
    assert 0 < known[0] < known[-1] == len(memory.odom_t)
    np.testing.assert_allclose(log.joint_t, memory.joint_t, rtol=0, atol=1e-9)
    assert log.meta == memory.meta and not warnings
    assert np.concatenate(times).max() >= memory.end


def test_a_trajectory_round_trips_through_its_bag(tmp_path):
    target = make_task('lemniscate').targets(1.7e9)[1]
    with BagWriter(tmp_path / 'bag') as writer:
        writer.write_target(target)
    back, = read_bag(tmp_path / 'bag').targets
    assert isinstance(back, TrajectoryTarget)
    for name, value in vars(target).items():
        np.testing.assert_allclose(value, getattr(back, name), atol=5e-7, rtol=0)


def test_a_run_may_be_named_by_its_folder_its_mcap_file_or_its_metadata(recorded):
    folder, memory, _ = recorded
    for path in (folder / f'{folder.name}.mcap', folder / 'metadata.yaml', str(folder)):
        assert_equal_logs(memory, read_bag(path))


def test_two_independent_readers_agree_on_every_message(recorded):
    folder, _, counts = recorded
    theirs = {}
    with AnyReader([folder], default_typestore=TYPESTORE) as reader:
        for connection, t, raw in reader.messages():
            theirs.setdefault(connection.topic, []).append(
                (t, reader.deserialize(raw, connection.msgtype)))
    others = {}
    with open(folder / f'{folder.name}.mcap', 'rb') as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        for _, channel, message, decoded in reader.iter_decoded_messages():
            others.setdefault(channel.topic, []).append((message.log_time, decoded))
    assert {topic: len(found) for topic, found in theirs.items()} \
        == {topic: count for topic, count in counts.items() if count}
    assert set(theirs) == set(others)
    for topic, found in theirs.items():
        for (t, mine), (t2, other) in zip(found, others[topic], strict=True):
            assert t == t2
            if topic == '/ground_truth/odom':
                assert mine.pose.pose.position.x == other.pose.pose.position.x
                assert mine.twist.twist.angular.z == other.twist.twist.angular.z
                assert mine.header.stamp.nanosec == other.header.stamp.nanosec
            if topic == '/command':
                assert list(mine.name) == list(other.name)
                np.testing.assert_array_equal(mine.effort, other.effort)


def test_messages_by_topic_equal_those_in_order(recorded):
    folder, _, counts = recorded
    one_by_one, together = {}, {}
    for message in read_messages(folder):
        one_by_one.setdefault(message[:2], []).append(message[2:])
    for part in read_together(folder):
        for messages in part:
            assert len(messages.data) == len(messages.received)
            together.setdefault(messages[:2], []).extend(
                zip(messages.data, messages.received.tolist(), strict=True))
    assert together == one_by_one and list(together) == list(one_by_one)
    assert sum(map(len, together.values())) == sum(counts.values())


@pytest.mark.parametrize(('chunks', 'compression'), [
    (False, CompressionType.NONE), (True, CompressionType.ZSTD)])
def test_files_of_other_writers_give_the_same_messages(recorded, tmp_path, chunks, compression):
    folder, memory, _ = recorded
    with (tmp_path / 'other.mcap').open('wb') as stream, \
            (folder / f'{folder.name}.mcap').open('rb') as source:
        writer = Writer(stream, use_chunking=chunks, compression=compression)
        writer.start()
        channels = {}
        for schema, channel, message in make_reader(source).iter_messages():
            if channel.id not in channels:
                channels[channel.id] = writer.register_channel(
                    channel.topic, 'cdr', writer.register_schema(schema.name, 'ros2msg', b''))
            writer.add_message(channels[channel.id], message.log_time, message.data,
                               message.publish_time)
        writer.finish()
    log = read_bag(tmp_path / 'other.mcap')
    assert log.warnings == ['metadata.yaml is missing: the recorder did not finish']
    log.meta = memory.meta      # stands in metadata.yaml
    assert_equal_logs(memory, log)


def test_metadata_has_the_fields_for_ros2_bag_info(recorded):
    folder, _, counts = recorded
    information = yaml.safe_load((folder / 'metadata.yaml').read_text())[
        'rosbag2_bagfile_information']
    assert information['storage_identifier'] == 'mcap'
    assert information['message_count'] == sum(counts.values())
    topics = {entry['topic_metadata']['name']: entry['topic_metadata']
              for entry in information['topics_with_message_count']}
    assert set(topics) == {'/' + name for name in TOPICS}
    assert topics['/target_pose']['offered_qos_profiles'][0]['durability'] == 'transient_local'
    assert topics['/imu/data_raw']['offered_qos_profiles'][0]['reliability'] == 'best_effort'
    assert all(topic['type_description_hash'].startswith('RIHS01_') for topic in topics.values())


def test_a_command_is_laid_out_as_the_interface_says(recorded):
    folder, _, _ = recorded
    raw = next(m for m in read_messages(folder) if m.topic == '/command')
    message = TYPESTORE.deserialize_cdr(raw.data, raw.type)
    assert message.name == ['gimbal1', 'gimbal2', 'gimbal3', 'gimbal4',
                            'rotor1', 'rotor2', 'rotor3', 'rotor4']
    assert np.isnan(message.position).tolist() == [False] * 4 + [True] * 4
    assert np.isnan(message.effort).tolist() == [True] * 4 + [False] * 4
    assert len(message.velocity) == 0


def test_odometry_carries_the_twist_in_base_link():
    quaternion = np.array([0, 0, np.sqrt(0.5), np.sqrt(0.5)])  # yaw 90 deg
    message = conversions.write_odom(BAG, Odom(1.0, np.zeros(3), np.array([0.0, 2.0, 0.0]),
                                               quaternion, np.zeros(3)))
    twist = message.twist.twist.linear
    assert (twist.x, twist.y, twist.z) == pytest.approx((2.0, 0.0, 0.0))


def test_a_bag_cut_at_any_byte_reads_up_to_the_cut(recorded, tmp_path):
    folder, whole, _ = recorded
    with BagWriter(tmp_path / 'flushed') as writer:
        count = [0]

        class Flushing:
            def __getattr__(self, name):
                def write(*args, **kwargs):
                    count[0] += 1
                    if count[0] % 300 == 0:
                        writer.flush()
                    getattr(writer, name)(*args, **kwargs)
                return write
        fly(Flushing(), make_task('lemniscate'), duration=4.0, start=50.0)
    data = (tmp_path / 'flushed' / 'flushed.mcap').read_bytes()
    cut = tmp_path / 'cut'
    cut.mkdir()
    rng = np.random.default_rng(0)
    for size in [*sorted(rng.integers(len(data) // 4, len(data), 12)), len(data) - 100]:
        (cut / 'cut.mcap').write_bytes(data[:size])
        log = read_bag(cut)
        n = len(log.truth_t)
        np.testing.assert_array_equal(log.truth_position, whole.truth_position[:n])
        assert any('cut off' in warning for warning in log.warnings)
        assert any('metadata.yaml is missing' in warning for warning in log.warnings)
    assert n > 0.9 * len(whole.truth_t)
    for size in (0, 4, 8, 300):     # before the first message
        (cut / 'cut.mcap').write_bytes(data[:size])
        with pytest.raises(BagError, match='cut.mcap: cut off after 0 readable messages'):
            read_bag(cut)


def test_flushed_messages_survive_a_sigkill(tmp_path):
    program = (
        'import sys, time; from beetle_omni_ros.runs.bag import BagWriter\n'
        'from beetle_omni_ros.robot.readings import ImuReading\n'
        'w = BagWriter(sys.argv[1])\n'
        'for k in range(50): w.write("imu/data_raw", ImuReading(k * 0.005, (0, 0, 9.8), '
        '(0, 0, 0)))\n'
        'w.flush(); print("flushed", flush=True); time.sleep(60)\n')
    root = Path(__file__).parents[2]
    process = subprocess.Popen([sys.executable, '-c', program, str(tmp_path / 'killed')],
                               stdout=subprocess.PIPE, env={**os.environ, 'PYTHONPATH': str(root)})
    assert process.stdout.readline() == b'flushed\n'
    process.send_signal(signal.SIGKILL)
    process.wait()
    process.stdout.close()
    assert len(read_bag(tmp_path / 'killed').imu_t) == 50


def test_a_damaged_file_is_read_up_to_the_damage(recorded, tmp_path):
    folder, _, _ = recorded
    data = bytearray((folder / f'{folder.name}.mcap').read_bytes())
    middle = len(data) // 2
    data[middle:middle + 4000] = np.random.default_rng(0).bytes(4000)
    file = tmp_path / 'damaged.mcap'
    file.write_bytes(data)
    log = read_bag(file)
    assert log.warnings


def test_a_folder_that_exists_or_cannot_be_made_is_refused_in_one_line(tmp_path):
    (tmp_path / 'file').write_text('')
    for path in (tmp_path, tmp_path / 'file', tmp_path / 'file' / 'bag'):
        for refuse in (check_new, BagWriter):
            with pytest.raises(BagError, match=str(path)) as error:
                refuse(path)
            assert '\n' not in str(error.value)


@pytest.mark.skipif(os.geteuid() == 0, reason='root may write anywhere')
def test_a_folder_without_permission_is_refused(tmp_path):
    tmp_path.chmod(0o500)
    with pytest.raises(BagError, match='permission'):
        BagWriter(tmp_path / 'bag')


def test_a_path_that_is_not_a_bag_is_refused(tmp_path):
    (tmp_path / 'empty').mkdir()
    (tmp_path / 'text.mcap').write_text('hello, this is no bag at all')
    (tmp_path / 'short.mcap').write_text('hello')
    (tmp_path / 'notes.txt').write_text('x')
    (tmp_path / 'old').mkdir()
    (tmp_path / 'old' / 'old.db3').write_text('')
    for name, reason in (('none', 'no such bag'), ('empty', r'no \.mcap file'),
                         ('text.mcap', 'not an MCAP file'),
                         ('short.mcap', 'not an MCAP file'), ('notes.txt', 'expected a rosbag2'),
                         ('old', 'ros2 bag convert')):
        with pytest.raises(BagError, match=reason) as error:
            read_bag(tmp_path / name)
        assert name in str(error.value)


def test_missing_topics_are_named(tmp_path):
    with BagWriter(tmp_path / 'bag') as writer:
        write_imu(writer, 1.0, (0, 0, 9.8), (0, 0, 0))
    warning = read_bag(tmp_path / 'bag').warnings[0]
    for name in ('mocap/pose', 'joint_states', 'odom', 'command', 'target_pose'):
        assert name in warning
    assert 'imu' not in warning


def test_an_empty_bag_is_readable(tmp_path):
    with BagWriter(tmp_path / 'bag'):
        pass
    assert len(read_bag(tmp_path / 'bag').truth_t) == 0
    with AnyReader([tmp_path / 'bag'], default_typestore=TYPESTORE) as reader:
        assert reader.message_count == 0


def joint_states(t, names, position, velocity=()):
    """Type and bytes of a message with any names."""
    message = BAG.new('sensor_msgs/msg/JointState')
    conversions.set_time(message.header.stamp, t)
    message.name, message.position = names, BAG.doubles(position)
    message.velocity = BAG.doubles(velocity)
    return 'sensor_msgs/msg/JointState', to_bytes(message, 'sensor_msgs/msg/JointState')


def test_a_message_that_cannot_be_used_is_counted_and_loses_no_other(tmp_path):
    with BagWriter(tmp_path / 'bag') as writer:
        write_joints(writer, 1.0, np.ones(4), np.zeros(4))
        writer.write_raw('/joint_states', *joint_states(2.0, ['wheel'], [1.0], [0.0]), 2.0)
        writer.write_raw('/odom', 'nav_msgs/msg/Odometry', b'\x00\x01\x00\x00', 2.5)
        write_joints(writer, 3.0, np.ones(4), np.zeros(4))
    log = read_bag(tmp_path / 'bag')
    assert log.joint_t.tolist() == [1.0, 3.0]
    assert any('joint_states: 1 messages not used' in w and 'gimbal1' in w for w in log.warnings)
    assert any('odom: 1 messages not used' in w for w in log.warnings)


def test_joints_are_found_by_name_in_any_order(tmp_path):
    with BagWriter(tmp_path / 'bag') as writer:
        writer.write_raw('/joint_states', *joint_states(
            1.0, ['gimbal3', 'gimbal1', 'extra', 'gimbal4', 'gimbal2'], [3.0, 1, 9, 4, 2]), 1.0)
    assert read_bag(tmp_path / 'bag').joint_position.tolist() == [[1, 2, 3, 4]]


def test_raw_messages_and_late_topics_stay_readable_by_both_readers(tmp_path):
    text = to_bytes(conversions.write_text(BAG, 'hello'), 'std_msgs/msg/String')
    with BagWriter(tmp_path / 'bag', topics=['imu/data_raw']) as writer:
        write_imu(writer, 1.0, (0, 0, 9.8), (0, 0, 0))
        writer.write_raw('/notes', 'std_msgs/msg/String', text, 2.0)
        write_imu(writer, 3.0, (0, 0, 9.8), (0, 0, 0))
        with pytest.raises(BagError, match='unknown type'):
            writer.write_raw('/odd', 'odd_msgs/msg/Odd', b'', 3.0)
    with open(tmp_path / 'bag' / 'bag.mcap', 'rb') as stream:
        found = [(c.topic, m.log_time) for _, c, m, _ in make_reader(
            stream, decoder_factories=[DecoderFactory()]).iter_decoded_messages()]
    assert found == [('/imu/data_raw', 10**9), ('/notes', 2 * 10**9), ('/imu/data_raw', 3 * 10**9)]
    assert len(read_bag(tmp_path / 'bag').imu_t) == 2


def test_namespaces_are_removed_and_several_robots_need_a_choice(tmp_path):
    with BagWriter(tmp_path / 'one', namespace='robot1') as writer:
        write_command(writer, 1.0, np.ones(4), np.ones(4))
        write_request(writer, 'nmpc', 1.0, np.zeros(4), np.ones(4))
        imu = to_bytes(conversions.write_imu(BAG, ImuReading(2.0, (0, 0, 1), (0, 0, 0))),
                       'sensor_msgs/msg/Imu')
        writer.write_raw('/robot2/imu/data_raw', 'sensor_msgs/msg/Imu', imu, 2.0)
    with pytest.raises(BagError, match='several robots'):
        read_bag(tmp_path / 'one')
    log = read_bag(tmp_path / 'one', namespace='robot1')
    assert (len(log.command_t), len(log.requests['nmpc'].t), len(log.imu_t)) == (1, 1, 0)
    assert len(read_bag(tmp_path / 'one', namespace='/robot2/').imu_t) == 1


@pytest.mark.parametrize('t', [0.0, 0.1, 1.005, 1.7e9 + 0.123456789, 1.9e9 - 1e-6])
def test_times_are_stored_exactly(t):
    again = conversions.from_nanoseconds(conversions.nanoseconds(t))
    assert again == pytest.approx(t, rel=1e-16, abs=1e-9)


def test_an_unset_stamp_is_the_time_of_receipt(tmp_path):
    with BagWriter(tmp_path / 'bag') as writer:
        writer.write_target(PoseTarget(np.ones(3), np.array([0, 0, 0, 1.0]), 0.0), received=7.5)
    assert read_bag(tmp_path / 'bag').targets[0].stamp == pytest.approx(7.5)


def test_compute_times_and_the_run_come_from_the_diagnostics_of_the_nodes(tmp_path):
    with BagWriter(tmp_path / 'bag') as writer:
        for count in (10, 20):
            writer.write_diagnostic(count, 'robot1/nmpc_node: compute', {
                'median_ms': '0.2', 'p99_ms': '0.5', 'max_ms': count, 'deadline_misses': '1',
                'count': count, 'wall_max_ms': 9})
        writer.write_diagnostic(3.0, 'fly: run', {'task': 'waypoints', 'seed': '7'})
    log = read_bag(tmp_path / 'bag')
    assert log.compute == {'nmpc': {'median': 0.2, 'p99': 0.5, 'max': 20.0,
                                    'deadline_misses': 1, 'count': 20}}
    assert len(log.compute_history['nmpc']) == 2
    assert log.meta == {'task': 'waypoints', 'seed': 7}


def test_meta_data_can_be_added_to_a_finished_bag(tmp_path):
    with BagWriter(tmp_path / 'bag', {'task': 'hover'}) as writer:
        write_imu(writer, 1.0, (0, 0, 9.8), (0, 0, 0))
    add_meta(tmp_path / 'bag', {'seed': 3})
    assert read_bag(tmp_path / 'bag').meta == {'task': 'hover', 'seed': 3}
    with AnyReader([tmp_path / 'bag'], default_typestore=TYPESTORE) as reader:
        assert reader.message_count == 2
    (tmp_path / 'bag' / 'metadata.yaml').unlink()
    with pytest.raises(BagError, match=r'metadata\.yaml'):
        add_meta(tmp_path / 'bag', {})
    assert read_bag(tmp_path / 'bag').meta == {'task': 'hover'}


def test_closing_twice_and_writing_after_the_end_are_harmless(tmp_path):
    writer = BagWriter(tmp_path / 'bag')
    writer.close()
    writer.close()
    writer.flush()
    with pytest.raises(BagError, match='closed'):
        write_imu(writer, time.time(), (0, 0, 9.8), (0, 0, 0))


def test_a_long_recording_takes_no_memory_and_its_index_is_complete(tmp_path):
    def record(count, begin):
        for k in range(count):
            for name in ('state', 'battery'):
                (write_state(writer, begin + k, 'flying:nmpc') if name == 'state' else
                 write_battery(writer, begin + k, 24.0, -9.0))
            writer.flush()

    with BagWriter(tmp_path / 'bag') as writer:
        record(200, 0)
        tracemalloc.start()
        before = tracemalloc.get_traced_memory()[0]
        record(2000, 200)
        grown = tracemalloc.get_traced_memory()[0] - before
        tracemalloc.stop()
    assert grown < 60_000       # 30 bytes a chunk; the records have 250
    assert {path.suffix for path in (tmp_path / 'bag').iterdir()} == {'.mcap', '.yaml'}
    with next((tmp_path / 'bag').glob('*.mcap')).open('rb') as file:
        summary = make_reader(file).get_summary()
        assert len(summary.chunk_indexes) == summary.statistics.chunk_count >= 2200
        assert sum(1 for _ in make_reader(file).iter_messages()) == 4400
    with AnyReader([tmp_path / 'bag']) as reader:
        assert sum(1 for _ in reader.messages()) == 4400
