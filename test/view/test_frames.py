"""Rows of a run: newest values, interpolation, windows, plots."""

import numpy as np
import pytest
from synthetic_flights import fly, write_battery, write_odom, write_state, write_truth

from beetle_omni_ros.robot import rotations
from beetle_omni_ros.runs.bag import BagError, BagWriter, read_bag
from beetle_omni_ros.runs.tasks import make_task
from beetle_omni_ros.view import plots
from beetle_omni_ros.view.frames import COLUMNS, known, pose, Rows, Sampler, state_at, T, WIDTH
from beetle_omni_ros.view.recording import parts, Recording, STEP

UP = np.array([0.0, 0, 0, 1])


@pytest.fixture(scope='module')
def bag(tmp_path_factory):
    folder = tmp_path_factory.mktemp('view') / 'flight'
    with BagWriter(folder, {'task': 'waypoints'}) as writer:
        fly(writer, make_task('waypoints'), duration=12.0, start=50.0)
    return folder


def rows_of(path):
    rows = Rows()
    for part in parts(path):
        rows.append(part.rows)
    return rows


def test_rows_agree_with_the_content_of_the_bag(bag):
    log, rows = read_bag(bag), rows_of(bag)
    np.testing.assert_allclose(np.diff(rows.times), STEP)
    assert rows.times[-1] == pytest.approx(log.end, abs=0.1)
    for t in (53.0, 57.5, 61.0):
        row = rows.at(t)
        k = np.searchsorted(log.truth_t, t)
        speed = np.abs(np.diff(log.truth_position, axis=0)).max() / np.diff(log.truth_t).min()
        np.testing.assert_allclose(row[COLUMNS['position']], log.truth_position[k],
                                   atol=3 * STEP * speed + 1e-6)
        newest = [target for target in log.targets if target.stamp <= t][-1].at(t)
        np.testing.assert_allclose(known(row, 'target_position'), newest.position)
        k = np.searchsorted(log.command_t, t)
        np.testing.assert_allclose(row[COLUMNS['thrust']], log.command_thrust[k], atol=1.0)


def test_a_recording_is_read_during_its_display(bag):
    recording = Recording(bag, 'mine')
    try:
        recording.wait(60.0, whole=True)
    finally:
        recording.close()
    np.testing.assert_array_equal(recording.rows.table, rows_of(bag).table)
    assert recording.done and recording.meta['task'] == 'waypoints'
    assert recording.name == 'mine' and not recording.warnings


def test_an_unusable_bag_is_refused_in_one_line(tmp_path):
    with pytest.raises(BagError, match='no such bag'):
        Recording(tmp_path / 'none')
    (tmp_path / 'text.mcap').write_text('no bag at all')
    recording = Recording(tmp_path / 'text.mcap')
    with pytest.raises(BagError, match='not an MCAP file'):
        recording.wait(60.0)
    with BagWriter(tmp_path / 'empty') as writer:
        write_battery(writer, 1.0, 24.0, -3.0)
    with pytest.raises(BagError, match='no pose of the robot'):
        list(parts(tmp_path / 'empty'))


def test_the_estimate_replaces_an_unknown_truth():
    sampler = Sampler()
    assert not sampler.placed and sampler.row(1.0)[T] == 1.0
    write_odom(sampler, 1.0, [1, 2, 3], UP, None, None)
    assert sampler.placed and pose(sampler.row(1.0), 'estimate_') is None
    write_truth(sampler, 1.0, [1, 2, 4], UP, None, None)
    write_odom(sampler, 2.0, [1, 2, 5], UP, None, None)
    row = sampler.row(2.0)
    assert row[COLUMNS['position']][2] == 4 and row[COLUMNS['estimate_position']][2] == 5
    assert sampler.clock == 2.0


def test_faults_and_input_warnings_are_kept_with_their_time():
    sampler = Sampler()
    write_state(sampler, 1.0, 'flying:nmpc')
    sampler.write_diagnostic(2.0, 'supervisor_node: supervisor', {'fault.rotor_1': '1.8'})
    sampler.write_diagnostic(3.0, 'supervisor_node: supervisor', {'fault.rotor_1': '1.8'})
    write_state(sampler, 4.0, 'landing:mocap_lost')
    assert sampler.faults == {'rotor_1': 2.0, 'mocap_lost': 4.0}
    assert [state_at(sampler.states, t) for t in (0.5, 1.0, 3.9, 5.0)] == \
        ['', 'flying:nmpc', 'flying:nmpc', 'landing:mocap_lost']
    sampler.write_diagnostic(5.0, 'nmpc_node: inputs', {}, 1, 'target_pose: 1 rejected, low')
    sampler.write_diagnostic(5.0, 'nmpc_node: inputs', {}, 0, 'all arriving')
    assert sampler.input_warnings == [('nmpc_node: inputs', 'target_pose: 1 rejected, low')]


def row(t, x=0.0, quaternion=UP, target=0.0):
    made = np.full(WIDTH, np.nan)
    made[T] = t
    made[COLUMNS['position']] = [x, 0, 0]
    made[COLUMNS['quaternion']] = quaternion
    made[COLUMNS['target_position']] = [target, 0, 0]
    return made


def test_between_rows_poses_are_interpolated_and_targets_hold():
    rows = Rows()
    turned = -rotations.from_rpy(0, 0, 1.0)     # the other sign of the same rotation
    rows.append(np.array([row(0.0), row(1.0, 2.0, turned, 7.0)]))
    middle = rows.at(0.5)
    assert middle[COLUMNS['position']][0] == pytest.approx(1.0)
    assert middle[COLUMNS['target_position']][0] == 0.0 and middle[T] == 0.5
    angle = rotations.geodesic_angle(middle[COLUMNS['quaternion']],
                                     rotations.from_rpy(0, 0, 0.5))
    assert angle < 1e-6 and known(middle, 'tilt') is None
    assert rows.at(-3.0)[T] == 0.0 and rows.at(9.0)[COLUMNS['position']][0] == 2.0


def test_rows_stay_in_order_and_old_ones_are_dropped():
    rows = Rows(longest=10.0)
    for t in range(3000):
        rows.append(row(0.1 * t)[None])
    rows.append(row(5.0)[None])
    assert rows.times[0] == pytest.approx(289.9) and len(rows) == 101
    assert np.all(np.diff(rows.times) > 0)
    kept = Rows()
    kept.append(np.array([row(t) for t in (0.0, 1.0, 0.5, 2.0, 2.0, 3.0)]))
    np.testing.assert_array_equal(kept.times, [0, 1, 2, 3])
    assert len(kept.window(0.5, 2.5)) == 2


def test_a_plot_has_a_line_at_the_present_and_no_gaps():
    first = np.array([row(t, x=t) for t in np.arange(0.0, 4.0, 0.1)])
    second = np.array([row(t, x=2 * t) for t in np.arange(1.05, 3.0, 0.1)])
    error = plots.PLOTS[0]
    times, a, b, mark = plots.window(error, [first, second], 2.0)
    assert len(times) == len(a) == len(b) == len(mark) and np.all(np.diff(times) >= 0)
    np.testing.assert_allclose(times[np.isfinite(mark)], 2.0)
    np.testing.assert_allclose(mark[np.isfinite(mark)], [0, 1])
    np.testing.assert_allclose(a, times, atol=1e-9)
    inside = (times >= 1.05) & (times <= 2.9)
    np.testing.assert_allclose(b[inside], 2 * times[inside], atol=1e-9)
    assert np.isfinite(b).all()
    assert plots.window(plots.PLOTS[-1], [first], 2.0) is None      # no battery
