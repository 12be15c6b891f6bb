"""rotor_bridge_node as a process with the emulated motor board and its faults."""

import math
import os
import signal
import time

import numpy as np
import pytest

pytest.importorskip('pymavlink')
pytest.importorskip('serial')

from lifecycle_msgs.msg import Transition
from rotor_bench import bench, HOVER, NODE, QUICK, SOON, START

from beetle_omni_ros.nodes import wire
from beetle_omni_ros.nodes.graph import Graph
from beetle_omni_ros.nodes.operator import Operator

pytestmark = pytest.mark.real_time


@pytest.fixture(scope='module')
def shared(tmp_path_factory):
    """One process for all tests that do not end it."""
    with bench(tmp_path_factory.mktemp('bridge')) as made:
        assert made.commander.reaches('ready', START), made.log
        yield made


@pytest.fixture
def bridge(shared):
    """Process and board at rest, without faults."""
    assert shared.rest(), (shared.commander.bridge_states, shared.log)
    shared.commander.bridge_states[:-1] = []
    yield shared
    assert not shared.graph.dead()


@pytest.fixture
def flying(bridge):
    """The same with turning rotors."""
    bridge.take_off()
    return bridge


def test_the_bridge_arms_at_takeoff_follows_thrusts_and_disarms_with_the_supervisor(bridge):
    board, commander = bridge.board, bridge.commander
    commander.thrust = np.zeros(4)
    commander.spin(0.2)
    assert not board.armed and not board.refused      # nothing is sent before it is armed
    bridge.take_off()
    for state, thrust in (('flying:nmpc', [3.0, 12.0, 0.5, 20.0]), ('landing', [9, 9, 1, 0])):
        commander.supervise(state)
        commander.thrust = np.array(thrust, dtype=float)
        assert commander.wait(lambda thrust=thrust: bridge.follows(thrust), SOON)
    commander.supervise('disarmed')
    assert commander.wait(lambda: not board.armed, SOON) and not board.commands.any()
    assert commander.wait(lambda: 'waiting: throttle not low' in commander.bridge_states
                          and commander.bridge == 'ready', SOON), commander.bridge_states
    assert not any(text.startswith('lost') for text in commander.bridge_states)


def test_thrusts_are_produced_with_a_sagging_battery(flying):
    board, commander = flying.board, flying.commander
    board.set_battery(22.7, 40.0)
    assert commander.wait(lambda: flying.follows(), SOON)
    assert commander.wait_for_diagnostics('board', 'voltage_V', lambda v: v == '22.7')
    commander.thrust = np.array([7.0, 7.0, 7.0, 22.0])
    assert commander.wait_for_diagnostics('rotor4', 'saturated', lambda n: n and int(n) > 0)
    assert commander.values(f'{NODE}: rotor1')['saturated'] == '0'


def test_an_emergency_stop_disarms(flying):
    flying.commander.supervise('emergency_stop')
    assert flying.commander.wait(lambda: not flying.board.armed, SOON)
    assert flying.board._firmware._stop_reason == 1     # requested by the host


def test_a_low_battery_refuses_arming_with_the_reason(bridge):
    board, commander = bridge.board, bridge.commander
    board.set_battery(20.0, 0.0)
    assert commander.reaches('waiting: battery low')
    commander.supervise('takeoff')
    assert commander.reaches('lost: not armed: refused by the board: battery low')
    board.set_battery(25.0, 0.0)
    commander.thrust = HOVER
    commander.spin(0.3)
    assert not board.armed and not board.commands.any()


