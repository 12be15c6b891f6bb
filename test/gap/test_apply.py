"""Values of the named effects in the results and in a robot file."""

from dataclasses import replace
from types import SimpleNamespace

from flights import KEYS
from flights import ROBOT as PLAIN
import numpy as np
import pytest

from beetle_omni_ros.identify.gap.apply import write_corrected
from beetle_omni_ros.identify.gap.results import parameters
from beetle_omni_ros.robot.effects import CATALOGUE, ignored
from beetle_omni_ros.robot.parameters import RobotParameters

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


@pytest.mark.parametrize('name, deviation, expected', [
    ('rotor_drag.coefficient', 0.03, [0.0, 0.13]), ('axial_inflow.per_rotor', 0.4, [0.3, 0.5])])
def test_intervals_exclude_impossible_values(name, deviation, expected):
    a = SimpleNamespace(keys=KEYS, widths={name: 0.1})
    entry, parameter = name.split('.')
    found = parameters(a, entry, (name,), {name: deviation}, PLAIN)[parameter]
    assert found['interval'] == pytest.approx(expected) and found['file'] == 0.0


@pytest.mark.parametrize('name', [n for n in CATALOGUE if not ignored('gap', n)])
def test_every_entry_states_each_of_its_parameters(name):
    own = {key.name: key for key in KEYS.values() if key.effect == name}
    member = 1 if CATALOGUE[name].each else None
    free = tuple(key for key in own if member is None or key.endswith(f'[{member - 1}]')) or \
        tuple(own)
    a = SimpleNamespace(keys=KEYS, widths=dict.fromkeys(own, 0.1))
    stated = parameters(a, name, free, dict.fromkeys(own, 0.0), PLAIN)
    assert list(stated) == list(CATALOGUE[name].parameters)
    for entry in stated.values():
        assert set(entry) == {'value', 'unit', 'file', 'interval'}
