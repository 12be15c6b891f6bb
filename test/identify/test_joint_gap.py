"""Response logs and a robot file: changes are named, a corrected file has no gap, predictions."""

from dataclasses import replace
import json
from pathlib import Path

import numpy as np
import pytest
from servo_logs import log_of, servo, sweep, write

from beetle_omni_ros import cli
from beetle_omni_ros.identify.flights.apply import effects_with
from beetle_omni_ros.identify.servo.compare import compare, gap_of
from beetle_omni_ros.identify.servo.log import JointLog, read_joint_log
from beetle_omni_ros.identify.servo.model import file_sets, own_delay, simulate
from beetle_omni_ros.identify.servo.results import fitted_line, identify, joint_results, line_at
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.model.servo import play

REAL = sorted((Path(__file__).resolve().parents[3] / 'shared' / 'data').glob('joint_*.csv'))
SHIPPED = RobotParameters.load()
INERTIA = SHIPPED.joints.inertia
BANDS = (0.013, 0.035)      # [rad]
FREQUENCY, DAMPING = 47.0, 0.63
DELAY = own_delay() + 0.004     # of which a file states the rest
T, COMMAND = sweep(5.0, periods=(0.5, 0.9), amplitudes=(0.3, 0.6))


def robot(**effects):
    """Robot file with the servos of ``made`` and further effects."""
    kp = INERTIA * FREQUENCY**2
    torque = tuple(kp * band for band in (*BANDS, 0.0, 0.0))
    own = {'joint_bandwidth': {'kp': kp, 'kd': 2 * DAMPING * FREQUENCY * INERTIA},
           'joint_friction': {'coulomb': torque, 'stiction': torque},
           'joint_command_latency': {'delay': DELAY - own_delay()}}
    return replace(SHIPPED, effects={**own, **effects})


def made(seed, *changed, **both):
    """Log of two joints by an independent simulation; ``changed``: of each, ``both``: of both."""
    changed = changed or ({}, {})
    return log_of(T, COMMAND, [{'frequency': FREQUENCY, 'damping': DAMPING, 'delay': DELAY,
                                'coulomb': band, **both, **own}
                               for band, own in zip(BANDS, changed, strict=True)], seed)


def judged(log, file_robot=None, apart=None):
    """Gap to a robot file; ``apart`` is the log's own identification, the noise floor."""
    file_robot = file_robot or robot()
    apart = apart or identify([log], file_robot)
    return gap_of(compare(log, file_robot), apart, file_robot)


def corrected(file_robot, result):
    effects = effects_with(file_robot, result['effects'])
    return replace(file_robot, effects={
        name: {key: tuple(v) if isinstance(v, list) else v for key, v in values.items()}
        for name, values in effects.items()})


def names(result):
    return [(effect['names'], effect.get('joint')) for effect in result['effects']]


def test_servos_of_the_robot_file_agree_with_a_plain_simulation():
    file_robot = robot(joint_offset={'offset': (0.02, -0.01, 0.0, 0.0)},
                       joint_backlash={'gap': 0.024}, joint_feedback_delay={'delay': 0.006},
                       joint_encoder_error={'gain': (0.03, 0.0, 0.0, 0.0), 'sine': (0.0,) * 4,
                                            'cosine': (0.0,) * 4})
    shown = np.array([servo(T, COMMAND, frequency=FREQUENCY, damping=DAMPING,
                            delay=DELAY + 0.006, coulomb=band, backlash=0.012, offset=-zero,
                            gain=gain)
                      for band, zero, gain in zip(BANDS, (0.02, -0.01), (0.03, 0), strict=True)])
    log = JointLog('made.csv', T, (1, 2), shown, np.tile(COMMAND, (2, 1)))
    error = simulate(log, np.arange(2), file_sets(file_robot)[:2]) - shown
    assert np.sqrt(np.mean(error[:, 25:]**2)) < 5e-4 and np.abs(error[:, 25:]).max() < 2e-3


