"""
The same seconds in the graph and in the loop: equal targets, estimates, commands and events.

Simulated time stands still while the operator acts, so that both act at the same tick. The bound
is rounding: messages carry the velocity in base_link, the contact with the floor amplifies 1e-16 m
to 1e-7 m in the take-off, and the policy's network has 32 bits. A command of another tick differs
by 0.1 N.
"""

from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
from witness import HEADER, running_graph

from beetle_omni_ros.bags.bag import read_bag
from beetle_omni_ros.bags.log import LogRecorder
from beetle_omni_ros.control import registry
from beetle_omni_ros.control.tasks import make_task
from beetle_omni_ros.flight.loop import ARMING_TIME, FlightLoop
from beetle_omni_ros.flight.surroundings import TaskReference
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.ros.clients import Operator
from beetle_omni_ros.ros.graph import COMPOSED, in_simulated_time
from beetle_omni_ros.sim.faults import parse_faults

ARM, FAULT, SWITCH, LAND, END = ARMING_TIME, 5.0, 6.5, 8.0, 15.0   # [s] of the simulation
FAULTS, SEED = 'mocap_lost duration=0.4; rotor_weak rotor=2 share=0.9', 5
NODES = ('recorder_node', 'sim_node', 'ekf_node', 'nmpc_node', 'rl_node', 'supervisor_node',
         'reference_node')
BOUND = 1e-4        # [m], [N], [rad]; largest difference seen: 1.02e-5
TOUCHDOWN = 11.5    # [s] before the contact of the landing
ROBOT = RobotParameters.load()


def in_the_graph(task, folder, domain):
    """Log of the flight of the nodes, in one process."""
    parameters = {name: {} for name in NODES}
    parameters['recorder_node'] = {'bag': str(folder / 'bag')}
    parameters['reference_node'] = {'task': str(task)}
    parameters['sim_node'] = {'pause_at': 0.0, 'seed': SEED, 'conditions': 'published'}
    with running_graph(in_simulated_time(parameters), folder, domain, operator=Operator,
                       groups={COMPOSED: list(NODES)},
                       ready=lambda one: one.ready and one.progress) as (_, operator):
        for moment, act in (
                (ARM, lambda: operator.call('arm')),
                (FAULT, lambda: operator.set('sim_node', 'faults', FAULTS)),
                (SWITCH, lambda: operator.set('supervisor_node', 'controller', 'rl')),
                (LAND, lambda: operator.call('land')), (END, lambda: (True, ''))):
            operator.pause_at(moment)
            accepted, answer = act()
            assert accepted, answer
    return read_bag(folder / 'bag')


def in_the_loop(task, epoch):
    """Log of the same flight in one process without ROS."""
    recorder, controllers = LogRecorder(), {
        name: registry.find(name).make(ROBOT) for name in ('nmpc', 'rl')}
    loop = FlightLoop(ROBOT, ROBOT, controllers, recorder, seed=SEED, conditions='published',
                      epoch=epoch)
    loop.add(TaskReference(make_task(task), lambda mass: None))
    for moment, act in ((ARM, partial(loop.request, 'arm')),
                        (FAULT, lambda: loop.simulator.set_faults(parse_faults(FAULTS)) or True),
                        (SWITCH, partial(loop.select, 'rl')),
                        (LAND, partial(loop.request, 'land')), (END, lambda: True)):
        while loop.simulator.time < moment - 1e-6:
            loop.step()
        assert act()
    return recorder.log()


@pytest.fixture(scope='module')
def flown(tmp_path_factory):
    """Both logs and their epoch."""
    from beetle_omni_ros.ros.graph import reserved_domain
    folder = tmp_path_factory.mktemp('one_stack')
    task = folder / 'poses.csv'
    task.write_text(HEADER + '0.3,0,1.2,15,0,20\n0,0.4,1.4,0,-40,-30\n')
    with reserved_domain() as domain:
        graph = in_the_graph(task, folder, domain)
    epoch = int(np.floor(graph.truth.t[0]))
    return SimpleNamespace(graph=graph, loop=in_the_loop(task, epoch), epoch=epoch)


def both(flown, series, *channels, after=0.0, until=END):
    """Values of both logs at their common stamps, which are nearly all in the interval."""
    logs = [getattr(log, series) for log in (flown.graph, flown.loop)]
    stamps = [np.round(log.t - flown.epoch, 4) for log in logs]
    common, *at = np.intersect1d(*stamps, return_indices=True)
    inside = (common >= after) & (common < until)
    assert inside.sum() >= 0.99 * max(np.sum((t >= after) & (t < until)) for t in stamps) > 0
    for channel in channels:
        yield tuple(getattr(log, channel)[k][inside] for log, k in zip(logs, at))


def assert_equal_flights(flown, **window):
    for series, *channels in (
            ('truth', 'position', 'quaternion'),
            ('odom', 'position', 'velocity', 'quaternion', 'angular_velocity'),
            ('command', 'tilt', 'thrust')):
        for name, (graph, loop) in zip(channels, both(flown, series, *channels, **window)):
            assert np.abs(graph - loop).max() < BOUND, (series, name)


def test_a_move_is_the_same_flight_in_the_graph_and_in_the_loop(flown):
    assert_equal_flights(flown, after=ARM, until=FAULT)
    graph, loop = flown.graph.targets, flown.loop.targets
    assert [target.stamp for target in graph] == [target.stamp for target in loop]
    for one, other in zip(graph, loop):
        assert np.allclose(one.position, other.position, rtol=0, atol=1e-12)
        assert np.allclose(one.quaternion, other.quaternion, rtol=0, atol=1e-12)


def test_a_fault_is_the_same_flight(flown):
    assert_equal_flights(flown, after=FAULT, until=SWITCH)
    with_fault = (flown.graph.mocap.t > flown.epoch + FAULT + 0.05) \
        & (flown.graph.mocap.t < flown.epoch + FAULT + 0.35)
    assert not with_fault.any()


def test_a_switch_of_controllers_is_the_same_flight(flown):
    assert_equal_flights(flown, after=SWITCH, until=LAND)
    assert flown.loop.active_controller()[-2][1] == 'rl'


def test_a_landing_is_the_same_flight(flown):
    assert_equal_flights(flown, after=LAND, until=TOUCHDOWN)


def test_the_supervisor_reports_the_same_states_at_the_same_times(flown):
    graph, loop = ([(round(float(t) - flown.epoch, 2), state) for t, state in zip(
        log.state_t, log.states)] for log in (flown.graph, flown.loop))
    # The state before the start has no time yet in the graph: the first /clock is its receipt.
    assert graph[0][1] == loop[0][1] == 'disarmed' and graph[1:] == loop[1:]