def test_commands_are_repeated_and_the_rotors_stop_with_the_stream(flying):
    board, commander = flying.board, flying.commander
    commander.period = 0.06
    arrivals = []
    board.on_target = lambda now, values: arrivals.append((now, values[0]))
    assert commander.wait(lambda: len(arrivals) > 60, SOON)
    stamps = [stamp for _, stamp in arrivals]
    assert stamps == sorted(stamps) and len(stamps) > 3 * len(set(stamps))
    commander.thrust = None
    # 100 ms after the last new target, however often it was repeated.
    assert commander.wait(lambda: not board.commands.any(), SOON)
    newest = next(now for now, stamp in arrivals if stamp == arrivals[-1][1])
    assert board._firmware.timeouts and board._firmware._target_at == newest
    commander.spin(0.2)
    count = len(arrivals)
    commander.spin(0.2)
    assert len(arrivals) == count and commander.bridge == 'ready'
    commander.thrust = HOVER
    assert commander.wait(lambda: flying.follows(), SOON)


def test_old_commands_are_not_sent(flying):
    board, commander = flying.board, flying.commander
    commander.age, arrivals = 0.2, []
    assert commander.wait(lambda: not board.commands.any(), SOON)
    commander.spin(0.2)
    board.on_target = lambda now, values: arrivals.append(values)
    commander.spin(0.2)
    assert not arrivals and not board.commands.any()
    assert commander.wait_for_diagnostics('inputs', 'command rejected: stale stamp',
                                          lambda n: n and int(n) > 5)


def test_a_missing_stream_disarms_for_the_rest_of_the_flight(flying):
    board, commander = flying.board, flying.commander
    commander.thrust = None
    assert commander.reaches('lost: disarmed (no target for too long)')
    commander.thrust = HOVER
    commander.spin(0.3)
    assert not board.armed


@pytest.mark.parametrize(('fault', 'why'), [
    (lambda board: board.reboot(), 'lost: restarted'),
    (lambda board: board.hang(), 'lost: restarted (watchdog reset)'),
    (lambda board: board.unplug(), 'lost: {port}: port is away')])
def test_a_lost_board_stays_disarmed_until_the_supervisor_is_disarmed(flying, fault, why):
    board, commander = flying.board, flying.commander
    fault(board)
    assert commander.reaches(why.format(port=board.port)), commander.bridge_states
    assert commander.wait(lambda: not board.armed and not board.commands.any(), SOON)
    board.plug()
    commander.spin(0.3)         # the supervisor continues, and the board could be armed again
    assert commander.bridge.startswith('lost') and not board.armed
    commander.supervise('emergency_stop')
    commander.spin(0.1)
    assert commander.bridge.startswith('lost')
    commander.thrust = None
    commander.supervise('disarmed')
    assert commander.reaches('ready'), commander.bridge_states
    flying.take_off()


def test_targets_are_sent_to_a_silent_board_until_the_supervisor_has_landed(flying):
    board, commander = flying.board, flying.commander
    board.faults.mute = True
    assert commander.reaches('silent: no message from the board'), commander.bridge_states
    commander.spin(0.3)
    assert board.armed and board.commands.all()
    commander.thrust = None
    commander.supervise('disarmed')
    assert commander.wait(lambda: not board.armed, SOON)
    board.faults.mute = False
    assert commander.reaches('ready'), commander.bridge_states


@pytest.mark.parametrize('faults', [
    {'corrupt_in': 0.05, 'corrupt_out': 0.05}, {'drop_in': 0.05, 'drop_out': 0.05},
    {'delay_in': 0.01, 'delay_out': 0.01}])
def test_a_poor_link_is_tolerated(flying, faults):
    board, commander = flying.board, flying.commander
    for name, value in faults.items():
        setattr(board.faults, name, value)
    if 'corrupt_in' in faults:
        for key in ('bad_crc', 'board bad_crc'):
            assert commander.wait_for_diagnostics('board', key, lambda n: n and int(n) > 0)
    elif 'drop_in' in faults:
        for key in ('lost', 'board lost'):
            assert commander.wait_for_diagnostics('board', key, lambda n: n and int(n) > 0)
    else:
        commander.spin(0.5)
    assert board.armed and commander.wait(lambda: flying.follows(), SOON)
    assert commander.bridge_states == ['ready']


