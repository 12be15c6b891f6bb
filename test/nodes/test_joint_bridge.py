"""joint_bridge_node as a process with emulated servos; test/drivers has the faults of the bus."""


from bridge_bench import COUNT, JOINT, running_bridge
import pytest

from beetle_omni_ros.sim.emulated.servo_bus import EmulatedServoBus

pytestmark = pytest.mark.real_time

GOAL, HOME = [0.5, -1.0, 3.5, -3.5], [0.0] * 4


@pytest.fixture(scope='module')
def shared(tmp_path_factory):
    """One process and one bus for all tests that do not break them."""
    folder = tmp_path_factory.mktemp('joint_bridge')
    with EmulatedServoBus(speed=10.0, reboot_time=0.05) as emulated, \
            running_bridge(folder, JOINT, port=emulated.port) as (graph, operator):
        yield emulated, operator
        assert not graph.dead()
        graph.stop()
        assert not emulated.torque_enabled.any()


@pytest.fixture
def bench(shared):
    yield shared
    shared[1].tilt, shared[1].age = None, 0.0


@pytest.fixture
def active(bench):
    emulated, operator = bench
    operator.go_to('active')
    operator.tilt = HOME
    operator.until(lambda: operator.now == 'ready' and emulated.torque_enabled.all()
                   and operator.stands_at(HOME), 'not active')
    return bench


def test_transitions_switch_port_and_torque(bench):
    emulated, operator = bench
    operator.go_to('unconfigured')
    assert operator.ask('reboot').message == 'not configured'
    operator.go_to('inactive')
    operator.reaches('waiting: no torque, not activated')
    assert not emulated.torque_enabled.any()
    operator.go_to('active')
    operator.reaches('ready')
    assert emulated.torque_enabled.all()
    assert operator.change('deactivate') and not emulated.torque_enabled.any()
    operator.reaches('lost: no torque, deactivated')


def test_a_command_moves_the_joints_and_its_latency_is_reported(active):
    emulated, operator = active
    operator.tilt = GOAL
    operator.until(lambda: operator.stands_at(GOAL), 'does not move')
    assert emulated.goals == pytest.approx(GOAL, abs=COUNT)
    operator.counts('latency', 'count', above=10)
    servo = operator.status('gimbal2').values
    assert servo['id'] == '2' and servo['errors'] == 'none' and servo['torque'] == 'True'
    operator.age, operator.tilt = 0.3, HOME
    operator.counts('inputs', 'command rejected: stale stamp')


def test_a_composed_bridge_waits_for_its_port_and_reports_why(tmp_path):
    port = tmp_path / 'servo_bus'
    with running_bridge(tmp_path, JOINT, ['ekf_node'], port=str(port), autostart='activate') \
            as (graph, operator):
        operator.until(lambda: f'waiting: {port}: cannot be opened (no such' in operator.now)
        with EmulatedServoBus(port=str(port)) as emulated:
            emulated.faults.silent = {2}
            operator.until(lambda: 'gimbal2 (id 2): does not answer' in operator.now)
            emulated.faults.silent = set()
            operator.reaches('ready')
            assert emulated.torque_enabled.all()
            graph.stop()
            assert not emulated.torque_enabled.any()
        log = graph.log(JOINT).read_text()
        assert log.count('no such port') <= 2, 'an attempt a second, but not a line'
        assert 'Traceback' not in log
