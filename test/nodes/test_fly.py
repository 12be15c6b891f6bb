"""`fly`: faults that a flight through ROS cannot simulate are refused; what is printed."""

import io

import pytest
from rich.console import Console

from beetle_omni_ros import cli
from beetle_omni_ros.nodes.fly import _print_measured


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


def test_the_arrangement_and_cpu_of_the_nodes_are_printed():
    text = io.StringIO()
    _print_measured({'graph': {'cpu_percent': 91.2}, 'composed': True},
                    Console(file=text, width=200))
    assert text.getvalue() == ('graph: composed (all nodes in one process), CPU 91 % of one core '
                               'while the task was flown\n')
