"""The flight engine on tables of flights with known effects."""

import json
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console
from scipy.spatial.transform import Rotation

from beetle_omni_ros import cli
from beetle_omni_ros.identify.flights.command import gap_results
from beetle_omni_ros.identify.flights.verdict import load_tables
from beetle_omni_ros.identify.recording.conventions import read_tables
from beetle_omni_ros.identify.recording.series import FASTEST, slow, turning, wander
from beetle_omni_ros.identify.recording.table import Format
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.model.resources import share_path
from beetle_omni_ros.model.schema import ParameterError

REAL = Path(__file__).parents[1] / 'data/nanobench'
BESIDE = Path(__file__).parents[3] / 'shared/data/flights'
ROBOT = share_path('params/crazyflie.yaml')
HEADER = ('t,px,py,pz,qx,qy,qz,qw,fx,fy,fz,wx,wy,wz,pwm1,pwm2,pwm3,pwm4,vbat,sp_x,sp_y,sp_z,'
          'des_roll,des_pitch')


def motor_volts(thrust):
    """Motor voltages that give thrusts [N] by the published map."""
    grid = np.linspace(0, 5, 5001)
    return np.interp(thrust, -0.01483 + 0.04724 * grid - 0.01847 * grid**2 + 0.005961 * grid**3,
                     grid)


def write_flight(path, seed, scale=1.0, drag=0.0, sag=True, seconds=34.0, late=0.0, bias=0.0,
                 wander=0.002, wind=(0.0, 0.0, 0.0), hub=0.0, rough=0.01):
    """
    A flight in the columns of NanoBench, from equations of its own.

    The motion is prescribed; attitude and commands are those that it needs. Thrust by motor
    voltage with a lag of 60 ms. MoCap is ``late`` (a number or (N,)) [s], and the accelerometer
    has a vertical ``bias`` [m/s^2] and a random walk of ``wander`` a sample. ``wind`` is a force
    in world [N], and ``hub`` the moment of the rotors by speed [N s]. The gyroscope has a noise of
    ``rough`` rad/s.
    """
    rng = np.random.default_rng(seed)
    t = np.arange(-1, seconds + 1, 0.01)        # derivatives at the ends are cut off
    height = sum(rng.normal() * np.sin(2 * np.pi * f * t + rng.uniform(0, 6)) / f**2 for f in (
        0.3, 0.7, 1.1, 1.9)) * 0.005
    p = np.stack([np.sin(0.9 * t + seed) / 0.9, np.cos(0.7 * t) / 0.7, 1 + height], axis=1)
    v = np.gradient(p, 0.01, axis=0)
    need = 0.0319 * (np.gradient(v, 0.01, axis=0) + [0, 0, 9.81])
    thrust, up = need, np.zeros_like(need)
    for _ in range(20):     # thrust carries the weight, the acceleration and the drag
        size = np.linalg.norm(thrust, axis=1, keepdims=True)
        up = thrust / size
        in_plane = v - up * (up * v).sum(axis=1, keepdims=True)
        thrust = need - wind + drag * np.sqrt(size / (0.0319 * 9.81)) * in_plane
    left = np.cross(up, [1, 0.3, 0])
    left /= np.linalg.norm(left, axis=1, keepdims=True)
    matrix = np.stack([np.cross(left, up), left, up], axis=2)
    q = Rotation.from_matrix(matrix)
    rates = np.pad((q[:-2].inv() * q[2:]).as_rotvec() / 0.02, ((1, 1), (0, 0)), mode='edge')
    inertia = np.array([16.571710e-6, 16.655602e-6, 29.261652e-6])
    turning = np.gradient(rates, 0.01, axis=0)
    along = np.einsum('nji,nj->ni', matrix, v)
    torque = inertia * turning + np.cross(rates, inertia * rates) \
        - hub * np.cross(along, [0, 0, 1])      # forwards, the nose goes up
    arm, ratio = 0.03253, 0.00596
    wrench = np.array([[1, 1, 1, 1], [-arm, -arm, arm, arm], [-arm, arm, arm, -arm],
                       [-ratio, ratio, -ratio, ratio]])
    lagged = np.linalg.solve(wrench, np.concatenate([
        np.linalg.norm(thrust, axis=1)[None], torque.T])).T / scale
    force = lagged + 0.06 * np.gradient(lagged, 0.01, axis=0)
    volts = 4.0 - 0.5 * t / seconds - 0.05 * rng.random()
    duty = motor_volts(force) / (volts[:, None] if sag else 3.7)
    specific = np.einsum('nji,nj->ni', matrix, need) / 0.0319 + [0, 0, bias]
    # coloured noise: white and a slow wander
    noise = rng.normal(size=(len(t), 3)) * 0.05 + np.cumsum(
        rng.normal(size=(len(t), 3)), axis=0) * wander
    p[t < 1, 2] = 0
    seen = np.concatenate([p, q.as_quat() * np.sign(q.as_quat()[:, 3:])], axis=1)
    seen = np.stack([np.interp(t - np.broadcast_to(late, len(t)), t, column)
                     for column in seen.T], axis=1)
    columns = np.column_stack([
        t, seen, specific + noise, rates + rng.normal(size=(len(t), 3)) * rough,
        duty * 65535, volts, p, np.zeros((len(t), 2))])[100:-100]
    np.savetxt(path, columns, delimiter=',', header=HEADER, comments='', fmt='%.7g')
    return path


