"""Damaged recordings are refused with topic, cause and time."""

from copy import deepcopy
from dataclasses import fields
from functools import cache
import re
import warnings

from flown_once import flight
import numpy as np
import pytest
from scipy.signal import step as step_response
from scipy.spatial.transform import Rotation, Slerp
import yaml

from beetle_omni_ros.identify.recording.bag import (
    changed,
    COMMAND,
    IMU,
    JOINTS,
    POSE,
    read_recording,
)
from beetle_omni_ros.identify.recording.check import checked
from beetle_omni_ros.identify.recording.flight import prepare, UnusableFlight
from beetle_omni_ros.identify.recording.parameters import GapParameters, RecordingLimits
from beetle_omni_ros.identify.recording.topics import judge, sensor_damages
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.model.resources import share_path

ROBOT = RobotParameters.load()


@cache
def flown():
    return read_recording(flight('published'))


def recording():
    """24 s over three poses, with noise as in the publication and stamps of a real clock."""
    made = deepcopy(flown())
    for topic in made.times:
        made.times[topic] = made.times[topic] + 1.78e9
        made.received[topic] = made.received[topic] + 1.78e9
    return made


def late_half(made, topic):
    """Mask (N,) of the second half of a topic."""
    received = made.received[topic]
    return received > 0.5 * (received[0] + received[-1])


def columns(made, topic, first, last, change):
    """Change some columns of a topic's values."""
    made.values[topic][:, first:last] = change(made.values[topic][:, first:last].copy())
    return made


def turned_pose(made, world=None, body=None):
    """Orientations with a rotation of the world before them and one of the body behind."""
    q = Rotation.from_quat(made.values['mocap/pose'][:, 3:])
    q = (Rotation.identity() if world is None else world) * q
    q = q * (Rotation.identity() if body is None else body)
    made.values['mocap/pose'] = np.column_stack([made.values['mocap/pose'][:, :3], q.as_quat()])
    return made


P = GapParameters.load()
HALF = 12.2


def shifted(topic, by):
    """Stamps of the second half are moved."""
    def change(made):
        made.times[topic] = made.times[topic] + by * late_half(made, topic)
        return made
    return change


def of(topic, first, last, change):
    """Some columns of a topic are changed."""
    return lambda made: columns(made, topic, first, last, change)


def frozen(topic, begin, end, columns_=slice(None)):
    def change(made):
        t = made.times[topic] - made.times[topic][0]
        inside = (t > begin) & (t < end)
        made.values[topic][inside, columns_] = made.values[topic][np.argmax(inside), columns_]
        return made
    return change


def spiked(topic, rows, column, value):
    def change(made):
        made.values[topic][rows, column] = value
        return made
    return change


def noisy(topic, count, deviation):
    return of(topic, 0, count,
              lambda v: v + np.random.default_rng(0).normal(0, deviation, v.shape))


def twice(topic):
    return lambda made: changed(made, topic, keep=np.repeat(np.arange(len(made.times[topic])), 2))


def turned(topic, columns_, rotation, late=False):
    """Vectors in some columns are turned, or only those of the second half."""
    def change(made):
        rows = late_half(made, topic) if late else slice(None)
        for part in columns_:
            made.values[topic][rows, part] = rotation.apply(made.values[topic][rows, part])
        return made
    return change


def mirrored(made):
    """A left-handed world: y reversed, and the quaternion of a driver for it."""
    made = columns(made, POSE, 0, 3, lambda v: v * [1, -1, 1])
    return columns(made, POSE, 3, 7, lambda v: v * [-1, 1, -1, 1])


def y_up(made):
    turn = Rotation.from_euler('x', -90, degrees=True)
    return turned_pose(turned(POSE, [slice(0, 3)], turn)(made), world=turn)


def interleaved(made):
    other = columns(recording(), POSE, 0, 2, lambda v: -v)
    other.times[POSE] = other.times[POSE] + 2e-3
    order = np.argsort(np.concatenate([made.received[POSE], other.received[POSE] + 1e-3]))
    for a, b in ((made.times, other.times), (made.values, other.values),
                 (made.received, other.received)):
        a[POSE] = np.concatenate([a[POSE], b[POSE]])[order]
    return made


