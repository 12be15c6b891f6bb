"""Bags have the format of ``ros2 bag record`` of Jazzy: metadata, type hashes."""

from importlib.util import find_spec
import json
from pathlib import Path
import shutil
import subprocess
import sys

from mcap.reader import make_reader
import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from scipy.spatial.transform import Rotation
from synthetic_flights import fly
import yaml

from beetle_omni_ros.messages import conversions
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.runs.bag_writer import BagWriter
from beetle_omni_ros.runs.tasks import make_task

INTERFACES = Path(sys.prefix) / 'share'     # of the message packages, where ROS is of PyPI


@pytest.fixture(scope='module')
def plain(tmp_path_factory):
    folder = tmp_path_factory.mktemp('bags') / 'plain'
    with BagWriter(folder, {'task': 'hover'}) as writer:
        fly(writer, make_task('hover'), duration=2.0, start=1.7e9)
    return folder


def information(bag):
    return yaml.safe_load((bag / 'metadata.yaml').read_text())['rosbag2_bagfile_information']


def topics(bag):
    """Name -> metadata of a topic."""
    return {entry['topic_metadata']['name']: entry['topic_metadata']
            for entry in information(bag)['topics_with_message_count']}


def test_metadata_has_the_fields_of_version_9_and_names_jazzy(plain):
    found = information(plain)
    assert set(found) == {
        'version', 'storage_identifier', 'duration', 'starting_time', 'message_count',
        'topics_with_message_count', 'compression_format', 'compression_mode',
        'relative_file_paths', 'files', 'custom_data', 'ros_distro'}
    assert (found['version'], found['storage_identifier'], found['ros_distro']) \
        == (9, 'mcap', 'jazzy')
    assert found['starting_time']['nanoseconds_since_epoch'] >= 1_699_999_999 * 10**9
    state = topics(plain)['/supervisor/state']
    assert set(state) == {'name', 'type', 'serialization_format', 'offered_qos_profiles',
                          'type_description_hash'}
    qos, = state['offered_qos_profiles']
    assert (qos['history'], qos['depth'], qos['reliability'], qos['durability']) \
        == ('keep_last', 1, 'reliable', 'transient_local')
    qos, = topics(plain)['/imu/data_raw']['offered_qos_profiles']
    assert qos['reliability'] == 'best_effort'


def test_the_file_contains_the_same_metadata_and_hashes(plain):
    with next(plain.glob('*.mcap')).open('rb') as stream:
        reader = make_reader(stream)
        assert reader.get_header().profile == 'ros2'
        channels = {c.topic: c.metadata for c in reader.get_summary().channels.values()}
        record, = (r for r in reader.iter_metadata() if r.name == 'rosbag2')
    assert yaml.safe_load(record.metadata['serialized_metadata']) == information(plain)
    for topic in topics(plain).values():
        own = channels[topic['name']]
        assert own['topic_type_hash'] == topic['type_description_hash']
        assert yaml.safe_load(own['offered_qos_profiles']) == topic['offered_qos_profiles']


@pytest.mark.skipif(not (INTERFACES / 'std_msgs/msg/String.json').is_file(),
                    reason='no message packages in this environment')
def test_type_hashes_are_those_of_the_installed_message_packages(plain):
    for topic in topics(plain).values():
        described = json.loads((INTERFACES / f"{topic['type']}.json").read_text())
        hashes = {one['type_name']: one['hash_string'] for one in described['type_hashes']}
        assert topic['type_description_hash'] == hashes[topic['type']], topic['type']


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