def gap_of(flights, form='nanobench', robot=ROBOT, **more):
    return gap_results(flights, robot=robot, form=form, console=Console(quiet=True), **more)


def named(result):
    return {name for effect in result['effects'] for name in effect['names']}


def shows_thrust_and_drag(result, scale=0.8, drag=0.012):
    """Whether these two are named, with intervals that hold their sizes or miss by 1 %."""
    found = {effect['names'][0]: effect['parameters'] for effect in result['effects']}
    return set(found) == {'thrust_coefficient', 'rotor_drag'} and all(
        low - 0.01 * true <= true <= high + 0.01 * true for true, (low, high) in (
            (scale, found['thrust_coefficient']['scale']['interval']),
            (drag, found['rotor_drag']['coefficient']['interval'])))


def test_a_hidden_thrust_and_drag_are_named_with_their_sizes(tmp_path, capsys):
    flights = [write_flight(tmp_path / f'{k}.csv', k, scale=0.8, drag=0.012) for k in range(2)]
    page, file = tmp_path / 'gap.html', tmp_path / 'gap.json'
    assert cli.main(list(map(str, ['gap', *flights, '--format', 'nanobench', '--robot', ROBOT,
                                   '--report', page, '--json', file]))) == 0
    result = json.loads(file.read_text())
    assert shows_thrust_and_drag(result)
    assert result['false_alarm_probability'] < 1e-3
    assert result['gap_after'] < 0.2 * result['gap_before'] + 0.8
    # no page is proposed that has just been written
    *_, then, last = capsys.readouterr().out.splitlines()
    assert then == f'next:  open {page} in a browser' and '--report' not in last
    assert last.startswith('next:  the same with --apply FILE')


def test_names_and_sizes_are_those_of_flights_cut_turned_shifted_and_in_another_order(tmp_path):
    turn, flights = Rotation.from_euler('z', 1.1), []
    for k in range(2):
        path = write_flight(tmp_path / f'{k}.csv', k, scale=0.8, drag=0.012)
        rows = np.loadtxt(path, delimiter=',', skiprows=1)
        rows[:, 0] += 123.4567
        rows[:, 1:4], rows[:, 19:22] = turn.apply(rows[:, 1:4]), turn.apply(rows[:, 19:22])
        rows[:, 4:8] = (turn * Rotation.from_quat(rows[:, 4:8])).as_quat()
        for half, part in enumerate(np.array_split(rows, 2)):
            flights.insert(0, tmp_path / f'{k}_{half}.csv')
            np.savetxt(flights[0], part, delimiter=',', header=HEADER, comments='', fmt='%.7g')
    assert shows_thrust_and_drag(gap_of(flights))


