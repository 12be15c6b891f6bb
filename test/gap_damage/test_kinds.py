"""Every kind of damage has its described effect and no other."""

from gap_damage_kinds.catalogue import KINDS
from gap_damage_kinds.kind import HARMLESS
from gap_damage_kinds.recording import BATTERY, COMMAND, IMU, JOINTS, MEASURED, MOCAP, Recording
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from small_bags import DURATION, small_bag

from beetle_omni_ros.messages.bag_types import TYPESTORE
from beetle_omni_ros.runs.bag_files import BagError

TIMES = ('received_hour_late', 'another_day', 'duplicates', 'two_flights',
         'in_namespace')      # touch every topic
FEWER = {'mocap_missing', 'mocap_silent', 'battery_missing', 'joints_lossy'}
MORE = {'duplicates', 'two_flights'}


@pytest.fixture(scope='module')
def flights(tmp_path_factory):
    folder = tmp_path_factory.mktemp('bags')
    return [Recording.read(small_bag(folder / name, phase))
            for name, phase in (('one', 0.0), ('other', 0.7))]


def raw(recording, name):
    return [(m.data, m.received) for m in recording.on(name)]


def damaged(flights, name):
    return KINDS[name].apply(*flights, seed=3)[0]


@pytest.mark.parametrize('name', KINDS)
def test_a_kind_changes_its_topics_and_no_other(flights, name):
    kind, before = KINDS[name], flights[0]
    after, onset = kind.apply(*flights, seed=3)
    changed = {topic for topic in (*MEASURED, BATTERY)
               if raw(before, topic) != raw(after, topic)}
    if name not in TIMES and name not in ('nothing', 'cut_off'):
        assert changed == set(kind.topics)
    if name not in FEWER | MORE | {'in_namespace'}:
        assert after.counts() == before.counts()
    if onset is not None:
        assert before.stamps(MOCAP)[0] < onset < before.stamps(MOCAP)[-1]
    times = [m.received for m in after.messages]
    assert times == sorted(times)
    for m in after.messages[::7]:
        TYPESTORE.deserialize_cdr(m.data, m.type)


@pytest.mark.parametrize('name', ['duplicates', 'another_day', 'in_namespace', 'mocap_missing',
                                  'joints_reordered', 'two_flights'])
def test_a_damaged_bag_is_written_as_it_stands(flights, name, tmp_path):
    after = damaged(flights, name)
    again = Recording.read(after.write(tmp_path / 'bag'))
    assert again.counts() == after.counts()
    for topic in (*MEASURED, BATTERY):
        assert [m.data for m in again.on(topic)] == [m.data for m in after.on(topic)]


def test_damage_is_the_same_for_the_same_seed_and_leaves_the_original(flights):
    kind = KINDS['mocap_outliers']
    first, again, another = (kind.apply(*flights, seed=s) for s in (1, 1, 2))
    assert raw(first[0], MOCAP) == raw(again[0], MOCAP) and first[1] == again[1]
    assert raw(first[0], MOCAP) != raw(another[0], MOCAP)


def test_each_damage_has_a_cause_and_controls_have_none():
    for kind in KINDS.values():
        assert bool(kind.causes) == (kind.harm != HARMLESS), kind.name


def values(flights, name, topic):
    return flights[0].values(topic), damaged(flights, name).values(topic)


@pytest.mark.parametrize(('name', 'topic', 'factor'), [
    ('mocap_millimetres', MOCAP, [1e3] * 3 + [1] * 4),
    ('mocap_centimetres', MOCAP, [1e2] * 3 + [1] * 4),
    ('mocap_conjugate', MOCAP, [1] * 3 + [-1] * 3 + [1]),
    ('gyroscope_degrees', IMU, [1] * 3 + [180 / np.pi] * 3),
    ('accelerometer_g', IMU, [1 / 9.80665] * 3 + [1] * 3),
    ('imu_upside_down', IMU, [1, -1, -1] * 2),
    ('joint_sign', JOINTS, [1, 1, -1, 1] * 2),
    ('tilt_degrees', COMMAND, [180 / np.pi] * 4 + [1] * 4),
    ('thrust_percent', COMMAND, [1] * 4 + [5] * 4)])
def test_scales_and_signs(flights, name, topic, factor):
    before, after = values(flights, name, topic)
    np.testing.assert_allclose(after, before * factor, atol=1e-12)


def test_swapped_entries(flights):
    before, after = values(flights, 'mocap_wxyz', MOCAP)
    np.testing.assert_array_equal(after[:, 3], before[:, 6])
    np.testing.assert_array_equal(after[:, 6], before[:, 5])
    before, after = values(flights, 'imu_turned_z', IMU)
    np.testing.assert_allclose(after[:, [0, 1, 2]], before[:, [1, 0, 2]] * [-1, 1, 1], atol=1e-12)
    before, after = values(flights, 'joints_swapped', JOINTS)
    np.testing.assert_array_equal(after, before[:, [1, 0, 2, 3, 5, 4, 6, 7]])
    before, after = values(flights, 'thrusts_reversed', COMMAND)
    np.testing.assert_array_equal(after[:, 4:], before[:, :3:-1])


