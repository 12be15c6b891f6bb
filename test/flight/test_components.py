"""Rules of the components, without a host of their own: what they accept, send and report."""

from pathlib import Path
import re

from desk import Desk
import numpy as np
import pytest
from test_controllers import Own

from beetle_omni_ros.bags.log import Recorder
from beetle_omni_ros.bags.messages import Wrench
from beetle_omni_ros.control.base import Command, PoseTarget
from beetle_omni_ros.control.hover import HoverController
from beetle_omni_ros.control.tasks import make_task
from beetle_omni_ros.estimation.parameters import EkfParameters
from beetle_omni_ros.flight import component as base
from beetle_omni_ros.flight import evaluate
from beetle_omni_ros.flight.component import (
    Component,
    component_class,
    Distribution,
    IDENTITY,
    made,
    node_name,
)
from beetle_omni_ros.flight.loop import FlightLoop
from beetle_omni_ros.flight.stack import ControllerComponent, Estimator, SupervisorComponent
from beetle_omni_ros.flight.surroundings import SimulatedRobot, TaskReference
from beetle_omni_ros.model.allocation import ActuatorHealth
from beetle_omni_ros.model.mode import COMMAND_AGE, Mode
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.model.readings import ImuReading, JointReading, PoseReading
from beetle_omni_ros.model.rotations import BodyState
from beetle_omni_ros.model.schema import ParameterError
from beetle_omni_ros.sim.simulator import Simulator
from beetle_omni_ros.supervisor.interface import SupervisorParameters

OBSERVER = f"{Path(__file__).parents[2] / 'examples' / 'own_component.py'}:WrenchObserver"
ROBOT = RobotParameters.load()
LEVEL = np.array([0.0, 0.0, 0.0, 1.0])


# --- any component ------------------------------------------------------------------------------

@pytest.fixture
def reader():
    """Desk of a component that reads 'imu/data_raw', and the list of what it accepted."""
    accepted, component = [], Component('reader_node')
    component.reads('imu/data_raw', accepted.append, max_age=0.2)
    return Desk(component, time=100.0), accepted


def imu(stamp):
    return ImuReading(stamp, np.ones(3), np.ones(3))


def test_stale_and_future_stamps_are_refused_and_counted_by_reason(reader):
    desk, accepted = reader
    for age in (0.0, 0.19, -0.04, 30.0, -1.0, 31.0):
        desk.component.feed('imu/data_raw', imu(desk.time - age))
    assert len(accepted) == 3
    assert desk.refused('imu/data_raw') == {'stale stamp': 2, 'stamp in the future': 1}
    assert len(desk.lines) == 2     # of an expected input only the first of a kind


def test_an_input_that_stops_is_an_error_and_one_that_never_came_is_not(reader):
    desk, _ = reader
    assert desk.status('inputs')[:2] == (base.OK, 'waiting for imu/data_raw')
    desk.component.feed('imu/data_raw', imu(desk.time))
    assert desk.status('inputs')[:2] == (base.OK, 'all arriving')
    desk.time += 2 * base.SILENCE
    assert desk.status('inputs')[:2] == (base.ERROR, 'imu/data_raw silent for 1.0 s')


def test_commands_are_accepted_from_the_newest_supervisor_only():
    accepted, component = [], Component('actuator_node')
    component.reads('command', accepted.append, max_age=COMMAND_AGE)
    desk = Desk(component, time=100.0)

    def taken(source):
        before = len(accepted)
        component.feed('command', Command(desk.time, np.zeros(4), np.zeros(4)), source=source)
        return len(accepted) > before

    assert taken('') and taken('anybody')       # no supervisor yet
    for own in ('supervisor_node:0123abcd', 'supervisor_node:deadbeef'):    # started again
        component.feed(IDENTITY, own)
        assert taken(own) and not taken('') and not taken('supervisor_node:00000000')
        assert f"expected '{own}'" in component.inputs['command'].last_refusal
        assert not taken('x' * 100_000) and len(component.inputs['command'].last_refusal) < 200


