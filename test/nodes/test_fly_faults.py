"""`fly --faults`: faults that a flight through ROS cannot simulate are refused."""

import pytest

from beetle_omni_ros import cli


@pytest.mark.parametrize(('fault', 'more', 'named'), [
    ('controller_silent, at: 1', [], 'expected a fault of the robot'),
    ('joints_lost', ['--actuators', 'emulated'], 'expected --actuators direct'),
    ('rotor_stops', [], "'rotor' is missing")])
def test_faults_that_this_flight_cannot_simulate_are_refused(capsys, tmp_path, fault, more, named):
    file = tmp_path / 'faults.yaml'
    file.write_text(f'faults: [{{what: {fault}}}]\n')
    assert cli.main(['fly', '--bag', str(tmp_path / 'bag'), '--faults', str(file), *more]) == 2
    line, = capsys.readouterr().err.splitlines()
    assert named in line and not (tmp_path / 'bag').exists()
