"""A policy file: its contract and checksum, each refusal with its cause in one line."""

from dataclasses import replace
import json
import subprocess
import sys

import numpy as np
import onnx
from onnx import TensorProto
from policy_files import write
import pytest

from beetle_omni_ros.control.policy_file import (
    ACTIONS,
    add_checksum,
    Block,
    PolicyContract,
    PolicyNetwork,
)
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.robot.resources import share_path
from beetle_omni_ros.robot.schema import ParameterError

ROBOT = RobotParameters.load()
SHIPPED = [share_path(f'policies/{name}.onnx') for name in ('rl', 'rl_memory')]


@pytest.mark.parametrize('memory', [False, True])
def test_metadata_round_trip(memory):
    written = replace(PolicyContract.default(ROBOT, memory), training={'seed': 3, 'mass': [1, 2]},
                      metrics={'U_position_m': 0.01}, commit='abc', version='1', created='today')
    read = PolicyContract.from_metadata(written.to_metadata())
    assert read == written
    assert read.memory is memory and read.observation_size == (39 if memory else 33)
    assert read.check(ROBOT) == ''


def test_scales_and_offsets_are_the_published_ones():
    contract = PolicyContract.default(ROBOT)
    assert contract.actions == ('gimbal1', 'gimbal2', 'gimbal3', 'gimbal4',
                                'rotor1', 'rotor2', 'rotor3', 'rotor4')
    assert np.allclose(contract.action_scale, [0.25] * 4 + [0.5] * 4)
    assert np.allclose(contract.action_offset, [0.0] * 4 + [3.0386 * 9.80665 / 4] * 4)
    assert contract.rate_hz == 100


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
    ({'action_offset': json.dumps([0.0] * 4 + [7.0] * 4)}, ['action_offset', '7.449', '7.0']),
    ({'action_offset': '[0, 0, 0, 0, NaN, 1, 1, 1]'}, ['action_offset', 'nan']),
    ({'rate_hz': '200'}, ['rate_hz', '100', '200']),
    ({'robot_hash': 'feedbeef'}, ['robot_hash', 'feedbeef', ROBOT.hash(), 'allow_other_robot']),
    ({'observations': table(list.reverse)}, ['observations', 'velocity']),
    ({'observations': table(lambda rows: rows[5].update(size=8))}, ['tilt', "'4'", "'8'"]),
    ({'observations': table(lambda rows: rows.pop())}, ['observations', 'previous_action']),
    ({'observations': table(lambda rows: rows.append(Block('mood', 1, '1', '-')._asdict()))},
     ['observations', 'mood']),
    ({'format': 'beetle_omni_policy/2'}, ['format', 'beetle_omni_policy/1', '/2']),
    *(({key: None}, [key]) for key in ('format', 'observations', 'actions', 'action_scale',
                                       'action_offset', 'rate_hz', 'robot_hash')),
    *(({key: value}, [key]) for key in ('observations', 'actions', 'action_scale')
      for value in ('', 'no json', '3', '[[')),
    *(({'action_scale': value}, ['action_scale'])
      for value in ('["a"]', '[' * 20000, f'[1{"0" * 400}]')),
    ({'training': 'x'}, ['training']), ({'observations': '[{"name": "a"}]'}, ['observations'])])
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
    (replace(ROBOT, multibody=None), ['in training, None here'])])
@pytest.mark.parametrize('file', ['new', 'without values'])
def test_another_robot_is_refused_with_the_parameters_and_may_be_allowed(flown, named, file):
    contract = PolicyContract.default(ROBOT)
    if file != 'new':       # values of the shipped robot are known by its hash
        contract = replace(contract, robot_values={})
    with pytest.raises(ParameterError, match='--allow-other-robot') as error:
        contract.check(flown)
    warning = contract.check(flown, allow_other_robot=True)
    for text in (warning, str(error.value)):
        assert all(part in text for part in named) and '\n' not in text, text
        assert text.count(' in training') == len(named)
    with pytest.raises(ParameterError, match='action_scale'):
        replace(contract, action_scale=(1.0,) * 8).check(flown, allow_other_robot=True)