def test_a_mirrored_frame_turns_the_other_way_about_two_axes(flights):
    before, after = values(flights, 'mocap_left_handed', MOCAP)
    mirror = np.diag([1.0, -1.0, 1.0])
    found = Rotation.from_quat(after[:, 3:]).as_matrix()
    np.testing.assert_allclose(
        found, mirror @ Rotation.from_quat(before[:, 3:]).as_matrix() @ mirror, atol=1e-9)


def test_y_up_axes_change_the_vertical(flights):
    for name in ('mocap_y_up', 'mocap_y_up_body'):
        before, after = values(flights, name, MOCAP)
        np.testing.assert_allclose(after[:, 1], before[:, 2], atol=1e-12)
        np.testing.assert_allclose(np.linalg.norm(after[:, 3:], axis=1), 1, atol=1e-9)


def test_a_control_turns_the_world_but_not_gravity_in_the_body(flights):
    before, after = values(flights, 'mocap_world_turned', MOCAP)
    down = [Rotation.from_quat(v[:, 3:]).inv().apply([0, 0, 1]) for v in (before, after)]
    np.testing.assert_allclose(*down, atol=1e-9)


def test_without_gravity_the_accelerations_are_small(flights):
    after = values(flights, 'accelerometer_without_gravity', IMU)[1]
    assert np.abs(after[:-2, :3]).max() < 0.2


def test_repeated_values(flights):
    after = values(flights, 'imu_stale', IMU)[1]
    np.testing.assert_array_equal(after[1::2], after[::2])
    assert np.abs(values(flights, 'gyroscope_saturated', IMU)[1][:, 3:]).max() == 1
    frozen, onset = KINDS['mocap_frozen'].apply(*flights)
    t, pose = frozen.stamps(MOCAP), frozen.values(MOCAP)
    held = (t >= onset) & (t < onset + DURATION / 7 - 0.02)
    assert len(np.unique(pose[held], axis=0)) == 1
    assert len(np.unique(pose, axis=0)) == len(pose) - np.sum(
        (pose == pose[held][0]).all(axis=1)) + 1


@pytest.mark.parametrize(('name', 'topic', 'step'), [
    ('mocap_clock_back', MOCAP, -0.3), ('encoder_clock_late', JOINTS, 0.15),
    ('imu_clock_forward', IMU, 1.5), ('command_clock_forward', COMMAND, 0.8)])
def test_a_clock_steps_and_times_of_recording_stay(flights, name, topic, step):
    after, onset = KINDS[name].apply(*flights)
    t, stamps = flights[0].stamps(topic), after.stamps(topic)
    np.testing.assert_allclose(stamps - t, np.where(t >= onset, step, 0), atol=1e-6)
    assert [m.received for m in after.on(topic)] == [m.received for m in flights[0].on(topic)]


def test_stamps_in_other_units_and_epochs(flights):
    assert not damaged(flights, 'imu_stamps_zero').stamps(IMU).any()
    late = damaged(flights, 'received_hour_late')
    np.testing.assert_array_equal(late.stamps(MOCAP), flights[0].stamps(MOCAP))
    assert late.messages[0].received == flights[0].messages[0].received + 3600
    old = damaged(flights, 'joint_stamps_1970')
    assert old.stamps(JOINTS).max() < 10 and old.stamps(IMU).min() > 1.7e9
    drift = np.diff(damaged(flights, 'mocap_drift').stamps(MOCAP))
    np.testing.assert_allclose(drift, 0.0101, atol=1e-6)


def test_damage_of_whole_bags(flights, tmp_path):
    before = flights[0].counts()
    assert all(n == 2 * before[t] for t, n in damaged(flights, 'duplicates').counts().items())
    merged = damaged(flights, 'two_flights')
    assert len(merged.on(IMU)) == 2 * before['/imu/data_raw']
    assert np.all(np.diff(merged.stamps(IMU)) >= 0)
    mixed = damaged(flights, 'out_of_order')
    assert np.any(np.diff(mixed.stamps(IMU)) < 0)
    assert sorted(m.data for m in mixed.on(IMU)) == sorted(m.data for m in flights[0].on(IMU))
    with pytest.raises(BagError, match='cut off after 0 readable messages'):    # of one chunk
        Recording.read(damaged(flights, 'cut_off').write(tmp_path / 'cut'))
    assert not (tmp_path / 'cut' / 'metadata.yaml').exists()


def test_estimates_and_truth_are_withheld(flights):
    assert not {m.name for m in flights[0].messages} & {'odom', 'ground_truth/odom'}
