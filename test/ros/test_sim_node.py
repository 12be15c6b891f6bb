"""sim_node with emulated actuators: ports instead of topics, faults in flight."""

import os

import numpy as np
import pytest
from rclpy.parameter import Parameter

from beetle_omni_ros.flight import component as base
from beetle_omni_ros.ros.sim_node import SimNode

pytestmark = pytest.mark.real_time


@pytest.fixture
def sim(make):
    return lambda *overrides, actuators='emulated': make(
        SimNode, f'actuators:={actuators}', *overrides)


def put(node, **values):
    """Set parameters one after the other like `ros2 param set`; return the last answer."""
    for name, value in values.items():
        answer = node.set_parameters([Parameter(name.replace('__', '.'), value=value)])[0]
    return answer


def topics(node):
    return ({one.topic_name for one in node.publishers},
            {one.topic_name for one in node.subscriptions})


def test_faults_are_switched_in_flight_and_reported(sim):
    node = sim('faults:="mocap_lost"', actuators='direct')
    published, subscribed = topics(node)
    assert {'/joint_states', '/battery_state'} <= published and '/command' in subscribed
    refused = put(node, servo_faults__silent=[2])
    assert not refused.successful and 'silent [2]: there are no' in refused.reason
    assert node.component._robot_status()[0] == base.OK
    node._simulator.step()
    level, text, values = node.component._robot_status()
    assert level == base.WARN and text == 'mocap_lost' and values['broken'] == 0
    assert put(node, faults='mocap_lost; rotor_stops rotor=2').successful
    node._simulator.step()
    assert node._simulator.faults == ['mocap_lost', 'rotor_stops']
    answer = put(node, faults='controller_nan')
    assert not answer.successful and 'affects a process' in answer.reason
    assert node._simulator.faults == ['mocap_lost', 'rotor_stops']
    assert put(node, faults='').successful
    assert node._simulator.faults == []


def test_the_simulator_publishes_simulated_time_only_without_serial_devices(sim):
    node = sim('clock:=simulated', actuators='direct')
    assert '/clock' in topics(node)[0] and '/odom' in topics(node)[1]
    before = node.now()
    ticks = [node._on_timer() or node.now() for _ in range(10)]
    assert np.allclose(np.diff([before, *ticks]), 0.005, rtol=0, atol=1e-6)


def test_faults_of_devices_change_in_flight_and_are_in_the_diagnostics(sim, tmp_path):
    servos, board = tmp_path / 'servos', tmp_path / 'board'
    servos.symlink_to('/nowhere')           # left by a process that was killed
    node = sim(f'servo_port:={servos}', f'board_port:={board}', 'servo_faults.overload:=[3]')
    published, subscribed = topics(node)
    assert not {'/joint_states', '/battery_state'} & published and '/command' not in subscribed
    bus = node._devices.bus
    assert set(bus.faults.overload) == {3}
    assert put(node, servo_faults__overload=[], servo_faults__silent=[2],
               board_faults__drop_in=0.5).successful
    level, text, values = node.component._devices_status()
    assert level == base.WARN and text == 'faults: servo silent [2], board drop_in 0.5'
    assert values['armed'] is False and values['torque'] == [False] * 4
    assert put(node, servo_faults__silent=[], board_faults__drop_in=0.0).successful
    assert node.component._devices_status()[0] == base.OK
    refused = put(node, servo_faults__silent=[9])
    assert not refused.successful and 'servo_faults: no servo has' in refused.reason
    assert node._devices.faults == []
    node.destroy_node()
    assert not os.path.lexists(servos) and not os.path.lexists(board)


def test_the_emulated_servos_are_those_of_the_bus_file(sim, tmp_path):
    file = tmp_path / 'bus.yaml'
    file.write_text('port: x\nids: [11, 12, 13, 14]\nsigns: [1, -1, 1, -1]\n'
                    'zeros: [2000, 2100, 2048, 1900]\n')
    servos = sim(f'servo_bus_file:={file}')._devices.bus.servos
    assert [servo['ID'] for servo in servos] == [11, 12, 13, 14]
    assert [servo.sign for servo in servos] == [1, -1, 1, -1]
    assert [servo.zero for servo in servos] == [2000, 2100, 2048, 1900]
