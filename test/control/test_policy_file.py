"""A policy file: its contract and checksum, each refusal with its cause in one line."""

from dataclasses import replace
import json

import numpy as np
import onnx
from onnx import TensorProto
from policy_files import write
import pytest

from beetle_omni_ros.control.policy_file import (
    add_checksum,
    PolicyContract,
    PolicyNetwork,
    robot_hash,
    trained_for,
)
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.model.schema import ParameterError

ROBOT = RobotParameters.load()
ACTIONS = ['gimbal1', 'gimbal2', 'gimbal3', 'gimbal4', 'rotor1', 'rotor2', 'rotor3', 'rotor4']


def table(change):
    """JSON of the observation table after ``change`` of its rows."""
    rows = json.loads(PolicyContract.default(ROBOT).to_metadata()['observations'])
    change(rows)
    return json.dumps(rows)


@pytest.mark.parametrize('metadata, named', [
    ({'actions': json.dumps([*ACTIONS[1:4], ACTIONS[0], *ACTIONS[4:]])},
     ['actions', 'gimbal1', 'gimbal2']),
    ({'action_scale': json.dumps([0.25] * 3 + [0.3] + [0.5] * 4)}, ['action_scale', '0.3']),
    ({'action_scale': '[0.25]'}, ['action_scale', 'None']),
    ({'action_offset': '[0, 0, 0, 0, NaN, 1, 1, 1]'}, ['action_offset', 'nan']),
    ({'rate_hz': '200'}, ['rate_hz', '100', '200']),
    ({'robot_hash': '1:feedbeef', 'robot_values': '{}'}, ['robot_values', 'missing']),
    ({'observations': table(list.reverse)}, ['observations', 'velocity']),
    ({'observations': table(lambda rows: rows[5].update(size=8))},
     ['tilt', "'size': 4", "'size': 8"]),
    ({'observations': table(lambda rows: rows.pop())}, ['observations', 'previous_action']),
    ({'format': 'beetle_omni_policy/2'}, ['format', 'beetle_omni_policy/1', '/2']),
    ({'rate_hz': None}, ['rate_hz']), ({'actions': '[['}, ['actions']),
    ({'action_scale': '[' * 20000}, ['action_scale']),
    ({'observations': '[{"name": "a"}]'}, ['observations'])])
def test_other_metadata_are_refused_with_the_entry_and_both_values(metadata, named):
    given = {**PolicyContract.default(ROBOT).to_metadata(), **metadata}
    with pytest.raises(ParameterError) as caught:
        PolicyContract.from_metadata({k: v for k, v in given.items() if v is not None}
                                     ).check(ROBOT)
    text = str(caught.value)
    assert '\n' not in text and all(part in text for part in named), text


@pytest.mark.parametrize('flown, named', [
    (replace(ROBOT, mass=3.2, joints=replace(ROBOT.joints, kp=0.2)),
     ['mass 3.0386 in training, 3.2 here', 'joints.kp 0.3449 in training, 0.2 here']),
    (replace(ROBOT, effects={'thrust_coefficient': {'scale': 0.93}}),
     ["effects {} in training, {'thrust_coefficient': {'scale': 0.93}} here"]),
    (replace(ROBOT, multibody=None), [
        'mass 0.16444 in training, None here', 'multibody.module.centre_of_mass',
        'multibody.module.inertia'])])
def test_another_robot_is_described_by_its_parameters(flown, named):
    contract = PolicyContract.default(ROBOT)
    text = contract.check(flown)
    assert all(part in text for part in named) and '\n' not in text, text
    assert text.count(' in training') == len(named)
    with pytest.raises(ParameterError, match='action_scale'):
        replace(contract, action_scale=[1.0] * 8).check(flown)


@pytest.mark.parametrize('changes', [
    {'name': 'twin'}, {'effects': {'imu_misalignment': {'rotation': (0.01, 0.0, 0.02)}}},
    {'battery': replace(ROBOT.battery, resistance=0.1)}, {'intervals': {}},
    {'rotors': replace(ROBOT.rotors, map=ROBOT.rotors.map[1:])},
    {'effects': {'voltage_sag': {'exponent': 1.0}}}])
def test_what_the_training_does_not_use_is_no_difference(changes):
    assert PolicyContract.default(ROBOT).check(replace(ROBOT, **changes)) == ''


def test_the_hash_of_values_in_any_order_with_further_ones_is_that_of_the_robot():
    values = {**ROBOT.as_dict(), 'removed': {'value': 3}}
    turned = {key: dict(reversed(value.items())) if isinstance(value, dict) else value
              for key, value in reversed(values.items())}
    assert robot_hash(turned) == robot_hash(trained_for(ROBOT)) == robot_hash(ROBOT)


@pytest.mark.parametrize('name', ['rl', 'rl_any', 'rl_published'])
def test_a_shipped_policy_of_a_version_that_covered_every_value_is_valid(name):
    network = PolicyNetwork(f'policies/{name}.onnx', ROBOT)
    assert network.contract.robot_hash == robot_hash(ROBOT)
    heavy = replace(ROBOT, mass=3.1, effects={'joint_bandwidth': {
        'kp': (0.2, 0.3, 0.3, 0.3), 'kd': 0.009}})
    assert 'mass 3.0386 in training, 3.1 here' in network.contract.check(heavy)
    trained = network.contract.trained_robot(heavy)
    assert robot_hash(replace(trained, multibody=ROBOT.multibody)) == robot_hash(ROBOT)


def refusal(path):
    with pytest.raises(ParameterError) as error:
        PolicyNetwork(path, ROBOT)
    message = str(error.value)
    assert '\n' not in message and len(message) < 1500 and str(path) in message
    return message


@pytest.mark.parametrize('options, named', [
    ({'inputs': 30}, ["'observation'", '33', '30']), ({'outputs': 7}, ["'action'", '8', '7']),
    ({'names': ('obs', 'action')}, ["'observation'", "'obs'"]),
    ({'dtype': TensorProto.DOUBLE}, ['tensor(float)', 'tensor(double)']),
    ({'drop': ('format',)}, ["'format'"]), ({'bias': np.full(8, np.nan)}, ['not finite'])])
def test_an_incompatible_network_is_refused_with_the_difference(tmp_path, options, named):
    text = refusal(write(tmp_path / 'p.onnx', **options))
    assert all(part in text for part in named), text


def test_other_metadata_are_refused_until_the_checksum_is_added(tmp_path):
    path = write(tmp_path / 'p.onnx')
    model = onnx.load(path)
    onnx.save(model, path)
    PolicyNetwork(path, ROBOT)
    model.metadata_props.add(key='note', value='mine')
    onnx.save(model, path)
    assert 'checksum differs' in refusal(path)
    add_checksum(path)
    PolicyNetwork(path, ROBOT)