def test_quantiles_agree_with_sorting_within_two_percent():
    distribution = Distribution()
    assert np.isnan(distribution.quantile(0.5))
    samples = 1e-3 * np.exp(np.random.default_rng(1).normal(0, 2.0, 5000))
    for sample in samples:
        distribution.add(float(sample))
    for fraction in (0.5, 0.9, 0.99):
        assert distribution.quantile(fraction) == pytest.approx(
            np.quantile(samples, fraction), rel=0.02)
    assert distribution.max == samples.max() and distribution.count == 5000


# --- estimator ----------------------------------------------------------------------------------

def test_the_estimator_publishes_only_valid_estimates_with_positive_covariances():
    desk = Desk(Estimator(EkfParameters.load(), ROBOT))
    for k in range(400):
        desk.time, noise = 100 + 0.005 * k, 1e-6 * np.sin(k)
        if k % 2:
            desk.component.feed('mocap/pose', PoseReading(
                desk.time - 0.01, np.array([noise, 0, 0.3]), LEVEL))
        desk.component.feed('imu/data_raw', ImuReading(
            desk.time, np.array([noise, 0, 9.80665]), np.zeros(3)))
        if k == 3:
            assert not desk.sent        # too few poses for an estimate
    odom = desk.values('odom')[-1]
    assert odom.position[2] == pytest.approx(0.3, abs=0.01)
    for covariance in (odom.pose_covariance(), odom.twist_covariance()):
        assert np.linalg.eigvalsh(covariance).min() > 0


# --- controllers --------------------------------------------------------------------------------

def fly(desk, stamps):
    for desk.time in np.atleast_1d(stamps):
        desk.component.feed('odom', BodyState(desk.time, np.array([0, 0, 1.0]), np.zeros(3), LEVEL,
                                         np.zeros(3)))


def aim(desk, x, stamp, z=1.0, published=np.nan):
    desk.component.feed('target_pose', PoseTarget(np.array([x, 0, z]), LEVEL, stamp),
                        published=published)


@pytest.fixture
def follower():
    desk = Desk(ControllerComponent('nmpc', Own(), ROBOT), 99.9)
    fly(desk, 99.9 + 0.005 * np.arange(20))
    assert not desk.sent        # no joint angles yet
    desk.component.feed('joint_states', JointReading(desk.time, np.zeros(4), np.zeros(4)))
    return desk


def test_the_controller_steps_once_a_period_and_stamps_with_the_state(follower):
    health = ActuatorHealth(zeros=(0.1, 0.0, 0.0, -0.2))
    follower.component.feed('supervisor/actuators', health)
    stamps = 101 + 0.005 * np.arange(200)
    fly(follower, stamps)
    assert np.allclose(follower.stamps('nmpc/command'), stamps[::2])
    state = follower.component.controller.states[-1]
    assert state.tilt == pytest.approx(health.true(np.zeros(4)))
    fly(follower, [95.0, 95.005, 95.01])    # the clock was set back, and the new time is used
    assert len(follower.stamps('nmpc/command')) == 102


def test_the_newest_target_is_used_an_unset_stamp_means_now_and_a_landing_resets(follower):
    def target():
        fly(follower, follower.time + 1.0)
        return follower.component.controller.targets[-1]

    for stamp, x in ((50.0, 1.0), (60.0, 2.0), (50.0, 3.0)):
        aim(follower, x, stamp)
    assert target().position[0] == 2.0
    aim(follower, 4.0, 0.0)
    now = follower.time
    assert target().position[0] == 4.0 and target().stamp == now
    for mode in ('flying:nmpc', 'disarmed'):
        follower.component.feed('supervisor/state', Mode(mode))
    assert follower.component.controller.resets == 1