def test_torques_that_balance_a_known_moment_show_it_although_the_robot_hardly_turns(tmp_path):
    flights = [write_flight(tmp_path / f'{k}.csv', k, hub=5e-4, rough=0.5) for k in range(2)]
    effect, = gap_of(flights)['effects']
    low, high = effect['parameters']['coefficient']['interval']
    assert effect['names'] == ['rotor_hub_moment'] and low < 5e-4 < high < 8e-4


def test_an_accelerometer_at_a_lever_feels_the_turns_of_the_robot(tmp_path):
    path = write_flight(tmp_path / 'a.csv', 1, seconds=20)
    cells = np.loadtxt(path, delimiter=',', skiprows=1)
    t, lever = cells[:, 0], np.array([0.01, -0.004, 0.006])
    rates = np.stack([np.sin(3 * t), 2 * np.cos(2 * t), 0 * t], axis=1)
    turning = np.stack([3 * np.cos(3 * t), -4 * np.sin(2 * t), 0 * t], axis=1)
    cells[:, 11:14] = rates
    np.savetxt(path, cells, delimiter=',', header=HEADER, comments='')
    flight, = load_tables([path], RobotParameters.load(ROBOT), Format.load('nanobench'))
    names = [f'imu_lever_arm.offset[{k}]' for k in range(3)]
    felt = -(flight.linear({}, names).slopes[10:-10] @ lever)
    expected = (np.cross(turning, lever) + np.cross(rates, np.cross(rates, lever)))[10:-10]
    for group in ('force', 'acceleration'):
        at = [flight.channels.index(f'{group}_{axis}') for axis in 'xyz']
        assert np.allclose(felt[:, at], expected, atol=1e-4)
    assert not felt[:, flight.channels.index('rate_x')].any()


@pytest.fixture
def by_mocap(tmp_path):
    """Makes flights that begin in the air, and gives results from their positions alone."""
    form = tmp_path / 'mocap.yaml'
    form.write_text(''.join(
        line for line in share_path('params/formats/nanobench.yaml').read_text().splitlines(True)
        if not line.startswith('specific_force')).replace('clock: radio', 'clock: mocap'))

    def result(seeds, board=None, **effect):
        flights = [write_flight(tmp_path / f'{k}.csv', k, **effect) for k in seeds]
        for k, flight in enumerate(flights):
            rows = np.loadtxt(flight, delimiter=',', skiprows=1)[200:]
            if board is not None:   # attitude and gyroscope have the axes of one turned board
                body = Rotation.from_quat(rows[:, 4:8])
                rows[:, 11:14] = body.apply(rows[:, 11:14])
                rows[:, 4:8] = (body * Rotation.from_rotvec(board)).as_quat()
                form.write_text(form.read_text().replace(
                    'rad/s, frame: body', 'rad/s, frame: world'))
            rows[:, 1:8] += np.random.default_rng(k).normal(size=(len(rows), 7)) * 2e-4
            np.savetxt(flight, rows, delimiter=',', header=HEADER, comments='', fmt='%.7g')
        return gap_of(flights, str(form))
    return result


def test_without_accelerometer_positions_show_the_forces(by_mocap):
    result = by_mocap(range(2), scale=0.8, drag=0.012)
    assert result['groups']['force']['channels'] == ['force_x', 'force_y', 'force_z']
    assert 'no accelerometer' in result['groups']['acceleration']['reason']
    assert shows_thrust_and_drag(result)
    assert not by_mocap(range(10, 12))['effects']


def test_a_wind_of_a_fifth_of_the_weight_is_not_taken_for_markers_that_are_turned(by_mocap):
    result = by_mocap(range(2), wind=(0.05, -0.03, 0.0))
    assert named(result) == {'wind'}
    force = result['effects'][0]['parameters']['force']['value']
    assert np.allclose(force, [0.05, -0.03, 0.0], atol=0.004)


def test_rates_turned_by_an_attitude_do_not_deny_that_it_is_turned(by_mocap):
    board = np.array([0.04, -0.05, 0.0])
    result = by_mocap(range(2), board=board)
    effect, = result['effects']     # a wind may be beside it: these flights move gently
    assert effect['names'][0] == 'mocap_misalignment' and not result['groups']['rate']['used']
    low, high = np.transpose(effect['parameters']['rotation']['interval'])
    assert (low < board).all() and (board < high).all() and (high - low)[:2].max() < 0.02


