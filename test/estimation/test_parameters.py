"""The parameter file and the code agree, and bad files are named."""

import numpy as np
import pytest

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


@pytest.mark.parametrize('line, named', [
    ('{status: {lost_after: 0.05}}', 'status.lost_after'),
    ('{imu: {gap_limit: 0.004, rate: 200.0}}', 'imu.gap_limit'),
])
def test_bad_file_is_refused_with_file_and_key(tmp_path, line, named):
    path = tmp_path / 'mine.yaml'
    path.write_text(line)
    with pytest.raises(schema.ParameterError, match='mine.yaml') as error:
        EkfParameters.load(path)
    assert named in str(error.value) and '\n' not in str(error.value)