def test_servos_of_the_robot_file_have_no_gap():
    assert judged(made(3))['verdict'] == 'no_gap'
    named = [compare(made(seed), robot()).chosen.entries for seed in (100, 101)]
    assert sum(map(len, named)) <= 1, named


def test_zeros_that_moved_are_named_with_joint_and_sign():
    zeros = -0.012, 0.018
    # the reading exceeds the command by the offset, so that the true tilt is less than the reading
    result = judged(made(4, *({'offset': -zero} for zero in zeros)))
    assert sorted(names(result)) == [(['joint_offset'], joint) for joint in (1, 2)]
    for effect in result['effects']:
        entry = effect['parameters']['offset']
        low, high = entry['interval']
        assert entry['value'] == pytest.approx(zeros[effect['joint'] - 1], abs=0.002)
        assert low < entry['value'] < high and high - low < 0.004


def line_zero(log, joint):
    """Offset of position = gain command(t - delay) + offset, at the best delay."""
    late = [np.interp(log.t - delay, log.t, log.command[joint])[20:]
            for delay in np.arange(0.02, 0.1, 0.001)]
    fits = [np.polyfit(c, log.measured[joint, 20:], 1, full=True)[:2] for c in late]
    return min(fits, key=lambda fit: fit[1][0])[0][1]


def test_a_zero_beside_an_encoder_error_is_that_of_a_line_fit():
    log = made(6, {'offset': -0.012, 'cosine': 0.1}, {})
    apart = identify([log], robot())
    result = judged(log, robot(), apart)
    assert {(n, effect['joint']) for effect in result['effects'] for n in effect['names']} == {
        ('joint_offset', 1), ('joint_encoder_error', 1)}
    zero, = (effect['parameters']['offset'] for effect in result['effects']
             if effect['names'] == ['joint_offset'])
    low, high = zero['interval']
    assert low < -line_zero(log, 0) < high and high - low < 0.004
    assert zero['written'] == pytest.approx(0.012, abs=0.002) and zero['written'] < low
    assert judged(log, corrected(robot(), result), apart)['verdict'] == 'no_gap'


@pytest.mark.parametrize(('changed', 'both', 'name'), [
    ((), {'delay': DELAY + 0.012}, 'joint_command_latency'),
    ((), {'frequency': 0.84 * FREQUENCY, 'damping': 0.84 * DAMPING}, 'joint_bandwidth'),
    (({'coulomb': 0.030}, {}), {}, 'joint_friction'),
    (({}, {'backlash': 0.015}), {}, 'joint_backlash'),
    (({'gain': 0.03}, {}), {}, 'joint_encoder_error')])
def test_a_change_is_named_alone(changed, both, name):
    result = judged(made(5, *changed, **both))
    (found, joint), = names(result)
    assert name in found and joint in (None, 1)
    assert result['verdict'] == ('named' if len(found) == 1 else 'named_set')
    assert result['gap_after'] < 1.15 < result['gap_before']


def test_what_changed_between_two_logs_is_named_against_the_file_of_the_first():
    before, after = made(7), made(8, {'offset': 0.018}, {}, coulomb=0.024)
    file = corrected(SHIPPED, judged(before, SHIPPED))
    result = judged(after, file)
    named = {name for effect in result['effects'] for name in effect['names']}
    assert {'joint_offset', 'joint_friction'} <= named
    zero, = (e for e in result['effects'] if e['names'] == ['joint_offset'] and e['joint'] == 1)
    low, high = zero['parameters']['offset']['interval']
    assert low < -0.018 < high and high - low < 0.004