def reordered(made):
    order = np.arange(len(made.times[POSE]))
    for k in range(10, len(order) - 10, 20):
        order[k:k + 2] = order[k:k + 2][::-1]
    made.times[POSE], made.values[POSE] = made.times[POSE][order], made.values[POSE][order]
    return made


def flips(made):
    half = Rotation.from_euler('z', 180, degrees=True)
    for k in range(300, 2300, 300):
        made.values[POSE][k, 3:] = (Rotation.from_quat(made.values[POSE][k, 3:]) * half).as_quat()
    return made


def flipped_from_half(made):
    late = late_half(made, POSE)
    q = Rotation.from_quat(made.values[POSE][late, 3:]) * QUARTER
    made.values[POSE][late, 3:] = q.as_quat()
    return made


def without_gravity(made):
    t, pose = made.times[POSE], made.values[POSE]
    attitude = Slerp(t, Rotation.from_quat(pose[:, 3:]))
    at = np.clip(made.times[IMU], t[0], t[-1])
    made.values[IMU][:, :3] -= attitude(at).inv().apply([0, 0, ROBOT.gravity])
    return made


def stamped(topic, change):
    """All stamps of a topic are changed."""
    def restamped(made):
        made.times[topic] = change(made.times[topic])
        return made
    return restamped


def silent_clock(change):
    """Times of recording that follow the damaged stamps: only the motion shows the fault."""
    def unreceived(made):
        made = change(made)
        made.received = {}
        return made
    return unreceived


