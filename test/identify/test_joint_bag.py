"""A bag as a response log has the same rows as the equivalent CSV file."""


import numpy as np
import pytest
from servo_logs import sweep
from synthetic_flights import write_command, write_joints

from beetle_omni_ros.identify.servo.log import read_joint_log
from beetle_omni_ros.runs.bag_writer import BagWriter
from beetle_omni_ros.runs.files import LogError


def recorded(folder, t, command, sent=None, joints=True):
    """Write a bag in which joint feedback and commands come at ``t``; commands where ``sent``."""
    with BagWriter(folder) as bag:
        for k, (now, wanted) in enumerate(zip(t.tolist(), command.tolist())):
            if sent is None or sent[k]:
                write_command(bag, now - 0.003, np.array([wanted, -wanted, 0.5 * wanted, wanted]),
                              np.full(4, 7.0), received=now - 0.001)
            if joints:
                write_joints(bag, now, 0.9 * np.array([wanted, -wanted, 0.5 * wanted, wanted]),
                             np.zeros(4))
    return folder


def test_each_reading_is_paired_with_the_last_command_before_it(tmp_path):
    t, command = sweep(duration=3.0)
    log = read_joint_log(recorded(tmp_path / 'bag', t + 5.0, command))
    assert log.joints == (1, 2, 3, 4)
    assert np.allclose(log.t, t, atol=1e-6)
    assert np.allclose(log.command, np.outer([1, -1, 0.5, 1], command), atol=1e-9)
    assert np.allclose(log.measured, 0.9 * log.command, atol=1e-9)


@pytest.mark.parametrize(('made', 'words'), [
    ({'joints': False}, 'no joint_states in this bag'),
    ({'sent': np.zeros(300, dtype=bool)}, 'no command in this bag')])
def test_a_bag_without_servos_is_refused_in_one_line(tmp_path, made, words):
    t, command = sweep(duration=3.0)
    with pytest.raises(LogError, match=words) as error:
        read_joint_log(recorded(tmp_path / 'bag', t, command, **made))
    assert '\n' not in str(error.value)
    with pytest.raises(LogError):
        read_joint_log(tmp_path)
