"""Unusable response logs are refused in one line with place and reason."""

import numpy as np
import pytest
from servo_logs import COUNT, log_of, sweep, write

from beetle_omni_ros.identify.servo.log import fresh_rows, JointLog, read_joint_log
from beetle_omni_ros.runs.files import LogError

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


def swapped(rows, row, column, value):
    changed = rows.astype(object)
    changed[row, column] = value
    return changed


def scaled(rows, column, factor):
    changed = rows.copy()
    changed[:, column] *= factor
    return changed


def constant(rows, column):
    changed = rows.copy()
    changed[:, column] = 0.1
    return changed


CASES = {
    'no time': (lambda r: r[:, 1:], HEADER[1:], "column 't_s' is missing"),
    'other unit of time': (lambda r: r, ['t_ms', *HEADER[1:]], "'t_ms' has another unit"),
    'no command': (lambda r: r[:, :3], HEADER[:3], "column 'command_rad' is missing"),
    'no joint': (lambda r: r[:, [0, 3]], ['t_s', 'command_rad'], "column 'q1_rad' is missing"),
    'degrees in the header': (lambda r: r[:, [0, 1, 3]], ['t_s', 'q1_deg', 'command_rad'],
                              "'q1_deg' has another unit"),
    'a command too few': (lambda r: r, ['t_s', 'q1_rad', 'q2_rad', 'command1_rad'],
                          "column 'command2_rad' is missing"),
    'no header': (lambda r: r[:, :0], [], 'empty'),
    'numbers for a header': (lambda r: r, ['0', '1', '2', '3'], 'the header is missing'),
    'no number': (lambda r: swapped(r, 5, 1, 'x'), HEADER, "row 7, column q1_rad: expected a "
                                                           "finite number, found 'x'"),
    'NaN': (lambda r: swapped(r, 9, 3, 'nan'), HEADER, 'row 11, column command_rad'),
    'time goes back': (lambda r: swapped(r, 20, 0, 0.05), HEADER, 'row 22, column t_s'),
    'time stands': (lambda r: swapped(r, 20, 0, float(r[19, 0])), HEADER, 'row 22, column t_s'),
    'milliseconds': (lambda r: scaled(r, 0, 1000), HEADER, 'is the time in seconds?'),
    'few rows': (lambda r: r[:40], HEADER, '40 rows are too few'),
    'too short': (lambda r: scaled(r, 0, 0.2), HEADER, 'too short'),
    'a gap': (lambda r: np.delete(r, slice(50, 90), axis=0), HEADER, 'without a sample'),
    'degrees': (lambda r: scaled(scaled(r, 1, 57.3), 3, 57.3), HEADER, 'degrees or encoder'),
    'one in other units': (lambda r: scaled(r, 1, 0.0175), HEADER, 'times as far as its command'),
    'constant command': (lambda r: constant(r, 3), HEADER, 'the command moves by 0.0000 rad'),
    'dead servo': (lambda r: constant(r, 2), HEADER, 'q2_rad moves by'),
    'wrong sign': (lambda r: scaled(r, 1, -1.0), HEADER, 'against its command'),
    'ragged': (lambda r: [*r[:30], r[30][:3]], HEADER, 'expected 4 values, found 3'),
    'column twice': (lambda r: r, ['t_s', 'q1_rad', 'q1_rad', 'command_rad'],
                     'occurs twice'),
}


@pytest.mark.parametrize('case', CASES)
def test_unusable_logs_are_refused(good, tmp_path, case):
    change, header, words = CASES[case]
    path = saved(tmp_path / 'bad.csv', change(good), header)
    with pytest.raises(LogError) as caught:
        read_joint_log(path)
    text = str(caught.value)
    assert words in text and str(path) in text and '\n' not in text


def test_columns_may_have_any_order_and_others_are_ignored(good, tmp_path):
    rows = np.concatenate([good[:, ::-1], good[:, :1]], axis=1)
    log = read_joint_log(saved(tmp_path / 'log.csv', rows, [*HEADER[::-1], 'temperature_C']))
    assert log.joints == (1, 2)
    assert np.allclose(log.measured[1], good[:, 2], atol=1e-5)


def test_every_joint_may_have_its_own_command(good, tmp_path):
    header = ['t_s', 'q1_rad', 'q3_rad', 'command1_rad', 'command3_rad']
    rows = np.concatenate([good, -0.5 * good[:, 3:]], axis=1)
    rows[:, 2] *= -0.5
    log = read_joint_log(saved(tmp_path / 'log.csv', rows, header))
    assert log.joints == (1, 3)
    assert np.allclose(log.command[1], -0.5 * log.command[0], atol=1e-5)


def test_a_written_log_is_read_back(tmp_path):
    made = log_of(*sweep(duration=3.0), [{}])
    read = read_joint_log(write(tmp_path / 'log.csv', made))
    assert np.allclose(read.measured, made.measured, atol=1e-6)
    assert read.quantum == pytest.approx(2 * np.pi / 4096, rel=0.01)


ROW, EVERY = 0.005, 4       # rows at 200 Hz, readings at 50 Hz


def encoder(t):
    """Readings (2, N) of joints that step, and come to rest, every 1.25 s."""
    since = t % 1.25
    moving = np.where((t // 1.25) % 2, 1, -1) * (2 * np.exp(-since / 0.08) - 1)
    return np.round(np.array([moving, 0.8 * moving]) / COUNT) * COUNT


def rows(count=1600, late=0.0, lost=(), seed=0):
    """(rows in which readings appear, rows that repeat them (2, N), times of the readings)."""
    rng = np.random.default_rng(seed)
    taken = np.arange(0, count, EVERY)
    at = taken + (rng.random(len(taken)) < late)
    kept = ~np.isin(np.arange(len(taken)), lost)
    last = np.searchsorted(at[kept][1:], np.arange(count), side='right')
    return at[kept], encoder(ROW * taken[kept])[:, last], ROW * taken[kept]


@pytest.mark.parametrize(('late', 'least'), [(0.0, 0.99), (0.15, 0.97)])
def test_only_rows_with_a_new_reading_are_used_also_while_the_joints_rest(late, least):
    at, measured, _ = rows(late=late)
    fresh = np.flatnonzero(fresh_rows(measured))
    # a late row of joints at rest cannot be seen
    assert np.abs(fresh[:, None] - at).min(axis=1).max() <= (late > 0)
    assert len(fresh) == pytest.approx(len(at), abs=5)
    moving = np.r_[True, (np.diff(encoder(ROW * at)) != 0).any(axis=0)]
    assert np.isin(at[moving], fresh).mean() > least


def test_a_log_has_the_readings_of_the_bus_at_their_times():
    at, measured, taken = rows(late=0.15)
    t = ROW * np.arange(measured.shape[1])
    log = JointLog('made.csv', t, (1, 2), measured, measured)
    assert np.isnan(log.read_t[~log.fresh]).all()
    near = np.abs(log.read_t[log.fresh][:, None] - taken).min(axis=1)
    # a rest that begins late is late, which has no effect
    assert np.mean(near < 0.1 * ROW) > 0.95 > np.mean(np.abs(t[at] - taken) < 0.1 * ROW)