def test_the_command_line_writes_a_file_that_explains_the_log(tmp_path):
    # Other entries take up the gain of the second encoder to less than a count.
    log = write(tmp_path / 'log.csv', made(21, {'gain': 0.03, 'offset': -0.01}, {'gain': -0.006}))
    new, first, second = (tmp_path / name for name in ('new.yaml', 'a.json', 'b.json'))
    assert cli.main([str(a) for a in ('gap', log, '--apply', new, '--json', first)]) == 0
    result = json.loads(first.read_text())
    assert result['verdict'] in ('named', 'named_set') and result['gap_before'] > 10
    for effect in result['effects']:
        assert effect['evidence']['ln_bayes_factor'] > 0 and effect['evidence']['cv_gain'] > 0
    assert [j['joint'] for j in result['joints']] == [1, 2]
    assert len(RobotParameters.load(new).effects['joint_friction']['coulomb']) == 4
    assert cli.main([str(a) for a in ('gap', log, '--robot', new, '--json', second)]) == 0
    again = json.loads(second.read_text())
    assert again['verdict'] == 'no_gap' and again['effects'] == [] and again['gap_before'] < 1.2
    for old, new in zip(result['joints'], again['joints'], strict=True):
        assert new['published_heldout_rms_rad'] < 1.3 * old['heldout_rms_rad']


@pytest.fixture(scope='module', params=REAL, ids=lambda path: path.stem)
def real(request):
    """Measured log and its own identification."""
    log = read_joint_log(request.param)
    return log, identify([log], SHIPPED)


def test_a_real_log_has_no_gap_to_its_own_correction(real):
    log, apart = real
    result = judged(log, SHIPPED, apart)
    assert {'joint_bandwidth', 'joint_friction'} <= {n for e in result['effects']
                                                     for n in e['names']}
    again = judged(log, corrected(SHIPPED, result), apart)
    assert again['verdict'] == 'no_gap', names(again)


def line_errors(log, joint, halves):
    """Held-out RMS [rad] of gain * play(command(t - delay)) + offset, of the best fit."""
    rows = np.flatnonzero(log.fresh & (log.t >= log.t[0] + 0.3))
    fitted = rows < log.end
    read, t = log.measured[joint, rows], log.read_t[rows]

    def one(delay, half):
        x = log.command_at(joint, t - delay)
        a = np.stack([play(x, half), np.ones_like(x)], axis=1)
        solution = np.linalg.lstsq(a[fitted], read[fitted], rcond=None)[0]
        error = a @ solution - read
        return np.mean(error[fitted]**2), np.sqrt(np.mean(error[~fitted]**2))

    best = min((one(delay, half) + (delay, half) for delay in np.arange(0.0, 0.0901, 0.004)
                for half in halves[::4]))
    return min(one(best[2] + d, h) for d in np.arange(-0.004, 0.0041, 0.0005)
               for h in halves[np.abs(halves - best[3]) < 0.0041])[1]


def test_real_servos_are_predicted_as_well_as_by_a_line_with_play(real):
    log, apart = real
    joints = joint_results(apart, [], SHIPPED)['joints']
    lines = [min(line_errors(log, k, np.zeros(1)), line_errors(log, k, 1e-3 * np.arange(41)))
             for k in range(len(joints))]
    errors = np.array([joint['heldout_rms_rad'] for joint in joints])
    # Over the joints: two seconds determine the error of one to a quarter.
    assert np.sqrt(np.mean(errors**2)) < 1.1 * np.sqrt(np.mean(np.square(lines)))
    assert (errors < [0.5 * joint['published_heldout_rms_rad'] for joint in joints]).all()


def test_real_servos_of_one_log_predict_the_others_better_than_a_line(real):
    log, apart = real
    others = [read_joint_log(path) for path in REAL if path.name != log.name]
    servo = [joint['validation_rms_rad']
             for joint in joint_results(apart, others, SHIPPED)['joints']]
    fitted = [fitted_line(log, k, apart.servos.rows[0]) for k in range(len(servo))]
    lines = [[np.nanmean((line_at(line, other, k) - other.measured[k])**2) for other in others]
             for k, line in enumerate(fitted)]
    assert (np.mean(np.square(servo), axis=0) < np.mean(lines, axis=0)).all()