def test_a_drag_that_too_few_blocks_show_is_no_unknown_force(tmp_path):
    result = gap_of([write_flight(tmp_path / 'short.csv', 1, drag=0.03, seconds=22)])
    assert result['verdict'] == 'not_decidable' and not result['effects']
    assert 'rotor drag would explain' in result['reason']
    assert named(gap_of([write_flight(tmp_path / 'long.csv', 1, drag=0.03)])) == {'rotor_drag'}


HOVERING = """
time: {columns: [t], unit: s}
position: {columns: [px, py, pz], unit: m}
velocity: {columns: [vx, vy, vz], unit: m/s}
specific_force: {columns: [fx, fy, fz], unit: m/s^2}
thrust: {columns: [u1, u2, u3, u4], unit: N}
"""


def write_hovering(path, seed, push, seconds=24.0, step=0.002):
    """Level flight under feedback, which a wake pushes down by ``push`` of the weight at times."""
    rng = np.random.default_rng(seed)
    t = np.arange(0, seconds, step)
    passes = np.cumsum(rng.uniform(2.5, 4.5, size=12))
    wake = -push * np.exp(-0.5 * ((t[:, None] - passes) / 0.25)**2).sum(axis=1)
    aim = 1 + 0.1 / 3 * sum(np.sin(2 * np.pi * f * t + rng.uniform(0, 6)) for f in (0.3, 0.8, 1.5))
    noise = rng.normal(size=(2, len(t))) * [[1e-3], [1e-2]]
    z, speed, thrust, total = 1.0, 0.0, 9.81, 0.0       # by the mass
    rows = np.zeros((len(t), 4))
    for k in range(len(t)):
        error = aim[k] - z - noise[0, k]
        total += error * step
        command = 9.81 + 14 * error - 6 * (speed + noise[1, k]) + 6 * total
        thrust += step / 0.06 * (command - thrust)
        force = thrust + 9.81 * wake[k]
        rows[k] = z, speed, force, 0.0319 * command
        speed += step * (force - 9.81)
        z += step * speed
    rows, still = rows[::5], np.zeros((len(rows[::5]), 2))
    felt = np.column_stack([still, rows[:, 2]]) + rng.normal(size=(len(rows), 3)) * 0.05
    np.savetxt(path, np.column_stack([t[::5], still, rows[:, 0], still, rows[:, 1], felt, *(
        4 * [rows[:, 3] / 4])]), delimiter=',', comments='', fmt='%.7g',
        header='t,px,py,pz,vx,vy,vz,fx,fy,fz,u1,u2,u3,u4')
    return path


@pytest.mark.parametrize('seed', [135, 155])
def test_the_answer_to_a_wake_is_no_effect_of_the_robot(tmp_path, seed):
    form = tmp_path / 'hovering.yaml'
    form.write_text(HOVERING)
    flights = [write_hovering(tmp_path / f'{k}.csv', seed + k, push=0.3) for k in range(3)]
    assert not named(gap_of(flights, str(form)))


def test_a_thrust_that_the_rotors_cannot_deliver_does_not_count(tmp_path):
    form = tmp_path / 'hovering.yaml'
    form.write_text(HOVERING + 'voltage: {columns: [fx], unit: V}\n')
    path = write_hovering(tmp_path / 'a.csv', 1, push=0.0)
    cells = np.loadtxt(path, delimiter=',', skiprows=1)
    cells[1000:1005, 12] = 0.17             # the file's rotors have 0.16 N
    cells[:, 7] = np.linspace(4.2, 3.4, len(cells))     # stands for the voltage
    np.savetxt(path, cells, delimiter=',', header=path.read_text().split('\n', 1)[0], comments='')
    flight, = load_tables([path], RobotParameters.load(ROBOT), Format.load(str(form)))
    at = flight.channels.index('force_z')
    assert not flight.mask[1000:1005, at].any() and flight.mask[500:1000, at].all()
    key = 'voltage_sag.exponent'
    slope = -flight.linear({}, [key]).slopes[500:600, at, 0]
    assert np.allclose(slope, 9.81 * np.log(flight.motion['voltage'][500:600]), rtol=0.2)
    assert flight.motion['voltage'][[0, -1]] == pytest.approx([1.0, 3.4 / 4.2])


