"""Response logs of CSV files and bags; unusable ones are refused with place and reason."""

import numpy as np
import pytest
from servo_logs import COUNT, sweep
from synthetic_flights import write_command, write_joints

from beetle_omni_ros.bags.bag_writer import BagWriter
from beetle_omni_ros.identify.servo.log import fresh_rows, JointLog, read_joint_log
from beetle_omni_ros.model.files import LogError

HEADER = ['t_s', 'q1_rad', 'q2_rad', 'command_rad']


@pytest.fixture(scope='module')
def good():
    """(N, 4) time, two joints, command."""
    t, command = sweep(duration=3.0)
    return np.stack([t, 0.95 * command, 0.9 * command, command], axis=1)


def saved(path, rows, header=HEADER):
    text = [','.join(header)] + [','.join(f'{value:g}' if isinstance(value, float) else str(value)
                                          for value in row) for row in rows]
    path.write_text('\n'.join(text) + '\n')
    return path


def put(row, column, value):
    """A change of one cell, or of the cells of a slice."""
    def change(rows):
        rows = rows.astype(object)
        rows[row, column] = value
        return rows
    return change


def scaled(column, factor):
    return lambda rows: rows * np.where(np.arange(4) == column, factor, 1.0)


CASES = {
    'no time': (lambda r: r[:, 1:], HEADER[1:], "column 't_s' is missing"),
    'no joint': (lambda r: r[:, [0, 3]], ['t_s', 'command_rad'], "column 'q1_rad' is missing"),
    'degrees in the header': (lambda r: r[:, [0, 1, 3]], ['t_s', 'q1_deg', 'command_rad'],
                              "'q1_deg' has another unit"),
    'a command too few': (lambda r: r, ['t_s', 'q1_rad', 'q2_rad', 'command1_rad'],
                          "column 'command2_rad' is missing"),
    'numbers for a header': (lambda r: r, ['0', '1', '2', '3'], 'the header is missing'),
    'no number': (put(5, 1, 'x'), HEADER, "row 7, column q1_rad: expected a finite number, "
                                          "found 'x'"),
    'time goes back': (put(20, 0, 0.05), HEADER, 'row 22, column t_s'),
    'milliseconds': (scaled(0, 1000), HEADER, 'is the time in seconds?'),
    'few rows': (lambda r: r[:40], HEADER, '40 rows are too few'),
    'too short': (scaled(0, 0.2), HEADER, 'too short'),
    'a gap': (lambda r: np.delete(r, slice(50, 90), axis=0), HEADER, 'without a sample'),
    'degrees': (lambda r: scaled(1, 57.3)(scaled(3, 57.3)(r)), HEADER, 'degrees or encoder'),
    'one in other units': (scaled(1, 0.0175), HEADER, 'times as far as its command'),
    'constant command': (put(slice(None), 3, 0.1), HEADER, 'the command moves by 0.0000 rad'),
    'dead servo': (put(slice(None), 2, 0.1), HEADER, 'q2_rad moves by'),
    'wrong sign': (scaled(1, -1.0), HEADER, 'against its command'),
    'ragged': (lambda r: [*r[:30], r[30][:3]], HEADER, 'expected 4 values, found 3'),
    'column twice': (lambda r: r, ['t_s', 'q1_rad', 'q1_rad', 'command_rad'], 'occurs twice')}


@pytest.mark.parametrize('case', CASES)
def test_unusable_logs_are_refused(good, tmp_path, case):
    change, header, words = CASES[case]
    path = saved(tmp_path / 'bad.csv', change(good), header)
    with pytest.raises(LogError) as caught:
        read_joint_log(path)
    text = str(caught.value)
    assert words in text and str(path) in text and '\n' not in text


def test_columns_have_any_order_and_every_joint_may_have_its_own_command(good, tmp_path):
    header = ['command3_rad', 't_s', 'q1_rad', 'q3_rad', 'command1_rad', 'temperature_C']
    rows = np.concatenate([-0.5 * good[:, 3:], good, good[:, :1]], axis=1)
    rows[:, 3] *= -0.5
    log = read_joint_log(saved(tmp_path / 'log.csv', rows, header))
    assert log.joints == (1, 3)
    assert np.allclose(log.command[1], -0.5 * log.command[0], atol=1e-5)


ROW, EVERY = 0.005, 4       # rows at 200 Hz, readings at 50 Hz


def encoder(t):
    """Readings (2, N) of joints that step, and come to rest, every 1.25 s."""
    since = t % 1.25
    moving = np.where((t // 1.25) % 2, 1, -1) * (2 * np.exp(-since / 0.08) - 1)
    return np.round(np.array([moving, 0.8 * moving]) / COUNT) * COUNT


def rows(late):
    """(rows in which readings appear, rows that repeat them (2, N), times of the readings)."""
    count, rng = 1600, np.random.default_rng(0)
    taken = np.arange(0, count, EVERY)
    at = taken + (rng.random(len(taken)) < late)
    last = np.searchsorted(at[1:], np.arange(count), side='right')
    return at, encoder(ROW * taken)[:, last], ROW * taken


@pytest.mark.parametrize(('late', 'least'), [(0.0, 0.99), (0.15, 0.97)])
def test_only_rows_with_a_new_reading_are_used_also_while_the_joints_rest(late, least):
    at, measured, _ = rows(late)
    fresh = np.flatnonzero(fresh_rows(measured))
    # a late row of joints at rest cannot be seen
    assert np.abs(fresh[:, None] - at).min(axis=1).max() <= (late > 0)
    assert len(fresh) == pytest.approx(len(at), abs=5)
    moving = np.r_[True, (np.diff(encoder(ROW * at)) != 0).any(axis=0)]
    assert np.isin(at[moving], fresh).mean() > least


def test_a_log_has_the_readings_of_the_bus_at_their_times():
    at, measured, taken = rows(0.15)
    t = ROW * np.arange(measured.shape[1])
    log = JointLog('made.csv', t, (1, 2), measured, measured)
    assert np.isnan(log.read_t[~log.fresh]).all()
    near = np.abs(log.read_t[log.fresh][:, None] - taken).min(axis=1)
    # a rest that begins late is late, which has no effect
    assert np.mean(near < 0.1 * ROW) > 0.95 > np.mean(np.abs(t[at] - taken) < 0.1 * ROW)


def test_each_reading_of_a_bag_is_paired_with_the_last_command_before_it(tmp_path):
    t, command = sweep(duration=3.0)
    sent = np.outer(command, [1, -1, 0.5, 1])
    for name in ('complete', 'without_joints'):
        with BagWriter(tmp_path / name) as bag:
            for now, wanted in zip(t + 5.0, sent, strict=True):
                write_command(bag, now - 0.003, wanted, np.full(4, 7.0), received=now - 0.001)
                if name == 'complete':
                    write_joints(bag, now, 0.9 * wanted, np.zeros(4))
    log = read_joint_log(tmp_path / 'complete')
    assert log.joints == (1, 2, 3, 4)
    assert np.allclose(log.t, t, atol=1e-6)
    assert np.allclose(log.command, sent.T, atol=1e-9)
    assert np.allclose(log.measured, 0.9 * sent.T, atol=1e-9)
    with pytest.raises(LogError, match='no joint_states in this bag'):
        read_joint_log(tmp_path / 'without_joints')