def test_a_bad_target_is_refused_with_its_reason_and_the_old_one_stays(follower):
    component = follower.component
    follower.simulated = False
    fly(follower, 100.0)
    aim(follower, 0.0, 100.0, published=100.0)
    first = component.target
    follower.component.feed('supervisor/state', Mode('flying:nmpc'))
    for change, expected in (
            ({'z': -5.0}, 'z = -5 m, expected at least'),
            ({'x': 12.0}, '12 m from the robot, expected at most 6.5 m'),
            ({'stamp': 1.5}, 's old, expected from -1 to 10 s'),
            ({'stamp': 200.0}, 's old, expected from -1 to 10 s')):
        aim(follower, **{'x': 0.0, 'stamp': 100.0, 'published': 100.0, **change})
        assert expected in follower.component.inputs['target_pose'].last_refusal
        assert component.target is first
    assert follower.refused('target_pose') == {'cannot be flown': 4}
    aim(follower, 0.0, 100.8, z=1.4, published=100.0)   # of a clock ahead: valid from now on
    assert component.target.position[2] == 1.4 and component.target.stamp == follower.time


def test_an_exception_of_a_controller_is_logged_once_a_second_and_reported(follower):
    def failing(state, target):
        raise ValueError('too bad')
    follower.component.controller.step = failing
    fly(follower, [101.0, 101.1])
    assert len([line for line in follower.lines if 'ValueError: too bad' in line]) == 1
    level, text, values = follower.status('controller')
    assert level == base.ERROR and 'too bad' in text and values['errors'] == '2'
    assert follower.status('controller')[0] == base.OK      # none since the last report


# --- supervisor ---------------------------------------------------------------------------------

@pytest.fixture
def supervisor():
    return Desk(SupervisorComponent(SupervisorParameters.load(), ROBOT, ('nmpc', 'rl')), 10.0)


def test_the_supervisor_signs_its_commands_and_sends_each_once(supervisor):
    identity, = supervisor.values(IDENTITY)
    assert re.fullmatch('supervisor_node:[0-9a-f]{8}', identity)
    command = Command(supervisor.time, np.zeros(4), np.zeros(4))
    supervisor.component.supervisor.update = lambda now: command
    for _ in range(3):
        supervisor.component.step()
    assert [(value, source) for topic, value, source in supervisor.sent if topic == 'command'] \
        == [(command, identity)]


# --- targets of a task --------------------------------------------------------------------------

@pytest.fixture
def reference():
    """Make the desk of a task that starts at 2000 s."""
    def build(name):
        desk = Desk(TaskReference(make_task(name), lambda mass: None), 1999.99)
        proceed(desk)
        assert len(desk.sent) == 1      # 'waiting'
        desk.component.feed('supervisor/state', Mode('flying:nmpc'))
        return desk

    return build


def proceed(desk):
    desk.time += 0.01
    desk.component.feed('command', Command(desk.time, np.zeros(4), np.zeros(4)))


def until(desk, end):
    while desk.time < end and not desk.component.state.startswith('done'):
        proceed(desk)
        yield


def test_the_reference_starts_the_task_in_flight_and_a_landing_aborts_it(reference):
    desk = reference('waypoints')
    for _ in until(desk, 2000 + 14 * 8 + 1):
        pass
    assert np.allclose(desk.stamps('target_pose'), 2000 + 8 * np.arange(15))
    assert desk.values('reference/state')[:2] == ['waiting', 'flying 1/15']
    desk.component.feed('supervisor/state', Mode('landing'))
    assert desk.component.state == 'aborted'


def test_trajectory_windows_are_parts_of_the_path_and_long_enough_for_a_horizon(reference):
    desk = reference('lemniscate')
    path = make_task('lemniscate').segments[-1].target(2008.0)
    for _ in until(desk, 2200):
        windows = desk.values('target_trajectory')
        if windows and desk.time < path.times[-1] - 0.1:
            window, now = windows[-1], desk.time
            assert window.times[0] <= now + 1e-9 and now + 1.0 < max(
                window.times[-1], path.times[-1] - 0.1 + 1.2)
            for a, b in zip(vars(window.at(now)).values(), vars(path.at(now)).values()):
                assert np.allclose(a, b, atol=1e-12)
    assert desk.component.state == 'done'
    assert desk.values('target_trajectory')[0].times[0] == pytest.approx(2008.0)


