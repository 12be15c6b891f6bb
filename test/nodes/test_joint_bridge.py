"""joint_bridge_node as a process with emulated servos and faults of the bus."""

import signal
import time

import numpy as np
import pytest
from servo_witness import COUNT, joint_bridge, NODE, WITHIN

from beetle_omni_ros.messages import conversions
from beetle_omni_ros.messages.values import MessageError
from beetle_omni_ros.robot.parameters import JOINT_NAMES, RobotParameters
from beetle_omni_ros.sim.emulated.fault_switches import ServoFaults
from beetle_omni_ros.sim.emulated.servo_bus import EmulatedServoBus

pytestmark = pytest.mark.real_time

JOINTS = RobotParameters.load().joints
GOAL = [0.5, -1.0, 3.5, -3.5]
HOME = [0.0] * 4
ERROR = 2


@pytest.fixture(scope='module')
def shared(tmp_path_factory):
    """One process and one bus for all tests that do not break them."""
    folder = tmp_path_factory.mktemp('joint_bridge')
    with EmulatedServoBus(motion=JOINTS, reboot_time=0.05) as emulated, \
            joint_bridge(folder, port=emulated.port) as (graph, witness):
        yield emulated, graph, witness
        assert not graph.dead()
        graph.stop()
        assert not emulated.torque_enabled.any()


@pytest.fixture
def bench(shared):
    """Return bus and witness, without faults and without goals."""
    emulated, graph, witness = shared
    emulated.faults = ServoFaults()
    witness.goal, witness.age = None, 0.0
    yield emulated, witness
    emulated.faults = ServoFaults()
    witness.goal, witness.age = None, 0.0
    assert not graph.dead()


@pytest.fixture
def active(bench):
    """Return the same with torque on, all servos ready and following a goal."""
    emulated, witness = bench
    witness.go_to('active')
    witness.goal = HOME
    witness.until(lambda: witness.now == 'ready' and witness.stands_at(HOME), 'not ready')
    return bench


def torque_is_back(emulated, witness, goal):
    """Whether the state is that before the fault."""
    return witness.now == 'ready' and emulated.torque_enabled.all() and witness.stands_at(goal)


# --- lifecycle --------------------------------------------------------------------------------

def test_transitions_switch_port_and_torque(bench):
    emulated, witness = bench
    witness.go_to('unconfigured')
    assert not witness.change('activate'), 'impossible, and survived'
    assert witness.stage == 'unconfigured'
    assert witness.trigger('reboot') == (False, 'not configured')
    witness.go_to('inactive')
    witness.until(lambda: witness.now == 'waiting: no torque, not activated')
    assert not emulated.torque_enabled.any()
    assert [servo['Velocity I Gain'] for servo in emulated.servos] == [1201] * 4
    witness.go_to('active')
    assert emulated.torque_enabled.all()
    witness.until(lambda: witness.now == 'ready')
    assert witness.change('deactivate') and not emulated.torque_enabled.any()
    witness.until(lambda: witness.now == 'lost: no torque, deactivated')
    assert witness.change('cleanup') and witness.stage == 'unconfigured'
    count = len(witness.joints)
    witness.spin(0.3)
    assert len(witness.joints) <= count + 10, 'the port is closed'


def test_angles_come_at_200_hz_with_the_time_of_their_reading(bench):
    emulated, witness = bench
    witness.go_to('inactive')
    truth = np.array([0.1, -0.2, 0.3, 2.0])
    emulated.set_state(truth, np.zeros(4), np.zeros(4))
    witness.until(lambda: witness.stands_at(truth), 'other angles')
    witness.joints.clear()
    witness.arrivals.clear()
    first, began = witness.numbers('bus'), time.monotonic()
    received = len(witness.joints)
    witness.spin(1.5)
    last, seconds = witness.numbers('bus'), time.monotonic() - began
    received = len(witness.joints) - received
    cycles, missed, torn = (int(last[key]) - int(first[key])
                            for key in ('cycles', 'missed_cycles', 'incomplete'))
    assert cycles + missed == pytest.approx(200 * seconds, rel=0.25)
    # With best effort, a busy reader loses some.
    assert 0.5 * cycles < received <= cycles + 60
    stamps = np.array([conversions.seconds(message.header.stamp) for message in witness.joints])
    assert (np.diff(stamps) > 0).all()
    assert (stamps < witness.arrivals).all() and (stamps > np.array(witness.arrivals) - 1).all()
    whole = [message for message in witness.joints if list(message.name) == list(JOINT_NAMES)]
    assert len(whole) >= len(witness.joints) - torn - 1
    assert all(len(message.velocity) == len(message.effort) == 4 for message in whole)


