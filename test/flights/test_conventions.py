"""Frames, orders, units and signs of a format that the sensors of a flight contradict."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from beetle_omni_ros.identify.recording.conventions import read_tables
from beetle_omni_ros.identify.recording.table import Format
from beetle_omni_ros.model.files import LogError
from beetle_omni_ros.model.schema import ParameterError

FORMAT = """
time: {columns: [t], unit: s}
quaternion: {columns: [qx, qy, qz, qw], order: xyzw, frame: body_to_world, clock: mocap}
angular_velocity: {columns: [wx, wy, wz], unit: rad/s, frame: body, clock: imu}
specific_force: {columns: [fx, fy, fz], unit: m/s^2}
"""


@pytest.fixture
def flight(tmp_path):
    """A table of a level robot that leans, with a turned and late MoCap and a biased gyroscope."""
    def write(lean=0.3, seed=0):
        rng, t = np.random.default_rng(seed), 0.01 * np.arange(3000)
        phase, speed = rng.uniform(0, 6, (3, 4)), 2 * np.pi * rng.uniform(0.05, 0.6, (3, 4))
        turns = lean * np.sin(speed * t[:, None, None] + phase).sum(axis=2) / 2 + [0, 0.2, 0]
        body = Rotation.from_rotvec(turns)
        rate = (body[:-1].inv() * body[1:]).as_rotvec() / 0.01 + [0.01, -0.02, 0.005]
        seen = (body * Rotation.from_rotvec([0.03, -0.05, 0.02])).as_quat()[:-1]
        late = np.concatenate([np.repeat(seen[:1], 4, axis=0), seen[:-4]])
        force = body.inv().apply([0, 0, 9.81])[:-1]
        path = tmp_path / f'{seed}.csv'
        np.savetxt(path, np.column_stack([
            t[:-1], late + 2e-4 * rng.normal(size=late.shape),
            rate + 0.01 * rng.normal(size=rate.shape),
            force + 0.3 * rng.normal(size=force.shape)]), delimiter=',', fmt='%.7g',
            comments='', header='t,qx,qy,qz,qw,wx,wy,wz,fx,fy,fz')
        return path
    return write


def declared(tmp_path, old='', new=''):
    path = tmp_path / 'own.yaml'
    assert old in FORMAT
    path.write_text(FORMAT.replace(old, new))
    return Format.load(str(path))


def test_a_right_format_is_accepted_with_any_mounting_bias_and_clock(flight, tmp_path):
    tables = read_tables([flight(seed=k) for k in range(2)], declared(tmp_path))
    assert len(tables) == 2


@pytest.mark.parametrize(('right', 'wrong', 'what'), [
    ('frame: body_to_world', 'frame: world_to_body', 'quaternion.frame'),
    ('order: xyzw', 'order: wxyz', 'quaternion.order'),
    ('frame: body,', 'frame: world,', 'angular_velocity.frame'),
    ('unit: rad/s', 'unit: deg/s', 'angular_velocity.unit')])
def test_a_declaration_that_the_gyroscope_contradicts_is_named_with_the_right_one(
        flight, tmp_path, right, wrong, what):
    expected, found = (text.split(': ')[1].strip(',') for text in (right, wrong))
    with pytest.raises(ParameterError, match=f"key '{what}': expected '{expected}', found "
                                             f"'{found}': the gyroscope differs by"):
        read_tables([flight()], declared(tmp_path, right, wrong))


def test_a_robot_that_does_not_turn_contradicts_no_format(flight, tmp_path):
    still = flight(lean=0.0)
    for right, wrong in (('order: xyzw', 'order: wxyz'), ('frame: body,', 'frame: world,')):
        assert read_tables([still], declared(tmp_path, right, wrong))


def test_signs_that_no_declaration_explains_are_told_without_advice(flight, tmp_path):
    with pytest.raises(ParameterError, match='no other order, frame or unit agrees: check signs'):
        read_tables([flight()], declared(
            tmp_path, 'unit: rad/s', 'sign: [1, -1, -1], unit: rad/s'))


@pytest.mark.parametrize(('right', 'wrong'), [
    ('unit: m/s^2', 'unit: g'), ('unit: m/s^2', 'sign: [1, -1, -1], unit: m/s^2'),
    ('[fx, fy, fz]', '[fz, fx, fy]')])
@pytest.mark.parametrize('attitude', [True, False])
def test_an_accelerometer_whose_mean_is_not_gravity_is_refused(
        flight, tmp_path, right, wrong, attitude):
    form = declared(tmp_path, right, wrong)
    if not attitude:
        del form.signals['quaternion']      # then only the size is known
        if 'unit: g' not in wrong:
            assert len(read_tables([flight()], form)) == 1
            return
    with pytest.raises(ParameterError, match="key 'specific_force': its .* expected about"):
        read_tables([flight()], form)


@pytest.mark.parametrize('unit', ['ms', 'us'])
def test_a_wrong_unit_of_time_is_refused_with_the_distance_of_the_rows(flight, tmp_path, unit):
    with pytest.raises(LogError, match="rows are 1e-0. s apart, expected 0.0001 to 0.1 s: key 't"):
        read_tables([flight()], declared(tmp_path, 'unit: s', f'unit: {unit}'))