def test_a_stick_push_of_the_task_is_published_for_its_duration(reference):
    desk, impulse = reference('pushes'), np.zeros(3)
    for _ in until(desk, 2012.9):
        impulse += 0.01 * desk.values('disturbance')[-1].force
    assert impulse == pytest.approx([1.0, 0, 0], abs=0.06)


# --- simulated robot ----------------------------------------------------------------------------

@pytest.mark.parametrize('force, torque, refused', [
    ([0, 0, 1e9], [0, 0, 0], '1e+09 N and 0 N m, expected at most 800 N and 221 N m'),
    ([0, 0, 0], [0, -1e3, 0], '0 N and 1e+03 N m, expected at most 800 N and 221 N m'),
    ([0, 0, 100], [100, 0, 0], '')])      # the highest levels of tasks
def test_a_disturbance_beyond_any_controller_is_refused(force, torque, refused):
    desk = Desk(SimulatedRobot(Simulator(ROBOT), ROBOT))
    desk.component.feed('disturbance', Wrench(0.0, np.array(force), np.array(torque)))
    assert desk.component.inputs['disturbance'].last_refusal == refused
    assert np.array_equal(desk.component.simulator.wrench,
                          np.zeros(6) if refused else [*force, *torque])


# --- components of others ------------------------------------------------------------------------

class Forces(Recorder):
    """Keeps the observed forces."""

    def __init__(self):
        super().__init__()
        self.values = []

    def write(self, topic, value, received=None):
        if topic == 'observer/force':
            self.values.append(value.force)


def test_an_observer_of_others_estimates_an_external_force_in_the_loop():
    forces = Forces()
    loop = FlightLoop(ROBOT, ROBOT, {'hover': HoverController(ROBOT)}, forces,
                      others=made([OBSERVER], ROBOT))
    loop.take_off()
    loop.aim(PoseTarget(np.array([0.0, 0.0, 1.0]), np.array([0, 0, 0, 1.0]), loop.now()))
    loop.simulator.wrench = np.array([3.0, -2.0, 4.0, 0, 0, 0])
    loop.run(2.0)
    assert np.allclose(np.mean(forces.values[-200:], axis=0), [3.0, -2.0, 4.0], atol=0.5)


def test_a_class_that_is_no_component_is_refused(tmp_path):
    file = tmp_path / 'own.py'
    file.write_text('class Own:\n    pass\n')
    with pytest.raises(ParameterError, match='expected a subclass of Component, found'):
        component_class(f'{file}:Own')
    with pytest.raises(ParameterError, match="^component 'gone.py:Own': no such file"):
        component_class('gone.py:Own')
    assert node_name(component_class(OBSERVER)) == 'wrench_observer_node'


@pytest.mark.parametrize('line, error', [
    ('1 / 0', r'a component raised ZeroDivisionError: division by zero \(own.py:9\)'),
    ("self.send('battery_state', 1.0)", "own_node: sends 'battery_state', expected one that"),
    ("self.writes('battery_state') or self.send('battery_state', 1.0)",
     "topic 'battery_state': expected a Battery.*, found"),
    ('', r"component '.*own.py:Own': building it raised NameError: .*\(own.py:6\)"),
    ("self.reads('odoom', None)", "topic 'odoom': unknown topic; did you mean 'odom'")])
def test_a_mistake_in_a_component_is_one_line_with_its_place(tmp_path, line, error):
    file = tmp_path / 'own.py'
    file.write_text(f"""from beetle_omni_ros.flight.component import Component

class Own(Component):
    def __init__(self, robot):
        super().__init__('own_node')
        {line if 'reads' in line else '' if line else 'nothing'}
        self.reads('imu/data_raw', self._take)
    def _take(self, sample):
        {line or 'pass'}
""")
    with pytest.raises(ParameterError, match=error):
        evaluate.fly('hover', make_task('random1'), robot=ROBOT, plant=ROBOT,
                     bag=tmp_path / 'bag', components=[f'{file}:Own'])
