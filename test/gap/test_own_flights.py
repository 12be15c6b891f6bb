"""Flights of the package's own simulator: what is there is named, and nothing else."""

import flown_once
import numpy as np
import pytest
from rich.console import Console
import yaml

import beetle_omni_ros
from beetle_omni_ros.identify.flights.command import gap_results
from beetle_omni_ros.identify.recording.bag import COMMAND, IMU, JOINTS, POSE, read_recording
from beetle_omni_ros.model.resources import share_path


def flown(folder, task, seeds=(1, 2), **more):
    """Bags of flights."""
    for seed in seeds:
        beetle_omni_ros.simulate('nmpc', task, seed=seed, bag=folder / f'{seed}', **more)
    return [folder / f'{seed}' for seed in seeds]


def gap(bags, **more):
    """Results of these flights."""
    return gap_results(bags, console=Console(quiet=True), **more)


def test_two_calm_hovers_show_only_means_and_name_nothing(tmp_path):
    result = gap(flown(tmp_path, 2 * [[0, 0, 1, 0, 0, 0]]))
    assert not result['effects'] and result['false_alarm_probability'] > 0.05
    for kind in ('force', 'acceleration', 'rate'):
        assert 'only means' in result['groups'][kind]['reason']
    assert 'only means' not in result['groups']['joint'].get('reason', '')


def test_late_tilt_commands_and_modules_that_load_the_servos_are_named_and_nothing_else(tmp_path):
    plant, robot = tmp_path / 'plant.yaml', tmp_path / 'without_modules.yaml'
    plant.write_text('extends: robot.yaml\neffects: {joint_command_latency: {delay: 0.007}}\n')
    file = yaml.safe_load(share_path('params/robot.yaml').read_text())
    module = file.pop('multibody')['module']
    file['joints']['inertia'] = 5e-5
    robot.write_text(yaml.safe_dump(file))
    effects = {effect['names'][0]: effect['parameters'] for effect in gap(
        flown(tmp_path, 'random3', plant=plant), robot=robot)['effects']}
    assert set(effects) == {'module_reaction', 'joint_command_latency'}
    # the emulated bus acts in ticks of 5 ms
    assert effects['joint_command_latency']['delay']['value'] == pytest.approx(0.010, abs=0.003)
    depth = module['centre_of_mass'][2]
    for name, true in (('module_inertia', module['inertia'][0] + module['mass'] * depth**2),
                       ('mass_moment', -module['mass'] * depth)):
        low, high = effects['module_reaction'][name]['interval']
        assert low < true < high


def test_a_weak_servo_and_one_with_play_are_named_and_written_to_the_file(tmp_path):
    plant, fixed = tmp_path / 'plant.yaml', tmp_path / 'fixed.yaml'
    plant.write_text('extends: robot.yaml\neffects:\n'
                     '  joint_bandwidth: {kp: [0.3449, 0.3449, 0.25, 0.3449], kd: 0.0094}\n'
                     '  joint_backlash: {gap: [0.03, 0, 0, 0]}\n')
    bags = flown(tmp_path, 'random3', plant=plant)
    found = {(effect['names'][0], effect['joint']) for effect in gap(bags, apply=fixed)['effects']}
    assert found == {('joint_bandwidth', 3), ('joint_backlash', 1)}
    assert not gap(bags, robot=fixed)['effects']
    effects = yaml.safe_load(fixed.read_text())['effects']
    assert effects['joint_bandwidth']['kp'] == pytest.approx(
        [0.3449, 0.3449, 0.25, 0.3449], abs=0.01)
    assert effects['joint_backlash']['gap'] == pytest.approx([0.03, 0, 0, 0], abs=0.006)


def test_lags_of_rotors_far_beyond_their_tolerance_are_unknown_where_no_entry_has_them(tmp_path):
    plant, less = tmp_path / 'plant.yaml', tmp_path / 'less.yaml'
    plant.write_text('extends: robot.yaml\neffects: {rotor_lag: {time_constant: 0.06}}\n')
    less.write_text('without: [rotor_lag]\n')
    result = gap(flown(tmp_path, 'random2', plant=plant), parameters=less)
    assert result['verdict'] == 'unknown' and 'explains the lag of rotor' in result['reason']


FORMAT = """
clock_deviation: 0.001
time: {columns: [t], unit: s}
position: {columns: [px, py, pz], unit: m}
quaternion: {columns: [qx, qy, qz, qw], order: xyzw, frame: body_to_world}
specific_force: {columns: [ax, ay, az], unit: m/s^2}
angular_velocity: {columns: [wx, wy, wz], unit: rad/s}
tilt: {columns: [q1, q2, q3, q4], unit: rad}
thrust: {columns: [f1, f2, f3, f4], unit: N}
"""


def test_a_table_of_a_robot_that_tilts_has_the_forces_of_its_modules(tmp_path):
    flight = read_recording(flown_once.flight('calm'))
    t = np.arange(flight.times[POSE][0], flight.times[POSE][-1], 0.01)

    def at(topic, columns):
        return [np.interp(t, flight.times[topic], column)
                for column in flight.values[topic][:, columns].T]
    held = np.searchsorted(flight.times[COMMAND], t - 0.01) - 1     # on the way for 10 ms
    thrust = flight.values[COMMAND][np.clip(held, 0, None), 4:].T
    form, table = tmp_path / 'own.yaml', tmp_path / 'flight.csv'
    form.write_text(FORMAT)
    np.savetxt(table, np.column_stack([
        t - t[0], *at(POSE, slice(7)), *at(IMU, slice(6)), *at(JOINTS, slice(4)), *thrust]),
        delimiter=',', comments='', header='t,px,py,pz,qx,qy,qz,qw,ax,ay,az,wx,wy,wz,'
                                           'q1,q2,q3,q4,f1,f2,f3,f4')
    result = gap([table], form=str(form))
    assert result['groups']['force']['used'] and result['groups']['torque']['used']
    assert result['verdict'] in ('no_gap', 'not_decidable') and not result['findings']