def test_flights_of_the_robot_of_the_file_have_no_named_effect(tmp_path):
    flights = [write_flight(tmp_path / f'{k}.csv', 10 + k) for k in range(2)]
    result = gap_of(flights)
    assert not result['effects']
    assert result['false_alarm_probability'] > 0.05


def test_a_file_that_ignores_the_voltage_is_told_so(tmp_path):
    robot = tmp_path / 'robot.yaml'
    robot.write_text('extends: crazyflie.yaml\neffects: {}\n')
    flights = [write_flight(tmp_path / f'{k}.csv', 20 + k) for k in range(2)]
    result = gap_of(flights, robot=robot, apply=tmp_path / 'corrected.yaml')
    assert 'voltage_sag' in named(result)
    assert 'voltage_sag' in (tmp_path / 'corrected.yaml').read_text()


def test_mocap_shows_a_bias_of_the_accelerometer_whatever_the_thrust_is(tmp_path):
    path = write_flight(tmp_path / 'a.csv', 40, scale=0.8, bias=0.3, wander=3e-4, late=0.03)
    model, form = RobotParameters.load(ROBOT), Format.load('nanobench')
    flight, = load_tables([path], model, form)
    key = 'imu_accelerometer_bias.bias[2]'
    at = flight.channels.index('acceleration_z')
    for value in (0.0, 0.3):
        found = flight.linear({key: value}, [key])
        mean = found.residual[flight.mask[:, at], at].mean()
        assert mean == pytest.approx(0.3 - value, abs=0.03)
        assert np.allclose(found.slopes[:, at], -1)


@pytest.mark.parametrize('late', [0.04, -0.08])
def test_a_late_clock_of_mocap_is_measured_and_taken_out(tmp_path, late):
    path = write_flight(tmp_path / 'a.csv', 50, seconds=20, late=late)
    model, form = RobotParameters.load(ROBOT), Format.load('nanobench')
    table, = read_tables([path], form)
    seen, felt = turning(table.values['quaternion'], 0.01), table.values['angular_velocity']
    found, deviation = wander(seen, felt, np.ones(len(table), dtype=bool), 0.01)
    assert found == pytest.approx(late, abs=0.004) and deviation < 0.015
    flight, = load_tables([path], model, form)
    away = flight._seen[200:-200, 3:] - flight.measured({})[200:-200, -3:]
    assert not flight.apart and away.std() < 0.2 * felt.std()


@pytest.mark.parametrize('still', [0.0, 12.0])
def test_a_clock_is_known_from_where_the_robot_turns_also_in_a_short_flight(still):
    rng, t = np.random.default_rng(3), np.arange(0, 6 + still, 0.01)
    felt = np.stack([np.sin(5 * t), np.cos(4 * t), 0 * t], axis=1) * (t < 6)[:, None]
    seen, felt = (x + 0.02 * rng.normal(size=x.shape) for x in (np.roll(felt, 3, axis=0), felt))
    seen, felt = (slow(x, 0.01, FASTEST) for x in (seen, felt))
    late, deviation = wander(seen, felt, np.ones(len(t), dtype=bool), 0.01)
    assert late == pytest.approx(0.03, abs=0.002) and deviation < 0.01


def test_a_clock_that_wanders_takes_out_the_pair_and_not_the_flight(tmp_path):
    away = np.repeat(np.random.default_rng(5).normal(size=18) * 0.12, 200)
    paths = [write_flight(tmp_path / f'{k}.csv', 60 + k, scale=0.8, late=late)
             for k, late in enumerate((away, 0.02))]
    result = gap_of(paths[:1])
    assert result['groups']['force']['used'] and not result['groups']['rate']['used']
    assert 'wander by' in result['groups']['acceleration']['reason']
    both = gap_of(paths)
    assert both['groups']['acceleration']['used'] and 'thrust_coefficient' in named(both)
    assert [text.split(':')[0] for text in both['findings']] == ['0.csv']


