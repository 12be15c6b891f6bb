"""sim_node with emulated actuators: ports instead of topics, faults in flight."""

import os
from pathlib import Path
import stat
import time

import numpy as np
import pytest
import rclpy
from rclpy.parameter import Parameter

from beetle_omni_ros.nodes import health
from beetle_omni_ros.nodes.sim_node import SimNode
from beetle_omni_ros.robot.schema import ParameterError


@pytest.fixture
def make(ros_domain, tmp_path):
    """Make a sim_node with parameters."""
    nodes = []

    def build(*overrides, actuators='emulated'):
        given = [f'actuators:={actuators}', *overrides]
        arguments = [a for override in given for a in ('-p', override)]
        rclpy.init(args=['--ros-args', *arguments], domain_id=ros_domain)
        nodes.append(SimNode())
        return nodes[0]

    yield build
    for node in nodes:
        node.destroy_node()
    rclpy.try_shutdown()


def put(node, **values):
    """Set parameters one after the other like `ros2 param set`; return the last answer."""
    for name, value in values.items():
        answer = node.set_parameters([Parameter(name.replace('__', '.'), value=value)])[0]
    return answer


def topics(node):
    """Topics that a node publishes and subscribes."""
    return ({one.topic_name for one in node.publishers},
            {one.topic_name for one in node.subscriptions})


def test_commands_and_joint_states_pass_through_the_ports_instead_of_topics(make):
    published, subscribed = topics(make())
    assert '/imu/data_raw' in published and '/disturbance' in subscribed
    assert not {'/joint_states', '/battery_state'} & published and '/command' not in subscribed


def test_the_direct_path_is_unchanged(make):
    node = make(actuators='direct')
    published, subscribed = topics(node)
    assert {'/joint_states', '/battery_state'} <= published and '/command' in subscribed
    refused = put(node, servo_faults__silent=[2])
    assert not refused.successful and 'servo_faults: silent [2]: there are no' in refused.reason
    assert not put(node, board_faults__hang=True).successful


def test_faults_are_switched_in_flight_and_reported(make):
    node = make('faults:="mocap_lost"', actuators='direct')
    assert node._robot_status()[0] == health.OK
    node._simulator.step()
    level, text, values = node._robot_status()
    assert level == health.WARN and text == 'mocap_lost' and values['broken'] == 0
    assert put(node, faults='mocap_lost; rotor_stops rotor=2').successful
    node._simulator.step()
    assert node._simulator.faults == ['mocap_lost', 'rotor_stops']
    for text, named in (('rotor_stops', "'rotor' is missing"), ('wings', 'rotor_stops'),
                        ('controller_nan', 'affects a process')):
        answer = put(node, faults=text)
        assert not answer.successful and named in answer.reason
    assert node._simulator.faults == ['mocap_lost', 'rotor_stops']
    assert put(node, faults='').successful
    assert node._simulator.faults == []


def test_faults_of_device_measurements_are_refused_with_emulated_devices(make):
    node = make()
    assert put(node, faults='gyroscope_bias x=0.1; rotor_stops rotor=1').successful
    for text in ('joints_lost', 'battery_unread', 'commands_lost'):
        answer = put(node, faults=text)
        assert not answer.successful and 'servo_faults' in answer.reason


def test_the_simulator_publishes_simulated_time_only_without_serial_devices(make):
    node = make('clock:=simulated', actuators='direct')
    assert '/clock' in topics(node)[0] and '/odom' in topics(node)[1]
    before = node.now()
    ticks = [node._on_timer() or node.now() for _ in range(10)]
    assert np.allclose(np.diff([before, *ticks]), 0.005, rtol=0, atol=1e-6)


def test_simulated_time_is_refused_with_serial_devices(make):
    with pytest.raises(ParameterError, match=r"key 'clock': simulated: serial devices keep real"):
        make('clock:=simulated')


def test_ports_have_the_requested_names_and_end_with_the_node(make, tmp_path):
    servos, board = tmp_path / 'servos', tmp_path / 'board'
    servos.symlink_to('/nowhere')           # left by a process that was killed
    node = make(f'servo_port:={servos}', f'board_port:={board}')
    for port in (servos, board):
        assert stat.S_ISCHR(os.stat(port).st_mode)
    node.destroy_node()
    assert not os.path.lexists(servos) and not os.path.lexists(board)


def test_an_existing_path_is_refused_and_unchanged(make, tmp_path):
    servos, taken = tmp_path / 'servos', tmp_path / 'notes.txt'
    taken.write_text('keep')
    with pytest.raises(OSError, match=r'notes.txt: cannot be used as a port, it exists'):
        make(f'servo_port:={servos}', f'board_port:={taken}')
    assert taken.read_text() == 'keep' and not os.path.lexists(servos)


