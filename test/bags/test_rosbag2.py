"""Bags as ``ros2 bag`` reads them: metadata and frames."""

from importlib.util import find_spec
import shutil
import subprocess

import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from scipy.spatial.transform import Rotation
from synthetic_flights import fly
import yaml

from beetle_omni_ros.bags import conversions
from beetle_omni_ros.bags.bag_writer import BagWriter
from beetle_omni_ros.control.tasks import make_task
from beetle_omni_ros.model.parameters import RobotParameters


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
