"""Flights with faults of the ROS graph: killed or stopped processes, foreign publishers."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
import signal
import tempfile
import time

import numpy as np

from beetle_omni_ros.control.base import Command, PoseTarget
from beetle_omni_ros.messages.conversions import read_command, read_odom
from beetle_omni_ros.messages.topics import EVENT, SENSOR
from beetle_omni_ros.nodes import wire
from beetle_omni_ros.nodes.discovery import confine, reserved_domain
from beetle_omni_ros.nodes.graph import Graph
from beetle_omni_ros.nodes.operator import Operator
from beetle_omni_ros.nodes.plan import BRIDGES, GraphOptions, plan
from beetle_omni_ros.robot.schema import ParameterError
from beetle_omni_ros.runs.bag import BagError, read_bag
from beetle_omni_ros.sim.faults.listed import FaultList, OutcomeLimits

READY, TAKE_OFF = 300.0, 30.0       # s
SETTLE = 2.0                        # s in the air before the fault
LYING = 0.3                         # m, height of base_link below which it may be on the floor
OFF = ('disarmed', 'emergency_stop')
ROBOT = 'sim_node: robot'


class Observer(Operator):
    """Operator that also observes ground truth and commands."""

    def __init__(self, number: int, limits: OutcomeLimits):
        super().__init__(number)
        self._limits = limits
        self.height, self.takeoffs = np.nan, 0
        self.thrust_at = self._down_since = -np.inf     # s, monotonic
        self._floor: float | None = None
        self.touched: float | None = None
        wire.subscribe(self._node, 'ground_truth/odom', self._on_truth, qos=SENSOR, read=read_odom)
        wire.subscribe(self._node, 'command', self._on_command, qos=SENSOR, read=read_command)

    def publisher(self, topic):
        """Make a publisher and wait for its first subscription."""
        made = wire.Publisher(self._node, topic, EVENT)
        self.wait(lambda: made.get_subscription_count() > 0, 5.0)
        self.spin(0.3)
        return made

    def begin(self) -> None:
        """Count take-offs and touchdowns from now on."""
        self.takeoffs, self._floor, self.touched, self._down_since = 0, None, None, np.inf
        self.states.clear()

    def _on_truth(self, truth):
        now, self.height = time.monotonic(), float(truth.position[2])
        if self.height > LYING:
            self._down_since = np.inf
        else:
            self._down_since = min(self._down_since, now)
            self.touched = now if self.touched is None else self.touched
            if now - self._down_since >= self._limits.rest_time:
                self._floor = self.height
        if self._floor is not None and self.height > self._floor + self._limits.rise:
            self.takeoffs += 1
            self._floor = None

    def _on_command(self, command):
        if np.nansum(command.thrust) > self._limits.idle_thrust:
            self.thrust_at = time.monotonic()


@dataclass(frozen=True)
class ProcessFault:
    """
    A fault of the graph.

    Attributes:
        what: description.
        expected: expected outcome, as in params/faults.yaml.
        inject: injects the fault; returns whether the graph refused it.
        bridges: whether the actuators are emulated devices with their bridges.

    """

    what: str
    expected: str
    inject: Callable[[Graph, Observer], bool]
    bridges: bool = False


def _kill(node):
    def inject(graph, observer):
        graph.kill(node)
        return False
    return inject


def _pause(node, seconds):
    def inject(graph, observer):
        process = graph.processes[node]
        process.send_signal(signal.SIGSTOP)
        try:
            end = time.monotonic() + seconds
            while (left := end - time.monotonic()) > 0:
                observer.spin(min(left, 0.05))
        finally:
            process.send_signal(signal.SIGCONT)
        return False
    return inject


def _refused(observer, node, topic, before):
    """Whether a node reports more than ``before`` refused messages of a topic."""
    return observer.wait(lambda: _count(observer, node, topic) > before, 5.0)


def _count(observer, node, topic):
    return int(observer.values(f'{node}: inputs').get(f'{topic} rejected', 0))


def _second_publisher(_, observer):
    publisher, before = observer.publisher('command'), _count(observer, 'sim_node', 'command')
    end = time.monotonic() + 1.0
    while time.monotonic() < end:
        publisher.publish(Command(time.time(), np.zeros(4), np.zeros(4)))
        observer.spin(0.01)
    return _refused(observer, 'sim_node', 'command', before)


def _target(height, x=0.0, stamp=0.0):
    def inject(_, observer):
        publisher, before = observer.publisher('target_pose'), _count(
            observer, 'nmpc_node', 'target_pose')
        publisher.publish(PoseTarget(np.array([x, 0.0, height]), np.array([0.0, 0.0, 0.0, 1.0]),
                                     stamp))
        return _refused(observer, 'nmpc_node', 'target_pose', before)
    return inject


def _clock(_, observer):
    return not any(observer.set(node, 'use_sim_time', True)[0]
                   for node in ('supervisor_node', 'sim_node', 'ekf_node', 'nmpc_node'))


FAULTS = {
    'supervisor_killed': ProcessFault('kill -9 of the supervisor', 'stops',
                                      _kill('supervisor_node')),
    'supervisor_stopped': ProcessFault('the supervisor is not scheduled for 1 s', 'stops',
                                       _pause('supervisor_node', 1.0)),
    'estimator_killed': ProcessFault('kill -9 of the estimator', 'lands', _kill('ekf_node')),
    'controller_killed': ProcessFault('kill -9 of the NMPC', 'lands', _kill('nmpc_node')),
    'controller_stopped': ProcessFault('the NMPC is not scheduled for 1 s', 'flies_on',
                                       _pause('nmpc_node', 1.0)),
    'estimator_stopped': ProcessFault('the estimator is not scheduled for 1 s', 'lands',
                                      _pause('ekf_node', 1.0)),
    'recorder_killed': ProcessFault('kill -9 of the recorder', 'flies_on',
                                    _kill('recorder_node')),
    'joint_bridge_killed': ProcessFault('kill -9 of the joint bridge: all servos go limp', 'stops',
                                        _kill('joint_bridge_node'), bridges=True),
    'rotor_bridge_killed': ProcessFault('kill -9 of the rotor bridge: all rotors stop', 'stops',
                                        _kill('rotor_bridge_node'), bridges=True),
    'second_publisher': ProcessFault('another node publishes commands for 1 s', 'refused',
                                     _second_publisher),
    'clock_set': ProcessFault('use_sim_time is set in flight', 'refused', _clock),
    'target_in_the_ground': ProcessFault('a target at z = -5 m', 'refused', _target(-5.0)),
    'target_of_1970': ProcessFault('a target with a stamp of 1970', 'refused',
                                   _target(1.2, stamp=1.5)),
    'target_out_of_reach': ProcessFault('a target 17 m away', 'refused', _target(1.2, 17.0))}


def chosen(names: list[str] | None) -> list[str]:
    """
    Return the names, all of FAULTS by default.

    Raises:
        ParameterError: unknown name.

    """
    for name in names or ():
        if name not in FAULTS:
            raise ParameterError(f"fault '{name}' is unknown; through ROS: {', '.join(FAULTS)}")
    return list(names or FAULTS)


def fly_through_ros(name: str, listed: FaultList) -> dict:
    """
    Hover in real time with one of FAULTS, each node in its own process.

    Returns:
        case, what, expected, outcome, named (faults in the supervisor's states), states,
        impact_m_s, stopped_s (from the touchdown to the last commanded thrust), takeoffs,
        bag_lost and error ('' unless the flight failed before the fault).

    """
    fault = FAULTS[name]
    result = {'case': name, 'what': fault.what, 'expected': fault.expected, 'outcome': 'error',
              'named': '', 'states': [], 'impact_m_s': None, 'stopped_s': None, 'takeoffs': 0,
              'bag_lost': False, 'error': ''}
    confine()
    with tempfile.TemporaryDirectory(prefix='beetle_omni_') as folder, reserved_domain() as number:
        graph, observer = _graph(Path(folder), number, fault.bridges), None
        try:
            graph.start()
            observer = Observer(number, listed.limits)
            result['error'] = _start(graph, observer)
            if not result['error']:
                result.update(_watch(graph, observer, fault, listed))
        finally:
            graph.stop()
            if observer:
                observer.close()
        result['bag_lost'] = _is_lost(Path(folder) / 'bag')
    return result


def _graph(folder, number, bridges):
    options = GraphOptions(standby=False, actuators='bridges' if bridges else 'direct',
                           ports=str(folder), bag=str(folder / 'bag'))
    return Graph(plan(options).nodes, folder, number, composed=False)


def _start(graph, observer):
    """Take off; return why that failed, or ''."""
    bridges = [node for node in graph.nodes if node in BRIDGES]
    if not observer.wait(lambda: observer.ready and ROBOT in observer.diagnostics
                         and not observer.waits_for(bridges), READY):
        return observer.waits_for(bridges) or 'the graph is not ready'
    answer = (False, '')
    for _ in range(3):
        observer.spin(1.0)
        answer = observer.call('arm')
        if answer[0] and observer.wait(lambda: observer.state.startswith('flying'), TAKE_OFF):
            observer.spin(SETTLE)
            return ''
    return f'no take-off: {answer[1]}'


def _watch(graph, observer, fault, listed):
    """Inject the fault, observe, land; return the observations."""
    flight = listed.flight
    observer.begin()
    refused = fault.inject(graph, observer)
    observer.wait(lambda: observer.state in OFF or observer.touched is not None, flight.watch_time)
    flying = observer.touched is None and \
        observer.state.partition(':')[0] in ('flying', 'fallback')
    if flying:
        observer.call('land')
    observer.wait(lambda: observer.state in OFF, flight.landing_time if observer.touched is None
                  else 2.0)
    observer.spin(flight.end_time + 1.0)      # long enough for a diagnostic of the simulator
    return _outcome(observer, flying, refused, listed.limits)


def _outcome(observer, flying, refused, limits):
    robot = observer.values(ROBOT)
    broken = robot.get('broken') == '1'
    impact = float(robot['impact_m_s']) if 'impact_m_s' in robot else None
    on = max(0.0, observer.thrust_at - observer.touched) if observer.touched is not None else None
    off = time.monotonic() - observer.thrust_at > limits.stop_time
    if observer.takeoffs:
        outcome = 'takes off'
    elif broken:
        outcome = 'stops' if off and (on or 0.0) <= limits.stop_time else 'crash, motors on'
    elif not off or observer.touched is None or impact is None:
        outcome = 'does not land'
    elif impact > limits.impact_speed:
        outcome = 'hard'
    elif float(robot.get('inclination_deg', 0.0)) > np.degrees(limits.inclination):
        outcome = 'tilted'
    else:
        outcome = ('refused' if refused else 'flies_on') if flying else 'lands'
    faults = [state.partition(':')[2] for state in observer.states
            if not state.startswith('flying')]
    return {'outcome': outcome, 'named': ', '.join(dict.fromkeys(filter(None, faults))),
            'states': list(observer.states), 'impact_m_s': impact,
            'stopped_s': on if broken else None, 'takeoffs': observer.takeoffs}


def _is_lost(bag):
    try:
        return not len(read_bag(bag).truth_t)
    except BagError:
        return True