def test_faults_change_in_flight_and_are_in_the_diagnostics(make):
    node = make()
    devices = node._devices
    assert node._devices_status()[0] == health.OK
    assert put(node, servo_faults__silent=[2], board_faults__voltage_sag=1.5).successful
    assert set(devices.bus.faults.silent) == {2} and devices.board.faults.voltage_sag == 1.5
    level, text, values = node._devices_status()
    assert level == health.WARN and text == 'faults: servo silent [2], board voltage_sag 1.5'
    assert values['armed'] is False and values['torque'] == [False] * 4
    assert put(node, servo_faults__silent=[], board_faults__voltage_sag=0.0).successful
    assert not len(devices.bus.faults.silent) and node._devices_status()[0] == health.OK
    assert put(node, board_faults__failed_escs=[1, 4]).successful
    assert tuple(devices.board.faults.failed_escs) == (1, 4)


def test_unusable_faults_are_refused_with_their_key(make):
    node = make()
    for name, value, text in (('servo_faults__silent', [9], 'servo_faults.silent: no servo has'),
                              ('servo_faults__dropped', 1.5, 'servo_faults.dropped'),
                              ('servo_faults__reboot', 7, 'servo_faults.reboot: no servo has'),
                              ('board_faults__failed_escs', [5], '5 is outside 1 to 4')):
        refused = put(node, **{name: value})
        assert not refused.successful and text in refused.reason
    assert node._devices.faults == []


def test_an_event_happens_each_time_it_is_set_and_resets_itself(make):
    node = make()
    bus = node._devices.bus
    for _ in range(2):
        bus.servos[1]['Torque Enable'] = 1
        assert put(node, servo_faults__reboot=2).successful
        assert not bus.servos[1].torque
        assert node.get_parameter('servo_faults.reboot').value == 0
    bus.servos[1]['Torque Enable'] = 1
    assert put(node, servo_faults__dropped=0.5, board_faults__reboot=True).successful
    assert bus.servos[1].torque
    assert node.get_parameter('board_faults.reboot').value is False


def test_faults_can_be_active_from_the_start(make):
    node = make('servo_faults.overheated:=[3, 4]', 'board_faults.unplugged:=true')
    assert set(node._devices.bus.faults.overheated) == {3, 4}
    assert not Path(node._devices.board.port).exists()
    assert put(node, board_faults__unplugged=False).successful
    assert Path(node._devices.board.port).exists()


def test_unknown_faults_at_the_start_end_the_node_with_one_line(make):
    with pytest.raises(ParameterError, match='servo_faults.silent: no servo has the id 8'):
        make('servo_faults.silent:=[8]')


def test_the_emulated_servos_are_those_of_the_bus_file(make, tmp_path):
    file = tmp_path / 'bus.yaml'
    file.write_text('port: x\nids: [11, 12, 13, 14]\nsigns: [1, -1, 1, -1]\n'
                    'zeros: [2000, 2100, 2048, 1900]\nbaud_rate: 3000000\n'
                    'torque_per_current: 0.671\n')
    servos = make(f'servo_bus_file:={file}')._devices.bus.servos
    assert [servo['ID'] for servo in servos] == [11, 12, 13, 14]
    assert [servo.sign for servo in servos] == [1, -1, 1, -1]
    assert [servo.zero for servo in servos] == [2000, 2100, 2048, 1900]
    assert {servo.baud_rate for servo in servos} == {3_000_000}


def test_a_driver_finds_the_servos_and_moves_the_plant(make):
    pytest.importorskip('dynamixel_sdk')
    from dataclasses import replace

    from servo_bench import PATIENT, SHIPPED

    from beetle_omni_ros.drivers.servo_bus import ServoBus
    from beetle_omni_ros.robot.parameters import RobotParameters
    node = make()
    bus = ServoBus(replace(SHIPPED, port=node._devices.bus.port, guard=False, timing=PATIENT),
                   RobotParameters.load().joints)
    bus.open()
    try:
        bus.configure()
        bus.enable()
        end = time.monotonic() + 3.0
        goal = np.array([0.3, -0.3, 0.2, -0.2])
        while time.monotonic() < end and not np.allclose(bus.read().position, goal, atol=0.05):
            bus.write_goals(goal)
            node._on_timer()
            time.sleep(0.002)
        np.testing.assert_allclose(node._simulator.truth.tilt, goal, atol=0.06)
        assert node._devices_status()[2]['torque'] == [True] * 4
    finally:
        bus.close()