def test_a_command_moves_the_joints_and_its_latency_is_reported(active):
    emulated, witness = active
    witness.goal = GOAL
    witness.until(lambda: witness.stands_at(GOAL), 'does not move')
    assert emulated.goals == pytest.approx(GOAL, abs=COUNT)
    latency = witness.numbers('latency')
    assert int(latency['count']) > 10 and 0 < float(latency['median_ms']) < 1000
    assert 'publication' in witness.diagnostics[f'{NODE}: latency'].message
    servo = witness.numbers('gimbal2')
    assert servo['id'] == '2' and servo['errors'] == 'none' and servo['torque'] == 'True'
    assert float(servo['voltage_v']) == 12.0 and float(servo['temperature_c']) > 20
    # Without torque nothing moves, but the command is received.
    witness.go_to('inactive')
    witness.goal = HOME
    witness.spin(0.3)
    assert witness.stands_at(GOAL)


def test_stale_commands_are_not_written(active):
    emulated, witness = active
    witness.age = 0.3
    witness.goal = GOAL
    refused = 'command rejected: stale stamp'
    witness.until(lambda: int(witness.numbers('inputs').get(refused, 0)) > 0, 'not refused')
    assert emulated.goals == pytest.approx(HOME, abs=COUNT)
    witness.age = 0.0
    witness.until(lambda: witness.stands_at(GOAL), 'not taken up again')


def test_an_ambiguous_turn_is_refused_in_one_line_until_the_operator_confirms_one(bench):
    emulated, witness = bench
    witness.go_to('unconfigured')
    emulated.set_state([0, 3.0, 0, 0], np.zeros(4), np.zeros(4))
    witness.go_to('inactive')
    doubt = 'gimbal2 (id 2) stands at -3.28 or +3.00 rad'
    witness.until(lambda: not witness.change('activate') and doubt in witness.now)
    assert witness.stage == 'inactive' and not emulated.torque_enabled.any()
    assert witness.now.startswith('waiting: ') and '\n' not in witness.now
    witness.set(confirmed_tilts=[0.0, 3.3, 0.0, 0.0], confirm_tilts=True)
    witness.go_to('active')
    witness.until(lambda: witness.stands_at([0, 3.0, 0, 0]), 'another turn')
    witness.set(confirm_tilts=False)


# --- faults -----------------------------------------------------------------------------------

def test_a_silent_servo_leaves_joint_states_incomplete_and_is_named(active):
    emulated, witness = active
    emulated.faults.silent = {3}
    witness.until(lambda: witness.now.startswith('lost: '), 'not noticed')
    assert 'gimbal3' in witness.now and 'silent; check its cable and power' in witness.now
    witness.until(lambda: list(witness.joints[-1].name) == ['gimbal1', 'gimbal2', 'gimbal4'])
    assert witness.level('bus')[0] == ERROR and witness.level('gimbal3')[0] == ERROR
    with pytest.raises(MessageError, match='gimbal3'):
        conversions.take_joints(witness.joints[-1])
    emulated.faults.silent = set()
    witness.until(lambda: torque_is_back(emulated, witness, HOME), 'not back')


def test_an_unplugged_cable_is_reported_lost_until_it_is_back(active):
    emulated, witness = active
    emulated.unplug()
    witness.until(lambda: witness.now == f'lost: {emulated.port}: no connection')
    witness.joints.clear()
    witness.spin(0.2)
    assert not witness.joints, 'nothing is made up'
    emulated.replug()
    witness.until(lambda: witness.joints and torque_is_back(emulated, witness, HOME), 'not back')
    assert int(witness.numbers('bus')['connections']) >= 2


@pytest.mark.parametrize('fault', ['bad_crc', 'dropped'])
def test_a_bad_line_does_not_stop_the_bridge(active, fault):
    emulated, witness = active
    before = witness.numbers('bus')
    setattr(emulated.faults, fault, 0.1)
    key = {'bad_crc': 'corrupt', 'dropped': 'unanswered'}[fault]
    witness.goal = GOAL
    witness.until(lambda: int(witness.numbers('bus')[key]) > int(before[key]) + 3, 'no fault')
    witness.until(lambda: witness.stands_at(GOAL), 'does not move')
    assert emulated.torque_enabled.all() and not witness.now.startswith('waiting')
    setattr(emulated.faults, fault, 0.0)
    witness.until(lambda: torque_is_back(emulated, witness, GOAL), 'not ready')