QUARTER = Rotation.from_euler('z', 90, degrees=True)
drifting = stamped(POSE, lambda t: t + 0.01 * (t - t[0]))
BOTH = slice(0, 3), slice(3, 6)
# name -> damage, topic, words of which the cause must contain one, time [s] or None
KINDS = {
    'quaternion w first': (of(POSE, 3, 7, lambda v: v[:, [3, 0, 1, 2]]), POSE, ['(w, x, y, z)'],
                           None),
    'quaternion inverse': (of(POSE, 3, 7, lambda v: v * [-1, -1, -1, 1]), POSE, ['inverse'], None),
    'zero quaternions': (spiked(POSE, slice(400, None, 500), slice(3, 7), 0.0), POSE,
                         ['zero quaternion'], 4.0),
    'millimetres': (of(POSE, 0, 3, lambda v: 1e3 * v), POSE, ['millimetres'], None),
    'y up': (y_up, POSE, ['points up'], None),
    'left-handed MoCap': (mirrored, POSE, ['left-handed'], None),
    'positions exchanged': (of(POSE, 0, 3, lambda v: v[:, [1, 0, 2]]), POSE,
                            ['axes of positions'], None),
    'MoCap body turned': (lambda m: turned_pose(m, body=QUARTER), POSE, ['turned'], None),
    'MoCap body turned on the way': (flipped_from_half, POSE, ['turned', 'jumps'], HALF),
    'MoCap frozen': (frozen(POSE, 10, 13.5), POSE, ['frozen'], 10.0),
    'marker flips': (flips, POSE, ['markers'], 3.0),
    'MoCap interleaved': (interleaved, POSE, ['sources', 'interleaved'], None),
    'MoCap clock back': (shifted(POSE, -0.3), POSE, ['clock'], HALF),
    'MoCap clock back, recorded so': (silent_clock(shifted(POSE, -0.3)), POSE, ['clock'], HALF),
    'MoCap clock drifts': (drifting, POSE, ['drift'], None),
    'MoCap clock drifts, recorded so': (silent_clock(drifting), POSE, ['drift'], None),
    'MoCap clock of another computer': (stamped(POSE, lambda t: t - 3600), POSE, ['behind'], None),
    'encoder clock late': (shifted(JOINTS, 0.15), JOINTS, ['clock'], HALF),
    'encoder clock late, recorded so': (silent_clock(shifted(JOINTS, 0.15)), JOINTS, ['clock'],
                                        HALF),
    'commands early': (silent_clock(stamped(COMMAND, lambda t: t - 0.5)), JOINTS, ['clock'], None),
    'stamps of zero': (stamped(IMU, lambda t: 0 * t), IMU, ['do not advance'], None),
    'stamps in milliseconds': (stamped(IMU, lambda t: 1000 * t), IMU, ['apart'], None),
    'degrees per second': (of(IMU, 3, 6, np.rad2deg), IMU, ['degrees per second'], None),
    'acceleration in g': (of(IMU, 0, 3, lambda v: v / 9.80665), IMU, ['units of g'], None),
    'gravity taken off': (without_gravity, IMU, ['without gravity'], None),
    'gravity downwards': (of(IMU, 0, 3, lambda v: -v), IMU, ['opposite sign'], None),
    'one gyroscope axis reversed': (of(IMU, 3, 6, lambda v: v * [1, -1, 1]), IMU, ['wrong sign'],
                                    None),
    'IMU axes swapped': (of(IMU, 0, 6, lambda v: v[:, [0, 2, 1, 3, 5, 4]]), IMU,
                         ['swapped', 'left-handed'], None),
    'IMU upside down': (of(IMU, 0, 6, lambda v: v * [1, -1, -1, 1, -1, -1]), IMU, ['turned'],
                        None),
    'IMU turned on the way': (turned(IMU, BOTH, QUARTER, late=True), IMU, ['turned'], HALF),
    'IMU spike': (spiked(IMU, 3000, 1, 1e6), IMU, ['spike'], 15.0),
    'IMU stale': (of(IMU, 0, 6, lambda v: v[np.arange(len(v)) // 2 * 2]), IMU, ['repeat'], None),
    'gyroscope clipped': (of(IMU, 3, 6, lambda v: np.clip(v, -0.5, 0.5)), IMU, ['clipped'], None),
    'one gyroscope axis frozen': (frozen(IMU, 12, 20, 4), IMU, ['frozen'], 12.0),
    'joints swapped': (of(JOINTS, 0, 4, lambda v: v[:, [1, 0, 2, 3]]), JOINTS, ['swapped'], None),
    'joint reversed': (of(JOINTS, 2, 3, lambda v: -v), JOINTS, ['against'], None),
    'joints in degrees': (of(JOINTS, 0, 4, np.rad2deg), JOINTS, ['degrees'], None),
    'joints in counts': (of(JOINTS, 0, 4, lambda v: 2048 + v * 4096 / (2 * np.pi)), JOINTS,
                         ['counts'], None),
    'one joint frozen': (frozen(JOINTS, 8.5, 24, 1), JOINTS, ['frozen'], 8.5),
    'MoCap noisy': (noisy(POSE, 3, 0.03), POSE, ['scatters'], None),
    'encoders noisy': (noisy(JOINTS, 4, 0.1), JOINTS, ['scatters'], None),
    'tilts commanded in degrees': (of(COMMAND, 0, 4, np.rad2deg), COMMAND, ['degrees'], None),
    'rotors in reverse order': (of(COMMAND, 4, 8, lambda v: v[:, ::-1]), COMMAND,
                                ['order of the thrusts'], None)}


@pytest.mark.parametrize('kind', KINDS)
def test_damage_is_refused_with_topic_cause_and_time(kind):
    change, topic, words, at = KINDS[kind]
    with warnings.catch_warnings(), pytest.raises(UnusableFlight) as error:
        warnings.simplefilter('error')
        prepare(change(recording()), ROBOT, P)
    assert '\n' not in str(error.value)
    problems = error.value.problems
    right = [d for d in problems if d.topic == topic and any(w in d.cause for w in words)]
    assert right, [d.text for d in problems]
    assert 0.5 < right[0].sure <= 1
    assert right[0].run == 'published'
    if at is not None:
        assert right[0].at_s == pytest.approx(at, abs=2.0 if 'recorded so' not in kind else 4.5)


@pytest.mark.parametrize(('change', 'words'), [
    (lambda made: made, ''), (silent_clock(lambda made: made), ''), (reordered, 'out of order'),
    (twice(IMU), 'twice'), (of(POSE, 3, 7, lambda v: 2 * v), 'unit quaternions')])
def test_what_is_harmless_is_used_and_stated(change, words):
    sound, made = prepare(recording(), ROBOT, P), prepare(change(recording()), ROBOT, P)
    assert not words and not made.findings or any(words in text for text in made.findings)
    assert made.duration == pytest.approx(sound.duration, abs=0.05)
    before, after = sound.values[IMU], made.values[IMU]
    assert np.allclose(before[:999], after[-len(before):][:999]) or not made.findings


def slow(turn):
    """A level path of 0.5 m/s^2; markers that are turned [rad], and a bias of 0.3 m/s^2."""
    made = recording()
    t, sent = (made.times[topic] - made.times[IMU][0] for topic in (IMU, COMMAND))
    move = np.column_stack([np.sin(0.9 * t), np.sin(1.3 * t), np.cos(0.7 * t)])
    rng, squares = np.random.default_rng(0), np.square([0.9, 1.3, 0.7])
    made.values[IMU] = np.column_stack([-0.4 * squares * move + [0.3, 0, ROBOT.gravity], 0 * move]
                                       ) + 0.02 * rng.normal(size=(len(t), 6))
    path = [np.interp(made.times[POSE] - made.times[IMU][0], t, 0.4 * x) for x in move.T]
    made.values[POSE] = np.column_stack([*path, np.tile([0, 0, 0, 1.0], (len(path[0]), 1))])
    made.values[POSE][:, 2] += 1.2
    made.values[POSE][:, :3] += 1e-4 * rng.normal(size=(len(path[0]), 3))
    made.values[JOINTS][:] = 0.0015 * rng.integers(-1, 2, made.values[JOINTS].shape)
    made.values[COMMAND][:] = [0.0] * 4 + [ROBOT.hover_thrust] * 4
    made.values[COMMAND][:, 4:] *= 1 - 0.02 * np.cos(0.7 * sent)[:, None]
    noise = 1e-4 * rng.normal(size=(len(path[0]), 3))
    return turned_pose(made, body=Rotation.from_rotvec(turn + noise))


def test_gravity_along_turned_markers_is_no_damage_of_a_slow_flight():
    # 3 deg turn more of gravity into a level axis than the motion has.
    assert checked(slow([0.04, 0.03, 0.02]), ROBOT, 0.0)[2] == []
    wrong = of(POSE, 0, 3, lambda v: v[:, [1, 0, 2]])(slow([0.04, 0.03, 0.02]))
    damage, = checked(wrong, ROBOT, 0.0)[2]     # at one attitude it could also be the IMU
    assert damage.topic in (IMU, POSE) and 'swapped' in damage.cause


def rested(before, after):
    """A recording with rests [s] on the ground, in which neither MoCap nor encoders change."""
    made = recording()
    for topic, t in made.times.items():
        values, received = made.values[topic], made.received[topic]
        if not len(t):
            continue
        for first, k, span in ((t[0] - before, 0, before), (t[-1] + 0.005, -1, after)):
            more = first + np.arange(0, span - 0.004, np.median(np.diff(t)))
            rest = np.tile(values[k], (len(more), 1))
            if topic == COMMAND:
                rest[:, 4:] = 0.0
            if topic == POSE:
                rest[:, :3] = values[0, :3]
            order = slice(None, None, 1 if k else -1)
            for part, new in ((made.times, more), (made.values, rest),
                              (made.received, more + np.median(received - t))):
                part[topic] = np.concatenate([part[topic], new][order])
    return made


@pytest.mark.parametrize(('before', 'after'), [(60.0, 60.0), (300.0, 220.0)])
def test_rests_on_the_ground_are_neither_damage_nor_flight(before, after):
    # 24 s of flight in a bag of two, and of nine minutes.
    flown_part, whole = prepare(recording(), ROBOT, P), prepare(rested(before, after), ROBOT, P)
    assert whole.start == pytest.approx(flown_part.start, abs=0.1)
    assert whole.duration == pytest.approx(flown_part.duration, abs=1.0)
    silent = prepare(silent_clock(lambda made: made)(rested(before, after)), ROBOT, P)
    assert silent.duration == pytest.approx(flown_part.duration, abs=1.0)
    damaged = frozen(POSE, before + 10, before + 13.5)(rested(before, after))
    with pytest.raises(UnusableFlight, match='frozen') as error:
        prepare(damaged, ROBOT, P)
    assert error.value.problems[0].at_s == pytest.approx(before + 10, abs=0.1)


def test_windows_of_one_motion_make_no_step_of_a_clock():
    at, steady = np.arange(30.0), np.random.default_rng(0).normal(0.1, 0.006, 30)
    last, half = steady.copy(), np.where(at < 15, steady, steady + 0.12)
    last[-3:] = -0.07, -0.015, 0.07      # a hover in gusts, 3 of 6 windows that share samples
    assert judge(at, last, [-0.06, 0.35], 0.1, 6) is None
    assert judge(at, last, [-0.06, 0.35], 0.1) is not None     # of other samples each
    assert judge(at, half, [-0.06, 0.35], 0.1, 6)[0].startswith('steps by 0.12 s')


def test_at_most_30_numbers_are_no_range_or_specification_and_state_their_meaning():
    statistical = 0
    for name, kind in (('recording', RecordingLimits), ('gap', GapParameters)):
        found = re.findall(r'^(\w+): ([^#]*?) +# \[[^]]*\] (physical|sensor|statistical): (.+)$',
                           share_path(f'params/{name}.yaml').read_text(), re.MULTILINE)
        assert [key for key, *_ in found] == list(yaml.safe_load(
            share_path(f'params/{name}.yaml').read_text()))
        # `without` has names, no numbers.
        assert {key for key, *_ in found} == {field.name for field in fields(kind)} - {'without'}
        assert all(len(meaning.split()) >= 2 for *_, meaning in found)
        statistical += sum(np.size(yaml.safe_load(value)) for _, value, kind, _ in found
                           if kind == 'statistical')
    assert statistical <= 30


def joint_step(size, lag, end, frozen_from=np.inf):
    """A joint at rest with one step of its command 8 s after the start; ``end`` [s] after that."""
    made, joints = recording(), ROBOT.joints
    at = made.times[JOINTS][0] + 8.0
    columns(made, COMMAND, 1, 2, lambda v: np.where(made.times[COMMAND][:, None] < at, 0.1,
                                                    0.1 + size))
    t, turned = step_response(([joints.kp], [joints.inertia, joints.kd, joints.kp]),
                              T=np.linspace(0, 1, 1001))
    after = np.minimum(made.times[JOINTS] - at, frozen_from) - lag
    count = 2 * np.pi / 4096
    reading = count * np.round((0.1 + size * np.interp(after, t, turned)) / count)
    columns(made, JOINTS, 1, 2, lambda v: reading[:, None])
    return changed(made, JOINTS, keep=made.times[JOINTS] < at + end)


@pytest.mark.parametrize('seed', range(3))
def test_a_joint_that_rests_until_its_command_arrives_is_not_frozen(seed):
    # A step of the command, with any delay of a valid servo until the reading changes, and any
    # time until the end of the recording.
    rng, limits = np.random.default_rng(seed), RecordingLimits.load()
    size, lag = rng.choice([-1, 1]) * rng.uniform(0.27, 0.35), rng.uniform(0, 0.3)
    for end in (rng.uniform(0, lag), rng.uniform(lag, 1.0), 10.0):
        found = sensor_damages(joint_step(size, lag, end))
        assert not found, (size, lag, end, found[0].text)
    # Frozen at any time before the step, it is found once every valid servo would have turned.
    held = joint_step(size, lag, limits.servo_lag[1] + 0.1, frozen_from=0.0)
    damage, = sensor_damages(held)
    assert damage.topic == JOINTS and 'gimbal2 is frozen' in damage.cause


@pytest.mark.parametrize('kind', ['quaternion w first', 'millimetres', 'degrees per second',
                                  'gravity downwards', 'joints swapped', 'joints in degrees',
                                  'MoCap clock of another computer', 'MoCap clock back',
                                  'IMU spike', 'IMU stale', 'IMU upside down', 'marker flips'])
def test_a_repair_restores_the_sound_recording(kind):
    sound = recording()
    fixed, done, left = checked(KINDS[kind][0](recording()), ROBOT, 0.0, fix=True)
    assert done and left == []
    for topic in (IMU, POSE, JOINTS, COMMAND):
        t = sound.times[topic]
        inside = (t > fixed.times[topic].min()) & (t < fixed.times[topic].max())
        order = np.argsort(fixed.times[topic])
        for k, column in enumerate(sound.values[topic].T):
            again = np.interp(t[inside], fixed.times[topic][order], fixed.values[topic][order, k])
            error = np.abs(np.abs(again) - np.abs(column[inside]))
            assert np.median(error) < 1e-3 + 0.03 * np.std(column), (topic, k)
