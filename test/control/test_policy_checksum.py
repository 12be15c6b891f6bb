"""A policy with other weights than the exported ones is refused."""

import subprocess
import sys

import numpy as np
import onnx
import onnxruntime
from policy_files import write
import pytest

from beetle_omni_ros.control import policy_checksum
from beetle_omni_ros.control.policy_network import PolicyNetwork
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.robot.resources import share_path
from beetle_omni_ros.robot.schema import ParameterError

ROBOT = RobotParameters.load()
SHIPPED = [share_path(f'policies/{name}.onnx') for name in ('rl', 'rl_memory')]


def refusal(path):
    with pytest.raises(ParameterError) as error:
        PolicyNetwork(path, ROBOT)
    message = str(error.value)
    assert '\n' not in message and len(message) < 1500 and str(path) in message
    return message


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


def test_another_graph_with_the_same_weights_is_refused(tmp_path):
    path = write(tmp_path / 'p.onnx', hidden=(16,))
    model = onnx.load(path)
    next(node for node in model.graph.node if node.op_type == 'Elu').op_type = 'Relu'
    onnx.save(model, path)
    assert 'checksum differs' in refusal(path)


def test_other_metadata_are_refused_and_a_copy_by_onnx_is_not(tmp_path):
    path = write(tmp_path / 'p.onnx', hidden=(16,))
    model = onnx.load(path)
    onnx.save(model, path)
    PolicyNetwork(path, ROBOT)
    model.metadata_props.add(key='note', value='mine')
    onnx.save(model, path)
    assert 'checksum differs' in refusal(path)
    policy_checksum.add(path)
    PolicyNetwork(path, ROBOT)


def test_a_policy_without_checksum_is_refused_with_the_way_to_add_it(tmp_path):
    path = write(tmp_path / 'p.onnx', hidden=(16,), checksum=False)
    message = refusal(path)
    assert "metadata 'checksum' is missing" in message
    command = next(part for part in message.split('; ') if part.startswith('python -m'))
    command = command.partition(' FILE')[0].split()[1:]
    subprocess.run([sys.executable, *command, path], check=True, timeout=60)
    PolicyNetwork(path, ROBOT)
    before = path.read_bytes()
    policy_checksum.add(path)
    assert path.read_bytes() == before
    missing = subprocess.run([sys.executable, *command, tmp_path / 'none.onnx'], text=True,
                             capture_output=True, timeout=60)
    assert missing.returncode and len(missing.stderr.splitlines()) == 1


@pytest.mark.parametrize('path', SHIPPED, ids=lambda path: path.stem)
def test_the_checksum_changes_no_action(tmp_path, path):
    model = onnx.load(path)
    del model.metadata_props[:]
    plain = onnxruntime.InferenceSession(model.SerializeToString(),
                                         providers=['CPUExecutionProvider'])
    network = PolicyNetwork(path, ROBOT)
    rng = np.random.default_rng(1)
    for _ in range(50):
        seen = rng.normal(size=network.contract.observation_size).astype(np.float32)
        expected = plain.run(['action'], {'observation': seen[None]})[0][0]
        assert network(seen.tolist()) == expected.tolist()


def test_metadata_that_are_not_text_are_refused_in_one_line(tmp_path):
    path = write(tmp_path / 'p.onnx', metadata={'name': 'abcdefgh'})
    data = path.read_bytes()
    path.write_bytes(data.replace(b'abcdefgh', b'abc\xff\xfeefg'))
    policy_checksum.add(path)
    assert 'metadata that are no UTF-8 text' in refusal(path)


def test_weights_in_another_file_are_refused(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path = write(tmp_path / 'p.onnx', hidden=(64,), checksum=False)
    onnx.save_model(onnx.load(path), str(path), save_as_external_data=True, location='w.bin',
                    size_threshold=0)
    policy_checksum.add(path)
    assert (tmp_path / 'w.bin').stat().st_size > 1000
    refusal(path)


def test_long_metadata_are_truncated_in_messages(tmp_path):
    refusal(write(tmp_path / 'p.onnx', metadata={'robot': 'x' * 100_000, 'robot_hash': 'y'}))