def test_an_expired_watchdog_is_cleared_in_flight(active):
    emulated, witness = active
    emulated.expire_watchdog(1)
    witness.goal = GOAL
    witness.until(lambda: not emulated.stopped.any() and witness.stands_at(GOAL), 'stopped')


def test_a_servo_that_shuts_down_by_overload_is_restarted_with_torque(active):
    emulated, witness = active
    witness.goal = GOAL
    witness.until(lambda: witness.stands_at(GOAL))
    emulated.faults.overload = {3}
    witness.until(lambda: not emulated.torque_enabled[2], 'no shutdown')
    emulated.faults.overload = set()
    witness.until(lambda: torque_is_back(emulated, witness, GOAL), 'not back')


def test_an_overheated_servo_is_lost_until_it_is_rebooted(active):
    emulated, witness = active
    emulated.faults.overheated = {4}
    witness.until(lambda: 'lost: gimbal4' in witness.now and 'shut down (overheated)'
                  in witness.now, 'not noticed')
    witness.until(lambda: witness.numbers('gimbal4')['errors'] == 'overheated')
    assert emulated.torque_enabled.tolist() == [True, True, True, False]
    emulated.faults.overheated = set()
    witness.spin(0.3)
    assert not emulated.torque_enabled[3], 'no torque was requested'
    assert witness.trigger('reboot') == (True, 'restarting gimbal4')
    witness.until(lambda: torque_is_back(emulated, witness, HOME), 'not back')


def test_a_servo_can_be_rebooted_with_and_without_torque(shared, active):
    emulated, witness = active
    assert witness.trigger('reboot_gimbal2') == (True, 'restarting gimbal2')
    witness.until(lambda: not emulated.torque_enabled[1], 'not restarted')
    witness.until(lambda: torque_is_back(emulated, witness, HOME), 'not back')
    witness.go_to('inactive')
    log = shared[1].log(NODE)
    before = log.read_text().count('is back, without torque')
    assert witness.trigger('reboot')[1] == f"restarting {', '.join(JOINT_NAMES)}"
    witness.until(lambda: log.read_text().count('is back, without torque') == before + 4)
    assert not emulated.torque_enabled.any()
    witness.go_to('active')


# --- the process ------------------------------------------------------------------------------

@pytest.mark.parametrize('how', [signal.SIGKILL, signal.SIGTERM])
def test_the_torque_is_off_after_the_process_has_ended(tmp_path, how):
    with EmulatedServoBus() as emulated:
        with joint_bridge(tmp_path, port=emulated.port, autostart='activate') as (graph, witness):
            witness.until(lambda: witness.now == 'ready')
            assert emulated.torque_enabled.all()
            process = graph.processes[NODE]
            process.send_signal(how)
            assert process.wait(WITHIN) == (-how if how == signal.SIGKILL else 0)
            end = time.monotonic() + WITHIN
            while emulated.torque_enabled.any():
                assert time.monotonic() < end, 'torque is left'
                time.sleep(0.01)
        assert 'Traceback' not in graph.log(NODE).read_text()


def test_a_composed_bridge_waits_for_its_port_and_reports_why(tmp_path):
    port = tmp_path / 'servo_bus'
    with joint_bridge(tmp_path, ['ekf_node'], port=str(port), autostart='activate') \
            as (graph, witness):
        witness.until(lambda: f'waiting: {port}: cannot be opened (no such port' in witness.now)
        with EmulatedServoBus(port=str(port)) as emulated:
            emulated.faults.silent = {2}
            witness.until(lambda: 'waiting: ' in witness.now and 'gimbal2 (id 2): does not answer'
                          in witness.now)
            emulated.faults.silent = set()
            witness.until(lambda: witness.now == 'ready')
            assert emulated.torque_enabled.all()
            graph.stop()
            assert not emulated.torque_enabled.any()
        log = graph.log('composed').read_text()
        assert log.count('no such port') <= 2, 'an attempt a second, but not a line'
        assert 'Traceback' not in log
