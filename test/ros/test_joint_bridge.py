"""joint_bridge_node as a process with emulated servos; test/drivers has the faults of the bus."""

from bridge_bench import COUNT, JOINT, running_bridge, WITHIN
import pytest

from beetle_omni_ros.drivers.servo_guard import HOLD
from beetle_omni_ros.sim.emulated.servo_bus import EmulatedServoBus

pytestmark = pytest.mark.real_time

GOAL = [0.5, -1.0, 3.5, -3.5]


def test_transitions_switch_port_and_torque_and_commands_move_the_joints(tmp_path):
    with EmulatedServoBus(speed=10.0, reboot_time=0.05) as emulated, \
            running_bridge(tmp_path, JOINT, port=emulated.port) as (graph, operator):
        assert operator.ask('reboot').message == 'not configured'
        operator.go_to('inactive')
        operator.reaches('waiting: no torque, not activated')
        assert not any(emulated.drive()[1])
        operator.go_to('active')
        operator.reaches('ready')
        assert all(emulated.drive()[1])
        operator.tilt = GOAL
        operator.until(lambda: operator.stands_at(GOAL), 'does not move')
        assert emulated.drive()[0] == pytest.approx(GOAL, abs=COUNT)
        operator.counts('latency', 'count', above=10)
        servo = operator.status('gimbal2').values
        assert servo['id'] == '2' and servo['errors'] == 'none' and servo['torque'] == 'True'
        operator.age = 0.3
        operator.counts('inputs', 'command rejected: stale stamp')
        assert operator.change('deactivate') and not any(emulated.drive()[1])
        operator.reaches('lost: no torque, deactivated')
        assert operator.change('activate') and not graph.dead()
        graph.stop()
        assert not any(emulated.drive()[1])


def test_a_composed_bridge_waits_for_its_port_and_its_servos_lose_torque_after_it_is_killed(
        tmp_path):
    port = tmp_path / 'servo_bus'
    with running_bridge(tmp_path, JOINT, ['ekf_node'], port=str(port), autostart='activate') \
            as (graph, operator):
        operator.until(lambda: f'waiting: {port}: cannot be opened (no such' in operator.now)
        with EmulatedServoBus(port=str(port)) as emulated:
            emulated.faults.silent = {2}
            operator.until(lambda: 'gimbal2 (id 2): does not answer' in operator.now)
            emulated.faults.silent = set()
            operator.reaches('ready')
            assert all(emulated.drive()[1])
            graph.kill(JOINT)       # the guard holds the torque for a landing
            assert all(emulated.drive()[1])
            assert operator.wait(lambda: not any(emulated.drive()[1]), HOLD + WITHIN)
        log = graph.log(JOINT).read_text()
        assert log.count('no such port') <= 2, 'an attempt a second, but not a line'
        assert 'Traceback' not in log