@pytest.mark.parametrize('changes', [
    {'name': 'twin'}, {'effects': {'imu_misalignment': {'rotation': (0.01, 0.0, 0.02)}}}])
def test_a_name_and_sensor_effects_that_the_estimator_corrects_are_no_difference(changes):
    assert PolicyContract.default(ROBOT).check(replace(ROBOT, **changes)) == ''


def refusal(path):
    with pytest.raises(ParameterError) as error:
        PolicyNetwork(path, ROBOT)
    message = str(error.value)
    assert '\n' not in message and len(message) < 1500 and str(path) in message
    return message


def test_a_missing_policy_file_is_named(tmp_path):
    assert 'no such file' in refusal(tmp_path / 'none.onnx')
    assert 'no such file' in refusal(tmp_path)
    assert "package's share" in refusal('policies/none.onnx')


def test_a_truncated_file_and_another_format_are_refused(tmp_path):
    whole = write(tmp_path / 'whole.onnx', hidden=(16,)).read_bytes()
    for content in (b'not a network', np.random.default_rng(0).bytes(5000),
                    *(whole[:int(share * len(whole))] for share in np.arange(0, 1, 0.05))):
        path = tmp_path / 'other.onnx'
        path.write_bytes(content)
        assert refusal(path)


@pytest.mark.parametrize('options, named', [
    ({'inputs': 30}, ["'observation'", '33', '30']), ({'outputs': 7}, ["'action'", '8', '7']),
    ({'memory': True, 'inputs': 33}, ["'observation'", '39', '33']),
    ({'names': ('obs', 'action')}, ["'observation'", "'obs'"]),
    ({'dtype': TensorProto.DOUBLE}, ['tensor(float)', 'tensor(double)']),
    ({'drop': ('format',)}, ["'format'"]), ({'bias': np.full(8, np.nan)}, ['at rest', 'finite']),
    ({'metadata': {'robot': 'x' * 100_000, 'robot_hash': 'y'}}, ['robot_hash'])])
def test_an_incompatible_network_is_refused_with_the_difference(tmp_path, options, named):
    text = refusal(write(tmp_path / 'p.onnx', **options))
    assert all(part in text for part in named), text


@pytest.mark.parametrize('path', SHIPPED, ids=lambda path: path.stem)
def test_a_flipped_bit_of_any_weight_is_refused(tmp_path, path):
    data = path.read_bytes()
    rng = np.random.default_rng(0)
    for initializer in onnx.load(path).graph.initializer:
        raw = initializer.raw_data
        at = data.index(raw) + int(rng.integers(len(raw)))
        flipped = bytearray(data)
        flipped[at] ^= 1 << int(rng.integers(8))
        (tmp_path / 'flipped.onnx').write_bytes(flipped)
        assert 'checksum differs' in refusal(tmp_path / 'flipped.onnx'), initializer.name


def test_other_metadata_are_refused_until_the_checksum_is_added(tmp_path):
    path = write(tmp_path / 'p.onnx', hidden=(16,))
    model = onnx.load(path)
    onnx.save(model, path)
    PolicyNetwork(path, ROBOT)
    model.metadata_props.add(key='note', value='mine')
    onnx.save(model, path)
    assert 'checksum differs' in refusal(path)
    add_checksum(path)
    PolicyNetwork(path, ROBOT)
    model.metadata_props.add(key='name', value='abcdefgh')
    onnx.save(model, path)
    path.write_bytes(path.read_bytes().replace(b'abcdefgh', b'abc\xff\xfeefg'))
    add_checksum(path)
    assert 'utf-8' in refusal(path)


def test_a_policy_without_checksum_is_refused_with_the_way_to_add_it(tmp_path):
    path = write(tmp_path / 'p.onnx', hidden=(16,), checksum=False)
    message = refusal(path)
    command = next(part for part in message.split('; ') if part.startswith('python -m'))
    subprocess.run([sys.executable, *command.partition(' FILE')[0].split()[1:], path], check=True,
                   timeout=60)
    PolicyNetwork(path, ROBOT)
    before = path.read_bytes()
    add_checksum(path)
    assert path.read_bytes() == before
