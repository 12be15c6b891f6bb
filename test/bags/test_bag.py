"""Bags: round trip, independent readers, truncated files, refusals."""

from importlib.util import find_spec
from pathlib import Path
import shutil
import subprocess

from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer
import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from scipy.spatial.transform import Rotation
from synthetic_flights import (
    fly,
    write_command,
    write_diagnostic,
    write_imu,
    write_joints,
)
import yaml

from beetle_omni_ros.bags import conversions
from beetle_omni_ros.bags.bag import names_of, read_bag
from beetle_omni_ros.bags.bag_writer import BagWriter, set_meta
from beetle_omni_ros.bags.log import FlightLog, LogRecorder, Recorder, SERIES
from beetle_omni_ros.bags.messages import new, to_bytes, TYPESTORE, Wrench
from beetle_omni_ros.control.base import Command
from beetle_omni_ros.control.tasks import make_task
from beetle_omni_ros.model.allocation import ALL_HEALTHY
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.model.schema import ParameterError

META = {'task': 'lemniscate', 'conditions': 'nominal', 'seed': 4, 'version': '0.1.0'}


@pytest.fixture(scope='module')
def recorded(tmp_path_factory):
    """One short flight in memory and in a bag."""
    folder = tmp_path_factory.mktemp('bags') / 'flight'
    memory = LogRecorder(META)
    with BagWriter(folder, META) as writer:
        fly(Recorder(memory, writer), make_task('lemniscate'), duration=4.0, start=50.0)
        Recorder(memory, writer).write('disturbance', Wrench(53.0, [0, 0, 3.0], [0.5, 0, 0]))
    return folder, memory.log()


def assert_equal_logs(a: FlightLog, b: FlightLog):
    def parts(log):
        return [*(getattr(log, name) for name in SERIES), *log.requests.values(), *log.targets]

    for mine, theirs in zip(parts(a), parts(b), strict=True):
        assert type(mine) is type(theirs)
        tolerance = 1e-5 if mine is a.battery else 1e-9     # float32 in the message
        for name, value in vars(mine).items():
            np.testing.assert_allclose(value, getattr(theirs, name), rtol=0, atol=tolerance,
                                       err_msg=name)
    assert np.allclose(a.state_t, b.state_t, rtol=0, atol=1e-9)
    assert (a.states, a.compute, a.meta) == (b.states, b.compute, b.meta)
    assert len(a.diagnostics) == len(b.diagnostics)


@pytest.mark.parametrize('name', ['', 'flight.mcap'])
def test_a_flight_round_trips_through_its_bag_named_by_folder_or_file(recorded, name):
    folder, memory = recorded
    log = read_bag(folder / name)
    assert_equal_logs(memory, log)
    assert log.warnings == []


@pytest.mark.parametrize(('chunks', 'compression'), [
    (False, CompressionType.NONE), (True, CompressionType.ZSTD)])
def test_files_of_other_writers_give_the_same_messages(recorded, tmp_path, chunks, compression):
    folder, memory = recorded
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
    log.meta = memory.meta      # is in metadata.yaml
    assert_equal_logs(memory, log)


def test_a_message_that_cannot_be_used_is_counted_and_loses_no_other(tmp_path):
    with BagWriter(tmp_path / 'bag') as writer:
        write_joints(writer, 1.0, np.ones(4), np.zeros(4))
        odd = new('sensor_msgs/msg/JointState')
        odd.name, odd.position = ['wheel'], np.ones(1)
        writer.write_raw('/joint_states', odd.__msgtype__, to_bytes(odd, odd.__msgtype__), 2.0)
        writer.write_raw('/odom', 'nav_msgs/msg/Odometry', b'\x00\x01\x00\x00', 2.5)
        write_joints(writer, 3.0, np.ones(4), np.zeros(4))
    log = read_bag(tmp_path / 'bag')
    assert log.joint.t.tolist() == [1.0, 3.0]
    assert any('joint_states: 1 messages not used' in w and 'gimbal1' in w for w in log.warnings)
    assert any('odom: 1 messages not used' in w for w in log.warnings)