def test_battery_and_rotor_speeds_are_published_in_ros_units_and_signs(bridge):
    board, commander = bridge.board, bridge.commander
    board.set_battery(23.456, 12.34)
    board.set_rotors(np.array([1.0, 4.0, 9.0, 0.0]), np.array([30.0, 40.0, 50.0, 60.0]))
    assert commander.wait(lambda: commander.batteries and math.isclose(
        commander.batteries[-1].current, -12.34, rel_tol=1e-5), SOON)
    battery = commander.batteries[-1]
    assert battery.voltage == pytest.approx(23.456) and battery.present
    assert len(battery.cell_voltage) == 6
    speeds = np.array([2700, 5400, 8100, 0]) * math.tau / 60
    assert commander.wait(lambda: np.allclose(commander.rotors[-1].velocity, speeds), SOON)
    rotors = commander.rotors[-1]
    assert rotors.name == ['rotor1', 'rotor2', 'rotor3', 'rotor4']
    assert not len(rotors.position) and not len(rotors.effort)
    for message in (battery, rotors):
        stamp = message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec
        assert -SOON < stamp - time.time() <= 0.001
    before = len(commander.batteries), len(commander.rotors)
    assert commander.wait(lambda: len(commander.batteries) > before[0] + 10
                          and len(commander.rotors) > before[1] + 20, SOON)
    board._thrust = None        # rotors follow at once again


def test_diagnostics_contain_link_clock_latency_and_a_failed_esc(flying):
    board, commander = flying.board, flying.commander
    board.faults.failed_escs = (3,)
    assert commander.wait_for_diagnostics('rotor3', 'failures', lambda text: 'offline' in text)
    assert commander.diagnostics[f'{NODE}: rotor3'].level == 2
    assert commander.diagnostics[f'{NODE}: rotor1'].level == 0
    assert commander.wait_for_diagnostics('latency', 'count', lambda n: n and int(n) > 20)
    assert commander.diagnostics[f'{NODE}: latency'].message.startswith(
        'from the publication of the command')
    assert 0 < float(commander.values(f'{NODE}: latency')['median_ms']) < 1000
    values = commander.values(f'{NODE}: board')
    assert int(values['cycles']) > 20 and float(values['clock_uncertainty_ms']) < 1000
    assert values['armed'] == '1' and 'ESC failure' in values['conditions']
    assert commander.bridge == 'ready' and board.armed


def test_after_a_killed_bridge_no_rotor_turns_and_a_new_one_does_not_arm(tmp_path):
    with bench(tmp_path) as made:
        board, commander = made.board, made.commander
        assert commander.reaches('ready', START), made.log
        made.take_off()
        arrivals = []
        board.on_target = lambda now, values: arrivals.append(now)
        assert commander.wait(lambda: arrivals, SOON)
        made.graph.kill(NODE)
        looked, turning = time.monotonic(), 0.0
        while board.commands.any():
            turning, looked = looked, time.monotonic()
            time.sleep(0.001)
        # They turned at `turning` or later, also on a busy computer.
        assert turning < arrivals[-1] + QUICK.target_timeout
        assert commander.wait(lambda: not board.armed, SOON)
        commander.supervise('flying:nmpc')
        made.graph.start_process(NODE)
        assert commander.reaches('lost: the supervisor was not disarmed before', START), made.log
        assert not board.armed and not board.commands.any()


def test_a_bridge_disarms_at_its_end_and_reports_it(tmp_path):
    with bench(tmp_path) as made:
        board, commander = made.board, made.commander
        assert commander.reaches('ready', START), made.log
        made.take_off()
        process = made.graph.processes[NODE]
        os.kill(process.pid, signal.SIGTERM)
        assert commander.reaches('lost: the bridge has stopped')
        assert process.wait(SOON) == 0
        assert not board.armed and not board.commands.any()
        assert board._firmware._stop_reason == 1        # requested by the host
        assert '[ERROR]' not in made.log[0], made.log


