"""Readings of the blind sensors, and their bags."""

from gap_data.bags import write_bag
from gap_data.courses import Course
from gap_data.flight import COLUMNS, Truth
from gap_data.hidden import Hidden
from gap_data.sensors import low_pass, measure
from gap_data.truth import Robot
import numpy as np
import pytest
from rosbags.rosbag2 import Reader
from rosbags.typesys import get_typestore, Stores
from scipy.spatial.transform import Rotation

NUMBERS = Robot().numbers
SILENT = {'accelerometer': 0, 'gyroscope': 0, 'position': 0, 'orientation': 0, 'tilt': 0}


def made_up(seconds=4.0):
    """A true motion of smooth waves, which replaces a flight."""
    t = np.arange(int(seconds * 1000)) * 0.001
    columns = {name: np.sin(2 * np.pi * 0.7 * t[:, None] + np.arange(size))
               for name, size in COLUMNS.items()}
    turn = Rotation.from_rotvec(0.5 * np.sin(t)[:, None] * [1, 0.3, -0.5]).as_quat()
    columns['quaternion'] = turn[:, [3, 0, 1, 2]]
    stamps = np.arange(0, seconds, 0.01)
    still = np.zeros((1, 3))
    course = Course(still, still, still, np.eye(3)[None], still)
    return Truth(t, columns, stamps, np.full((len(stamps), 4), 0.1),
                 np.full((len(stamps), 4), 7.0), course)


def sample(hidden=None, noise=SILENT, truth=None, seed=0):
    return measure(truth or made_up(), hidden or Hidden(), NUMBERS, np.random.default_rng(seed),
                   noise=noise)


def test_stamps_are_capture_times_at_the_interface_rates():
    truth, recording = made_up(), sample()
    for name, rate in (('imu', 200), ('mocap', 100), ('joints', 200), ('battery', 10)):
        assert np.diff(recording[name][:, 0]) == pytest.approx(1 / rate)
    assert recording['imu'][:, 1:4] == pytest.approx(truth.columns['specific_force'][::5])
    assert recording['mocap'][:, 1:4] == pytest.approx(truth.columns['position'][::10])
    assert np.abs(recording['joints'][:, 1:5] - truth.columns['tilt'][::5]).max() <= (
        np.pi / 4096 + 1e-12)


def test_delays_make_readings_older_than_their_stamps():
    old = sample(Hidden(mocap_delay=0.02, joint_feedback_delay=0.015))
    now = sample()
    assert old['mocap'][10:, 1:4] == pytest.approx(now['mocap'][8:-2, 1:4])
    assert old['joints'][10:, 1:5] == pytest.approx(now['joints'][7:-3, 1:5])


@pytest.mark.parametrize('shape', ['plain', 'butterworth'])
def test_filter_has_its_group_delay(shape):
    t = np.arange(4000) * 0.001
    late = low_pass(np.sin(2 * np.pi * t)[:, None], 0.015, 0.001, shape)[:, 0]
    assert late[1000:] == pytest.approx(np.sin(2 * np.pi * (t[1000:] - 0.015)), abs=0.01)


def test_biases_and_mounting_appear_in_readings():
    rotation = np.array([0.05, -0.02, 0.03])
    hidden = Hidden(accelerometer_bias=np.array([0.1, 0.2, 0.3]), imu_rotation=rotation,
                    gyroscope_bias=np.array([0.01, 0, 0]), mocap_rotation=rotation)
    askew, straight = sample(hidden), sample()
    turn = Rotation.from_rotvec(rotation)  # sensor axes seen from base_link
    force, rate = (turn.inv().apply(straight['imu'][:, part]) for part in (
        slice(1, 4), slice(4, 7)))
    assert askew['imu'][:, 1:4] == pytest.approx(force + [0.1, 0.2, 0.3])
    assert askew['imu'][:, 4:] == pytest.approx(rate + [0.01, 0, 0])
    before, after = (Rotation.from_quat(made['mocap'][:, 4:]) for made in (straight, askew))
    assert (before.inv() * after).as_rotvec() == pytest.approx(np.tile(rotation, (len(after), 1)))


def read(path):
    store, rows = get_typestore(Stores.ROS2_JAZZY), {}
    with Reader(path) as reader:
        for connection, received, data in reader.messages():
            message = store.deserialize_cdr(data, connection.msgtype)
            rows.setdefault(connection.topic, []).append((received * 1e-9, message))
    return rows


def stamp(message):
    return message.header.stamp.sec + message.header.stamp.nanosec * 1e-9


def test_a_bag_contains_the_topics_of_the_interface(tmp_path):
    recording = sample()
    write_bag(tmp_path / 'bag', recording, epoch=1_780_000_000)
    rows = read(tmp_path / 'bag')
    assert set(rows) == {'/mocap/pose', '/imu/data_raw', '/joint_states', '/battery_state',
                         '/command'}
    received, command = rows['/command'][5]
    assert list(command.name) == [f'gimbal{i}' for i in range(1, 5)] + [
        f'rotor{i}' for i in range(1, 5)]
    assert command.position[:4] == pytest.approx([0.1] * 4)
    assert np.isnan(command.position[4:]).all() and np.isnan(command.effort[:4]).all()
    assert command.effort[4:] == pytest.approx([7.0] * 4)
    assert stamp(command) == pytest.approx(1.78e9 + 0.05, abs=1e-6)
    assert received >= stamp(command)
    _, imu = rows['/imu/data_raw'][3]
    assert imu.orientation_covariance[0] == -1
    assert imu.linear_acceleration.x == pytest.approx(recording['imu'][3, 1])
    assert imu.angular_velocity.z == pytest.approx(recording['imu'][3, 6])
