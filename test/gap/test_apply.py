"""Values of the named effects in the results and in a robot file."""

from dataclasses import replace
from types import SimpleNamespace

from flights import KEYS
from flights import ROBOT as PLAIN
import numpy as np
import pytest

from beetle_omni_ros.identify.flights.apply import write_corrected
from beetle_omni_ros.identify.flights.keys import entries_of, Entry
from beetle_omni_ros.identify.flights.results import FORM_DEVIATION, Weighed
from beetle_omni_ros.model.effects import CATALOGUE, ignored
from beetle_omni_ros.model.parameters import RobotParameters

ROBOT = RobotParameters.load()
FOUND = {'mass.mass': 0.004, 'inertia.inertia[0]': 0.02, 'inertia.inertia[1]': -0.01,
         'inertia.inertia[2]': 0.0, 'rotor_lag.time_constant': 0.03, 'joint_bandwidth.kp': 0.05,
         'position.offset[4]': 0.001, 'thrust_coefficient.scale': 0.01}
TOLERANCES = {name: {'deviation': x, 'relative': True} for name, x in FOUND.items()}
NAMED = {'names': ['imu_misalignment'], 'parameters': {
    'rotation': {'value': [0.01, 0.0, -0.02], 'interval': None, 'unit': 'rad'}}}
RESULTS = {'verdict': 'named', 'closure': 0.9, 'effects': [NAMED], 'tolerances': TOLERANCES,
           'meta': {'runs': ['a'], 'holdout': ['b']}}


def test_values_fitted_within_tolerance_replace_those_of_the_file(tmp_path):
    write_corrected(tmp_path / 'mine.yaml', RESULTS, ROBOT, None, tolerances=True)
    mine = RobotParameters.load(tmp_path / 'mine.yaml')
    assert mine.mass == pytest.approx(ROBOT.mass * np.exp(0.004), rel=1e-4)
    assert mine.inertia == pytest.approx(ROBOT.inertia * np.exp([0.02, -0.01, 0]), rel=1e-4)
    assert mine.joints.kp == pytest.approx(ROBOT.joints.kp * np.exp(0.05), rel=1e-4)
    assert mine.joints.kd == ROBOT.joints.kd
    moved = mine.rotors.positions - ROBOT.rotors.positions
    assert moved[1] == pytest.approx([0.0, 0.001, 0.0], abs=1e-5)
    assert set(mine.effects) == {'imu_misalignment'}


def test_by_default_only_named_effects_are_written(tmp_path):
    write_corrected(tmp_path / 'mine.yaml', RESULTS, ROBOT, None)
    mine = RobotParameters.load(tmp_path / 'mine.yaml')
    assert replace(mine, effects={}).hash() == ROBOT.hash()
    assert mine.sensors.imu_rotation == (0.01, 0.0, -0.02)


def stated(entry, deviation=0.0, half=0.1, starts=None):
    """Parameters of an entry whose keys were all found at ``deviation`` +- ``half``."""
    count = len(entry.keys)
    engine = SimpleNamespace(index={key: k for k, key in enumerate(entry.keys)},
                             typical=np.full(count, 0.3), indices=lambda chosen: range(count))
    posterior = SimpleNamespace(estimate=np.full(count, deviation),
                                covariance=np.eye(count) * (half / 1.96)**2)
    solution = SimpleNamespace(entries=[entry], judge=SimpleNamespace(
        posterior=lambda index: posterior))
    return Weighed(engine, solution, KEYS, starts or {}).sizes(0, [0])


@pytest.mark.parametrize('name, deviation, expected', [
    ('rotor_drag.coefficient', 0.03, [0.0, 0.03 + np.hypot(0.1, 1.96 * FORM_DEVIATION * 0.03)]),
    ('axial_inflow.per_rotor', 0.4,
     0.4 + np.hypot(0.1, 1.96 * FORM_DEVIATION * 0.4) * np.array([-1, 1])),
    ('joint_feedback_delay.delay', 0.15, [0.05, 0.2])])
def test_intervals_exclude_impossible_values(name, deviation, expected):
    entry, parameter = name.split('.')
    found = stated(Entry(entry, (name,)), deviation)[parameter]
    assert found['interval'] == pytest.approx(expected) and found['file'] == 0.0


@pytest.mark.parametrize('name', [n for n in CATALOGUE if not ignored('gap', n)])
def test_every_entry_states_each_of_its_parameters(name):
    own = {n: key for n, key in KEYS.items() if key.effect == name and not key.form}
    for entry in entries_of(own):
        found = stated(entry)
        assert list(found) == list(CATALOGUE[name].numbers)
        for value in found.values():
            assert set(value) == {'value', 'unit', 'file', 'interval', 'typical'}


def test_a_limit_is_stated_from_the_start_at_which_it_acts():
    start = {'joint_velocity_limit.velocity_limit': np.log(0.5)}
    entry = Entry('joint_velocity_limit', ('joint_velocity_limit@0',))
    found = stated(entry, 1.0, 0.2, {'joint_velocity_limit@0': start})['velocity_limit']
    limit = PLAIN.joints.velocity_limit
    assert found['value'] == pytest.approx(0.5 * limit)
    assert found['interval'] == pytest.approx([0.5**1.2 * limit, 0.5**0.8 * limit])