def test_values_without_a_stamp_are_read_without_a_warning(tmp_path):
    with BagWriter(tmp_path / 'bag', {}) as writer:
        writer.write('supervisor/actuators', ALL_HEALTHY, 1.0)
        writer.write('supervisor/target', None, 1.0)
    assert not [line for line in read_bag(tmp_path / 'bag').warnings if 'not used' in line]


def test_namespaces_are_removed_and_several_robots_refused(tmp_path):
    with BagWriter(tmp_path / 'bag', namespace='robot1') as writer:
        write_command(writer, 1.0, np.ones(4), np.ones(4))
        writer.write('nmpc/command', Command(1.0, np.zeros(4), np.ones(4)))
        write_imu(writer, 2.0, (0, 0, 1), (0, 0, 0))
    log = read_bag(tmp_path / 'bag')
    assert (len(log.command.t), len(log.requests['nmpc'].t), len(log.imu.t)) == (1, 1, 1)
    with BagWriter(tmp_path / 'both', namespace='robot1') as writer:
        write_imu(writer, 2.0, (0, 0, 1), (0, 0, 0))
        writer.write_raw('/robot2/imu/data_raw', 'sensor_msgs/msg/Imu', b'', 2.0)
    with pytest.raises(ParameterError, match='several robots'):
        read_bag(tmp_path / 'both')


def test_a_folder_of_runs_is_refused_with_their_names(tmp_path):
    for name in ('rl', 'nmpc'):
        with BagWriter(tmp_path / 'runs' / name) as writer:
            write_imu(writer, 1.0, (0, 0, 9.8), (0, 0, 0))
    with pytest.raises(ParameterError, match='expected one of the runs in it: nmpc, rl$'):
        read_bag(tmp_path / 'runs')


def test_compute_times_come_from_the_diagnostics_of_the_nodes(tmp_path):
    with BagWriter(tmp_path / 'bag') as writer:
        for count in (10, 20):
            write_diagnostic(writer, count, 'robot1/nmpc_node: compute', {
                'median_ms': '0.2', 'p99_ms': '0.5', 'max_ms': count, 'deadline_misses': '1',
                'count': count, 'wall_max_ms': 9})
        write_diagnostic(writer, 30, 'nmpc_node: compute', dict.fromkeys(
            ('median_ms', 'p99_ms', 'max_ms', 'deadline_misses', 'count'), 'many'))
    log = read_bag(tmp_path / 'bag')
    assert log.compute == {'nmpc': {'median': 0.2, 'p99': 0.5, 'max': 20.0,
                                    'deadline_misses': 1, 'count': 20}}
    assert len(log.compute_history['nmpc']) == 2
    assert 'diagnostics: 1 messages not used' in log.warnings[-1]


def test_a_flight_counts_as_interrupted_until_its_end_sets_the_meta_data(tmp_path):
    with BagWriter(tmp_path / 'bag', {'task': 'hover', 'interrupted': True}) as writer:
        write_imu(writer, 1.0, (0, 0, 9.8), (0, 0, 0))
    assert read_bag(tmp_path / 'bag').warnings[0] == 'interrupted; kept what was flown'
    set_meta(tmp_path / 'bag', {'seed': 3})
    assert read_bag(tmp_path / 'bag').meta == {'seed': 3}
    with AnyReader([tmp_path / 'bag'], default_typestore=TYPESTORE) as reader:
        assert reader.message_count == 1


@pytest.mark.parametrize('paths, names', [
    (['/a/one', '/a/two'], ['one', 'two']), (['/a/one/bag', '/a/two/bag'], ['one/bag', 'two/bag']),
    (['/a/1/x/bag', '/b/1/x/bag'], ['a/1/x/bag', 'b/1/x/bag'])])
