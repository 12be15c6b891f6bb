"""Values that are written to a robot file with the named effects."""

from dataclasses import replace

import numpy as np
import pytest
import yaml

from beetle_omni_ros.identify.gap.apply import write_corrected
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


def test_a_number_that_was_not_fitted_has_no_interval(tmp_path):
    servo = {'names': ['joint_bandwidth'], 'parameters': {
        'kp': {'value': 0.33, 'interval': [0.32, 0.34], 'unit': 'N m/rad'},
        'kd': {'value': 0.0094, 'interval': [0.0094, 0.0094], 'unit': 'N m s/rad'}}}
    write_corrected(tmp_path / 'mine.yaml', {**RESULTS, 'effects': [servo]}, ROBOT, None)
    written, = yaml.safe_load((tmp_path / 'mine.yaml').read_text())['provenance']['named']
    assert written['parameters'] == {
        'kp': {'value': 0.33, 'interval': [0.32, 0.34], 'unit': 'N m/rad'},
        'kd': {'value': 0.0094, 'unit': 'N m s/rad'}}