def test_what_a_format_lacks_is_listed_with_its_reason(tmp_path):
    form = tmp_path / 'bare.yaml'
    form.write_text('time: {columns: [t], unit: s}\n'
                    'specific_force: {columns: [null, null, fz], unit: m/s^2}\n'
                    'duty: {columns: [pwm1, pwm2, pwm3, pwm4], full: 65535}\n'
                    'voltage: {columns: [vbat], unit: V}\n')
    flights = [write_flight(tmp_path / f'{k}.csv', 30 + k) for k in range(2)]
    result = gap_of(flights, str(form))
    groups = result['groups']
    assert groups['force'] == {'used': True, 'channels': ['force_z'], 'reason': (
        'no specific force or acceleration along this axis')}
    assert groups['torque'] == {'used': False, 'channels': [], 'reason': 'no gyroscope'}
    assert not groups['acceleration']['used'] and not groups['joint']['used']


def test_flights_on_the_ground_and_other_channels_are_told_by_name(tmp_path):
    good = write_flight(tmp_path / 'good.csv', 1, seconds=20)
    lines = good.read_text().splitlines()
    ground = tmp_path / 'ground.csv'
    cells = [line.split(',') for line in lines]
    ground.write_text('\n'.join([lines[0], *(','.join([*c[:3], '0', *c[4:]]) for c in cells[1:])]))
    assert gap_of([ground])['verdict'] == 'bad_data'
    result = gap_of([good, ground])
    finding, = result['findings']
    assert finding.startswith('ground.csv: not used, no block of commands and measurements in the '
                              'air: heights are 0 to 0 m, thrusts 0.')
    blind = tmp_path / 'blind.csv'
    blind.write_text('\n'.join([lines[0], *(','.join([*c[:8], '', *c[9:]]) for c in cells[1:])]))
    with pytest.raises(ParameterError, match='blind.csv: its channels are force_y'):
        gap_of([good, blind])


def test_hops_that_no_filter_can_use_are_told_and_no_error(tmp_path):
    path = write_flight(tmp_path / 'hops.csv', 1, seconds=20)
    cells = np.loadtxt(path, delimiter=',', skiprows=1)
    cells[cells[:, 0] % 1.4 > 0.8, 14:18] = np.nan      # 0.5 s after a gap do not count
    np.savetxt(path, cells, delimiter=',', header=HEADER, comments='')
    path.write_text(path.read_text().replace('nan', ''))
    result = gap_of([path])
    assert result['verdict'] == 'bad_data' and 'has no block of commands' in result['reason']


def test_duty_needs_a_robot_with_a_motor_map(tmp_path):
    flight = write_flight(tmp_path / 'a.csv', 1, seconds=5)
    with pytest.raises(ParameterError, match="'rotors.motor' is missing"):
        gap_of([flight], robot=None)


@pytest.mark.timeout(600)
def test_real_flights_name_thrust_and_drag_and_never_an_inertia():
    result = gap_of(sorted(REAL.glob('*_fast.csv.gz')))
    assert {'thrust_coefficient', 'rotor_drag', 'rotor_hub_moment'} <= named(result)
    assert not {'inertia', 'torque_coefficient', 'wind'} & named(result)
    assert result['groups']['acceleration']['used'] and result['groups']['rate']['used']
    found = {effect['names'][0]: effect['parameters'] for effect in result['effects']}
    assert 0.009 < found['rotor_drag']['coefficient']['value'] < 0.015
    assert result['closure'] > 0.8


@pytest.mark.skipif(not BESIDE.is_dir(), reason='further flights are not beside the repository')
def test_short_real_flights_name_no_inertia():
    flights = [BESIDE / f'nano_B2_circle_{name}_rep1.csv.gz' for name in ('slow', 'fast')]
    assert 'inertia' not in named(gap_of(flights))