def test_recordings_have_distinct_names(paths, names):
    assert names_of([Path(path) for path in paths]) == names


# --- as `ros2 bag` reads them --------------------------------------------------------------------

@pytest.fixture(scope='module')
def plain(tmp_path_factory):
    folder = tmp_path_factory.mktemp('bags') / 'plain'
    with BagWriter(folder, {'task': 'hover'}) as writer:
        fly(writer, make_task('hover'), duration=2.0, start=1.7e9)
    return folder


def test_metadata_has_real_times_and_the_quality_of_service_of_each_topic(plain):
    found = yaml.safe_load((plain / 'metadata.yaml').read_text())['rosbag2_bagfile_information']
    assert (found['version'], found['storage_identifier']) == (9, 'mcap')
    assert found['starting_time']['nanoseconds_since_epoch'] >= 1_699_999_999 * 10**9
    offered = {entry['topic_metadata']['name']: entry['topic_metadata']['offered_qos_profiles']
               for entry in found['topics_with_message_count']}
    qos, = offered['/supervisor/state']
    assert (qos['history'], qos['depth'], qos['reliability'], qos['durability']) \
        == ('keep_last', 1, 'reliable', 'transient_local')
    assert offered['/imu/data_raw'][0]['reliability'] == 'best_effort'


@pytest.mark.skipif(not shutil.which('ros2') or find_spec('ros2bag') is None,
                    reason='no `ros2 bag` in this environment')
def test_ros2_bag_info_and_play_accept_a_bag(plain):
    output = subprocess.run(['ros2', 'bag', 'info', str(plain)], capture_output=True, text=True,
                          timeout=60, check=True).stdout
    assert '/imu/data_raw' in output and 'mcap' in output
    subprocess.run(['ros2', 'bag', 'play', '--rate', '10', str(plain)], capture_output=True,
                   timeout=60, check=True)


def test_the_frames_in_the_bag_agree_with_estimate_and_joints(tmp_path):
    robot = RobotParameters.load()
    with BagWriter(tmp_path / 'bag', namespace='robot1', frames=True) as writer:
        fly(writer, make_task('hover'), duration=2.0, start=1.7e9)
    messages = {}
    with AnyReader([tmp_path / 'bag']) as reader:
        for connection, t, data in reader.messages():
            messages.setdefault(connection.topic, []).append(
                reader.deserialize(data, connection.msgtype))
    assert len(messages['/tf_static']) == len(messages['/robot1/robot_description']) == 1
    fixed = {frame.child_frame_id: frame for frame in messages['/tf_static'][0].transforms}
    odom, joints = ({conversions.seconds(message.header.stamp): message
                     for message in messages[f'/robot1/{name}']}
                    for name in ('odom', 'joint_states'))
    assert len(messages['/tf']) > 20
    for message in messages['/tf'][::20]:
        frames = {**fixed, **{frame.child_frame_id: frame for frame in message.transforms}}
        here = odom[conversions.seconds(frames['base_link'].header.stamp)].pose.pose
        q = joints[conversions.seconds(frames['module1'].header.stamp)].position
        body = Rotation.from_quat(conversions.xyzw(here.orientation))
        for k in range(4):
            axes, at, name = Rotation.identity(), np.zeros(3), f'rotor{k + 1}'
            while name != 'world':
                frame = frames[name]
                turn = Rotation.from_quat(conversions.xyzw(frame.transform.rotation))
                axes = turn * axes
                at = turn.apply(at) + conversions.xyz(frame.transform.translation)
                name = frame.header.frame_id
            np.testing.assert_allclose(at, conversions.xyz(here.position) + body.apply(
                robot.rotors.positions[k]), atol=1e-7)
            tilt = Rotation.from_rotvec(q[k] * robot.tilt_axes[k])
            np.testing.assert_allclose(axes.apply([0, 0, 1]), (body * tilt).apply([0, 0, 1]),
                                       atol=1e-7)
