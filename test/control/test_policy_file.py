"""Metadata of a policy: written, read, and refused with the differing entry."""

from dataclasses import replace
import json

import numpy as np
import pytest

from beetle_omni_ros.control.observation import Block
from beetle_omni_ros.control.policy_file import ACTIONS, PolicyContract
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.robot.resources import share_path
from beetle_omni_ros.robot.schema import ParameterError

ROBOT = RobotParameters.load()


@pytest.mark.parametrize('memory', [False, True])
def test_metadata_round_trip(memory):
    written = replace(PolicyContract.default(ROBOT, memory), training={'seed': 3, 'mass': [1, 2]},
                      metrics={'U_position_m': 0.01}, commit='abc', version='1', created='today')
    metadata = written.to_metadata()
    assert all(isinstance(text, str) for item in metadata.items() for text in item)
    read = PolicyContract.from_metadata(metadata)
    assert read.to_metadata() == metadata
    assert read.memory is memory and read.observation_size == (39 if memory else 33)
    assert read.check(ROBOT) == ''


def test_scales_and_offsets_are_the_published_ones():
    contract = PolicyContract.default(ROBOT)
    assert contract.actions == ('gimbal1', 'gimbal2', 'gimbal3', 'gimbal4',
                                'rotor1', 'rotor2', 'rotor3', 'rotor4')
    assert np.allclose(contract.action_scale, [0.25] * 4 + [0.5] * 4)
    assert np.allclose(contract.action_offset, [0.0] * 4 + [3.0386 * 9.80665 / 4] * 4)
    assert contract.rate_hz == 100


def refusal(**metadata):
    """The one-line refusal of other metadata."""
    given = {**PolicyContract.default(ROBOT).to_metadata(), **metadata}
    with pytest.raises(ParameterError) as caught:
        PolicyContract.from_metadata({k: v for k, v in given.items() if v is not None}
                                     ).check(ROBOT)
    text = str(caught.value)
    assert text and '\n' not in text
    return text


def table(change):
    """JSON of the observation table after ``change`` of its rows."""
    rows = json.loads(PolicyContract.default(ROBOT).to_metadata()['observations'])
    change(rows)
    return json.dumps(rows)


@pytest.mark.parametrize('metadata, named', [
    ({'actions': json.dumps([*ACTIONS[1:4], ACTIONS[0], *ACTIONS[4:]])},
     ['actions', 'gimbal1, gimbal2', 'gimbal2, gimbal3']),
    ({'action_scale': json.dumps([0.25] * 3 + [0.3] + [0.5] * 4)},
     ['action_scale', 'gimbal4', '0.25', '0.3']),
    ({'action_offset': json.dumps([0.0] * 4 + [7.0] * 4)}, ['action_offset', 'rotor1', '7']),
    ({'rate_hz': '200'}, ['rate_hz', '100', '200']),
    ({'robot_hash': 'feedbeef'}, ['robot_hash', 'feedbeef', ROBOT.hash(), 'allow_other_robot']),
    ({'observations': table(list.reverse)}, ['observations', 'velocity, angular_velocity']),
    ({'observations': table(lambda rows: rows[5].update(size=8))}, ['tilt', 'size', '4', '8']),
    ({'observations': table(lambda rows: rows[0].update(frame='world'))},
     ['velocity', 'frame', 'base_link', 'world']),
    ({'observations': table(lambda rows: rows.pop())}, ['observations', 'previous_action']),
    ({'format': 'beetle_omni_policy/2'}, ['format', 'beetle_omni_policy/1', '/2']),
])
def test_differences_are_named(metadata, named):
    text = refusal(**metadata)
    assert all(part in text for part in named), text


@pytest.mark.parametrize('metadata, named', [
    *(({key: None}, [key]) for key in ('format', 'observations', 'actions', 'action_scale',
                                       'action_offset', 'rate_hz', 'robot', 'robot_hash')),
    *(({key: value}, [key]) for key in ('observations', 'actions', 'action_scale')
      for value in ('', 'no json', '3', '{}', '[[', '[1]')),
    ({'action_scale': '[1, 2]'}, ['action_scale', '8']),
    ({'action_offset': '[0, 0, 0, 0, NaN, 1, 1, 1]'}, ['action_offset', 'finite']),
    ({'action_scale': '["a", 0, 0, 0, 0, 1, 1, 1]'}, ['action_scale']),
    ({'training': '[' * 20000}, ['training']), ({'action_scale': '[' * 20000}, ['action_scale']),
    ({'action_scale': f'[1{"0" * 400}, 0, 0, 0, 0, 1, 1, 1]'}, ['action_scale', 'finite']),
    ({'observations': '[{"name": "a", "size": 1e999, "unit": "", "frame": ""}]'},
     ['observations', 'size']),
    ({'rate_hz': 'nan'}, ['rate_hz']), ({'rate_hz': '-100'}, ['rate_hz']),
    ({'training': 'x'}, ['training']), ({'metrics': '[]'}, ['metrics']),
    ({'observations': '[{"name": "velocity"}]'}, ['observations', 'size']),
])
def test_unreadable_metadata_are_refused_with_the_key(metadata, named):
    text = refusal(**metadata)
    assert all(part in text for part in named), text


def test_another_robot_is_refused_and_may_be_allowed():
    other = RobotParameters.load(share_path('params/robot_weak_and_heavy.yaml'))
    contract = PolicyContract.default(ROBOT)
    with pytest.raises(ParameterError, match='--allow-other-robot'):
        contract.check(other)
    warning = contract.check(other, allow_other_robot=True)
    assert 'mass' in warning and '\n' not in warning


def test_permission_for_another_robot_covers_robot_parameters_only():
    other = replace(ROBOT, mass=3.2)
    wrong = replace(PolicyContract.default(ROBOT), action_scale=np.ones(8))
    with pytest.raises(ParameterError, match='action_scale'):
        wrong.check(other, allow_other_robot=True)


def test_sensor_effects_that_the_estimator_corrects_are_not_a_difference():
    turned = replace(ROBOT, effects={'imu_misalignment': {'rotation': (0.01, 0.0, 0.02)}})
    assert not PolicyContract.default(ROBOT).check(turned)


@pytest.mark.parametrize('flown, named', [
    (replace(ROBOT, mass=3.2, joints=replace(ROBOT.joints, kp=0.2)),
     ['mass 3.0386 in training, 3.2 here', 'joints.kp 0.3449 in training, 0.2 here']),
    (replace(ROBOT, effects={'thrust_coefficient': {'scale': 0.93}}),
     ["effects {} in training, {'thrust_coefficient': {'scale': 0.93}} here"]),
    (replace(ROBOT, multibody=None), ['in training, None here'])])
@pytest.mark.parametrize('file', ['new', 'without values'])
def test_parameters_that_differ_are_named_with_both_values(flown, named, file):
    contract = PolicyContract.default(ROBOT)
    if file != 'new':       # values of the shipped robot are known by its hash
        contract = replace(contract, robot_values={})
    with pytest.raises(ParameterError) as error:
        contract.check(flown)
    assert all(part in str(error.value) for part in named), error.value
    assert str(error.value).count(' in training') == len(named)


def test_a_copy_of_the_robot_under_another_name_is_the_same_robot():
    assert PolicyContract.default(ROBOT).check(replace(ROBOT, name='twin')) == ''


def test_blocks_are_compared_as_a_whole():
    contract = PolicyContract.default(ROBOT)
    extra = replace(contract, observations=(*contract.observations, Block('mood', 1, '1', '-')))
    with pytest.raises(ParameterError, match='mood'):
        extra.check(ROBOT)
