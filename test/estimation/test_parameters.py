"""The parameter file and the code agree, and bad files are named."""

from dataclasses import replace

import numpy as np
import pytest
import yaml

from beetle_omni_ros.estimation.parameters import EkfParameters
from beetle_omni_ros.robot import schema
from beetle_omni_ros.robot.resources import share_path

FILE = share_path('params/ekf.yaml')


def test_shipped_file_names_every_parameter_with_its_default():
    named = schema.load_yaml(FILE)
    for name, _, _, value in schema.flatten(EkfParameters()):
        entry = named
        for key in name.split('.'):
            assert key in entry, f'{name} is missing in {FILE}'
            entry = entry[key]
        assert np.array_equal(entry, value), f'{name}: file {entry}, default {value}'


def test_every_parameter_of_the_file_has_its_unit_and_default_before_it():
    comment = ''
    for line in FILE.read_text().splitlines():
        text = line.strip()
        if text.startswith('#'):
            comment += text + '\n'
        elif text and not text.endswith(':'):
            default = yaml.safe_load(comment.split('default ')[-1].split(' (')[0].split('\n')[0])
            assert '[' in comment and 'default' in comment, f'{text}: no unit or default before it'
            assert default == yaml.safe_load(text.split(': ')[1]), text
            comment = ''
        else:
            comment = comment if text.endswith(':') else ''


@pytest.mark.parametrize('line, named', [
    ('{mocap: {positon_noise: 0.001}}', 'positon_noise'),
    ('{imu: {gyroscope_noise: -1.0}}', 'imu.gyroscope_noise'),
    ('{imu: {position: [0.0, 0.0]}}', 'imu.position'),
    ('{status: {lost_after: 0.05}}', 'status.lost_after'),
    ('{imu: {gap_limit: 0.004, rate: 200.0}}', 'imu.gap_limit'),
])
def test_bad_file_is_refused_with_file_and_key(tmp_path, line, named):
    path = tmp_path / 'mine.yaml'
    path.write_text(line)
    with pytest.raises(schema.ParameterError, match='mine.yaml') as error:
        EkfParameters.load(path)
    assert named in str(error.value) and '\n' not in str(error.value)


def test_parameters_can_be_changed_by_replacement():
    shipped = EkfParameters.load()
    assert replace(shipped, imu=replace(shipped.imu, rate=400.0)).imu.rate == 400.0