def test_the_bridge_waits_for_a_missing_port_and_names_it(tmp_path):
    port = tmp_path / 'motor_board'
    with bench(tmp_path, port=str(port)) as made:
        commander = made.commander
        assert commander.reaches(f'waiting: {port}: cannot be opened (no such port', START)
        assert commander.wait_for_diagnostics('board', 'phase', lambda phase: phase == 'rests')
        commander.supervise('takeoff')
        # Whether 'disarmed' arrived before depends on the middleware.
        assert commander.reaches('lost: '), commander.bridge_states
        commander.supervise('disarmed')
        os.symlink(made.board.port, port)
        assert commander.reaches('ready'), (commander.bridge_states, made.log)
        made.take_off()
        assert made.log[0].count('cannot be opened') == 1


def test_supervisor_node_refuses_to_arm_with_the_reason_of_the_bridges(ros_domain, tmp_path):
    graph = Graph({'supervisor_node': {}}, tmp_path, ros_domain, composed=False)
    operator = None
    try:
        graph.start()
        operator = Operator(ros_domain)
        bridges = {name: wire.Publisher(operator._node, f'{name}_bridge/state')
                   for name in ('joint', 'rotor')}
        assert operator.wait(lambda: operator.state == 'disarmed', START), graph.dead()
        for name, text, answer in (
                ('rotor', 'waiting: battery low', 'rotor_bridge_node waiting: battery low'),
                ('joint', 'lost: gimbal3 silent', 'joint_bridge_node lost: gimbal3 silent; '
                                                  'rotor_bridge_node waiting: battery low'),
                ('rotor', 'ready', 'joint_bridge_node lost: gimbal3 silent')):
            bridges[name].publish(text)
            assert operator.wait(lambda answer=answer: operator.call('arm') == (
                False, f'arm refused: {answer}'), SOON), operator.call('arm')
        bridges['joint'].publish('ready')
        assert operator.wait(lambda: 'no fresh state estimate' in operator.call('arm')[1], SOON)
    finally:
        graph.stop()
        if operator:
            operator.close()


CONFIGURE, ACTIVATE, DEACTIVATE, CLEAN_UP = (
    Transition(id=number) for number in (
        Transition.TRANSITION_CONFIGURE, Transition.TRANSITION_ACTIVATE,
        Transition.TRANSITION_DEACTIVATE, Transition.TRANSITION_CLEANUP))


def test_without_autostart_it_arms_only_after_it_was_configured_and_activated(tmp_path):
    with bench(tmp_path, autostart='none') as bridge:
        board, commander = bridge.board, bridge.commander
        assert commander.reaches('waiting: not configured', START), bridge.log
        assert not commander.batteries and not commander.change(ACTIVATE)
        assert commander.change(CONFIGURE)
        assert commander.reaches('waiting: not activated')
        assert commander.wait(lambda: commander.batteries, SOON)       # received, but not armed
        commander.supervise('takeoff')
        assert commander.reaches('lost: not activated')
        commander.supervise('disarmed')
        assert commander.reaches('waiting: not activated') and not board.armed
        assert commander.change(ACTIVATE)
        bridge.take_off()
        assert commander.change(DEACTIVATE)                             # in flight
        assert commander.wait(lambda: not board.armed, SOON)
        assert commander.reaches('lost: not activated')
        assert commander.change(ACTIVATE)
        commander.spin(0.3)
        assert not board.armed                                          # not in this flight
        commander.supervise('disarmed')
        assert commander.reaches('ready')
        assert commander.change(DEACTIVATE) and commander.change(CLEAN_UP)
        assert commander.reaches('waiting: not configured')
        received = len(commander.batteries)
        commander.spin(0.5)
        assert len(commander.batteries) <= received + 1
        assert commander.change(CONFIGURE) and commander.change(ACTIVATE)
        bridge.take_off()                                               # the port opens again
