"""A robot file from all logs, and the shipped one that is made from the measured logs."""

from pathlib import Path
import shlex

import numpy as np
import pytest
from rotor_logs import RATIO, SERIES, series, stand
from rotor_logs import write as write_rows
from servo_logs import log_of, sweep, write
import yaml

from beetle_omni_ros import cli
from beetle_omni_ros.identify.servo.model import own_delay
from beetle_omni_ros.model.parameters import RobotParameters, value_of
from beetle_omni_ros.model.resources import share_path

ROOT = Path(__file__).resolve().parents[2]
PUBLISHED, MEASURED = RobotParameters.load(), RobotParameters.load('measured')
TRUE = [{'frequency': wn, 'damping': 0.6, 'coulomb': band, 'delay': 0.024}
        for wn, band in ((50.0, 0.013), (47.0, 0.030), (53.0, 0.012), (55.0, 0.010))]
STAND = ('pwm_us', 'force_N', 'torque_N_m', 'voltage_V', 'temperature', 'file_voltage')


@pytest.fixture(scope='module')
def made(tmp_path_factory):
    """Folder with logs of a known robot, and the file written from them."""
    folder = tmp_path_factory.mktemp('made')
    zeros = [TRUE[0] | {'offset': 0.015}, *TRUE[1:]]
    logs = [write(folder / 'slow.csv', log_of(*sweep(5.0), zeros, seed=1)),
            write(folder / 'fast.csv', log_of(*sweep(
                3.0, periods=(0.3, 0.5), amplitudes=(0.3, 0.5)), TRUE, seed=2)),
            write_rows(folder / 'stand.csv', stand(np.random.default_rng(0)), STAND),
            write_rows(folder / 'series.csv', series(np.random.default_rng(0)), SERIES)]
    rest = np.repeat(stand(np.random.default_rng(1))[-1:], 60, axis=0)
    rest[:2, 0], rest[:, 1] = 1000, rest[:, 1] * np.linspace(0, 1, 60)
    rest[:, 2] *= np.linspace(0, 1, 60)
    logs.append(write_rows(folder / 'untimed.csv', rest, STAND))
    assert cli.main(['identify', 'robot', *map(str, logs), '--params', str(folder / 'mine.yaml'),
                     '--json', str(folder / 'r.json'), '--report', str(folder / 'p.html')]) == 0
    return folder


def test_the_intervals_hold_the_true_robot(made):
    robot = RobotParameters.load(made / 'mine.yaml')
    frequency, damping, coulomb, delay = (np.array([one[name] for one in TRUE]) for name in (
        'frequency', 'damping', 'coulomb', 'delay'))
    kp = PUBLISHED.joints.inertia * frequency**2
    truth = {
        'effects.joint_bandwidth.kp': kp,
        'effects.joint_bandwidth.kd': kp * 2 * damping / frequency,
        'effects.joint_friction.coulomb': kp * coulomb,
        'effects.joint_command_latency.delay': delay[0] - own_delay(),
        'tilt_lag': 2 * damping / frequency + delay - own_delay(),
        'rotors.torque_to_thrust_ratio': RATIO}
    assert set(truth) | {'rotors.time_constant', 'effects.joint_friction.stiction'} \
        == set(robot.intervals)
    for key, value in truth.items():
        low, high = robot.interval(key)
        assert np.all((low <= value) & (value <= high)), (key, low, value, high)
    low, high = robot.interval('rotors.time_constant')
    assert low < 0.07 and high > 0.045      # rising and falling


def test_the_file_has_command_logs_and_what_no_log_shows_but_no_zero(made):
    content = yaml.safe_load((made / 'mine.yaml').read_text())
    origin = content['provenance']['origin']
    assert set(content['provenance']['logs']) == {path.name for path in made.glob('*.csv')}
    assert 'joint_offset' not in content['effects'] and 'not written: joint_offset' in origin
    assert set(content['intervals']) <= set(origin)
    left = content['provenance']['of_the_extended_file']
    assert {'mass', 'inertia', 'joints.inertia', 'battery', 'rotors.thrust_max'} <= set(left)
    assert not set(left) & {'joints.kp', 'rotors.map', 'rotors.time_constant'}
    assert 'untimed.csv' in (made / 'r.json').read_text()
    assert (made / 'p.html').read_text().count('<img') == 5    # logs, surfaces, lag


@pytest.mark.skipif(not (ROOT / '../shared/data/joint_response_100Hz.csv').is_file(),
                    reason='the measured logs are not there')
def test_the_recorded_command_gives_the_shipped_file(tmp_path, monkeypatch):
    monkeypatch.chdir(ROOT)
    shipped = yaml.safe_load(share_path('params/robot_measured.yaml').read_text())
    _, *words = shlex.split(shipped['provenance']['command'])
    words[words.index('--params') + 1] = str(tmp_path / 'made.yaml')
    assert cli.main(words) == 0
    again = RobotParameters.load(tmp_path / 'made.yaml')
    assert again.rotors.map[0].coefficients == pytest.approx(MEASURED.rotors.map[0].coefficients)
    for key, ends in MEASURED.intervals.items():
        assert value_of(again, key) == pytest.approx(value_of(MEASURED, key), rel=0.02, abs=2e-5)
        for one, other in zip(again.interval(key), ends, strict=True):
            assert one == pytest.approx(other, rel=0.05, abs=2e-5)
