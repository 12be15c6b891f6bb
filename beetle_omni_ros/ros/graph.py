"""
Nodes of a ROS graph as data, and their processes on this computer; imports no ROS.

Discovery is limited to this computer by default: a second robot or simulation in the same network
would publish on the same topics.
"""

from collections.abc import MutableMapping, Sequence
from contextlib import contextmanager
from copy import deepcopy
from itertools import count
from operator import itemgetter
import os
from pathlib import Path
import re
import signal
import socket
import subprocess
import sys
import time

import yaml

import beetle_omni_ros
from beetle_omni_ros.control import registry
from beetle_omni_ros.flight.component import made, node_name
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.model.schema import ParameterError, RunError

BRIDGES = ('joint_bridge_node', 'rotor_bridge_node')
READY = 'ready'         # begin of a bridge's state
CONTROLLER = 'nodes:controller_node'
# Executable -> module of this folder and what makes the node.
NODES = {'sim_node': 'sim_node:SimNode', 'ekf_node': 'nodes:ekf_node',
         'nmpc_node': CONTROLLER, 'rl_node': CONTROLLER,
         'supervisor_node': 'nodes:supervisor_node',
         'joint_bridge_node': 'bridge_nodes:joint_bridge_node',
         'rotor_bridge_node': 'bridge_nodes:rotor_bridge_node',
         'reference_node': 'nodes:reference_node', 'recorder_node': 'nodes:RecorderNode',
         'viewer_node': 'nodes:viewer_node'}
# Parameter autostart of a bridge -> lifecycle state to reach.
AUTOSTART = {'none': '', 'configure': 'inactive', 'activate': 'active'}
COMPOSED, BRIDGES_COMPOSED = 'composed', 'bridges'      # processes
STOP_TIMEOUT = 8.0      # s from SIGINT to SIGKILL
TIMES = re.compile(r'[\d.]+ (?=m?s\b)')     # in a text
Parameters = dict[str, dict]        # node name -> parameters that differ from the shipped ones

# --- discovery --------------------------------------------------------------------------------

RANGE = 'ROS_AUTOMATIC_DISCOVERY_RANGE'
# Settings of ROS; if the user set one of them, it has precedence over the default.
ROS_SETTINGS = (RANGE, 'ROS_LOCALHOST_ONLY', 'ROS_STATIC_PEERS')
# The ports of domains up to 101 are below the ephemeral ports of Linux; 0 is the default domain.
DOMAINS = range(101, 0, -1)
# Ports of the RTPS standard: base + gain * domain + offset. Offset 0: discovery, shared by all
# participants of a domain; USER_UNICAST: first participant.
PORT_BASE, DOMAIN_GAIN, USER_UNICAST = 7400, 250, 11
_starts = count(os.getpid())


def confine(environment: MutableMapping[str, str] = os.environ) -> None:
    """Limit discovery to this computer by default; must run before the first context is made."""
    if not any(environment.get(name) for name in ROS_SETTINGS):
        environment[RANGE] = 'LOCALHOST'


def claim(name: str) -> socket.socket | None:
    """Take a name on this computer until the socket is closed; None: it is taken."""
    holder = socket.socket(socket.AF_UNIX)
    try:
        holder.bind(f'\0beetle_omni/{name}')     # of the abstract namespace, which leaves no file
    except OSError:
        holder.close()
        return None
    return holder


@contextmanager
def reserved_domain():
    """Yield the number of a free ROS domain, reserved while the context lasts; else RunError."""
    # Each call begins at another number: participants that are shutting down may still send
    # discovery data to new ones in the same domain.
    first = next(_starts) % len(DOMAINS)
    for number in [*DOMAINS[first:], *DOMAINS[:first]]:
        holder = claim(f'domain/{number}')
        if holder is not None:
            with holder:
                try:
                    for offset in (0, USER_UNICAST):
                        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
                            probe.bind(('', PORT_BASE + DOMAIN_GAIN * number + offset))
                except OSError:     # another program has a port of this domain
                    continue
                yield number
                return
    raise RunError('no free ROS domain between 1 and 101')


def domains_in_use() -> list[int]:
    """Return the ROS domains in which an estimator or simulator runs on this computer."""
    claims = Path('/proc/net/unix').read_text()     # of FlightNode
    return sorted(set(map(int, re.findall(
        r'@beetle_omni/(\d+)/\S*\b(?:ekf|sim)_node$', claims, re.MULTILINE))))


# --- nodes ------------------------------------------------------------------------------------

def plan(controller: str = registry.DEFAULT, *, standby: bool = True, nmpc: str = '',
         policy: str = '', simulated: bool = True, actuators: str | None = None,
         ports: str = '', robot_file: str = '', plant_file: str = '',
         conditions: str = 'nominal', seed: int = 0, task: str = '', bag: str = '',
         viewer: bool = False, clock: str = 'system',
         components: Sequence[str] = ()) -> tuple[Parameters, dict[str, str]]:
    """
    List the nodes of a graph; a file '' is the shipped one.

    The arguments are options of `beetle_omni fly` and arguments of the launch file. Without
    ``simulated`` sensors and actuators are nodes started elsewhere; on the robot deploy/install.sh
    starts the bridges. ``actuators`` are 'emulated' devices behind the bridges, with ports in the
    folder ``ports``, or 'direct': from the topic to the simulator. ``components`` are references
    to further components, 'FILE.py:Class'.

    Returns:
        Node name -> parameters; omitted standby controller -> reason.

    Raises:
        ParameterError: the active controller or a component is unusable, or the clock does not fit
            the actuators.

    """
    actuators = actuators or ('direct' if clock == 'simulated' else 'emulated')
    emulated = simulated and actuators == 'emulated'
    if clock == 'simulated' and (emulated or not simulated):
        raise ParameterError("clock 'simulated': serial devices keep real time; expected the "
                             'simulator, with direct actuators')
    robot = {'robot_file': robot_file} if robot_file else {}
    plant = {'robot_file': plant_file} if plant_file else robot
    controllers, left_out = controller_nodes(
        controller, robot, standby=standby, nmpc=nmpc, policy=policy)
    active = registry.find(controller).name
    # The default of these nodes is the list of standby controllers.
    others = {} if active in registry.STANDING_BY else {
        'controllers': [active, *registry.STANDING_BY]}
    bridges = bridge_parameters(Path(ports), robot) if emulated else {}
    table = (
        ('recorder_node', bag, {'bag': bag, **others,
                                **({'components': list(components)} if components else {})}),
        ('ekf_node', True, robot),
        *((name, True, values) for name, values in controllers.items()),
        ('supervisor_node', True, {**robot, 'controller': active, **others}),
        ('reference_node', task, {'task': task, 'seed': seed}),
        *((node_name(type(component)), True, {'component': reference, **robot})
          for component, reference in zip(made(
              components, RobotParameters.load(robot_file or None)), components, strict=True)),
        ('viewer_node', viewer, {}),
        # After the controllers, whose start would keep its emulated devices from answering.
        ('sim_node', simulated, {**plant, 'conditions': conditions, 'seed': seed,
                                 **bridges.get('sim_node', {})}),
        *((name, bridges, bridges.get(name)) for name in BRIDGES))
    # Copies: YAML would write a shared list as an alias, which ROS cannot read.
    nodes = {name: deepcopy(values) for name, is_used, values in table if is_used}
    return in_simulated_time(nodes) if clock == 'simulated' else nodes, left_out


def bridge_parameters(folder: Path, robot: dict) -> Parameters:
    """
    Return the parameters of simulator and bridges that share pseudo-terminals.

    The names of the pseudo-terminals are in ``folder``; ``robot`` holds the parameter robot_file.
    """
    servos, board = str(folder / 'servo_bus'), str(folder / 'motor_board')
    return {'sim_node': {'actuators': 'emulated', 'servo_port': servos, 'board_port': board},
            'joint_bridge_node': {**robot, 'port': servos, 'autostart': 'activate'},
            'rotor_bridge_node': {**robot, 'port': board}}


def in_simulated_time(nodes: Parameters) -> Parameters:
    """Return the parameters with simulated time, published by sim_node."""
    return {name: {**values, **({'clock': 'simulated'} if name == 'sim_node'
                                else {'use_sim_time': True})}
            for name, values in nodes.items()}


def controller_nodes(controller: str, robot: dict, *, standby: bool = True, nmpc: str = '',
                     policy: str = '') -> tuple[Parameters, dict[str, str]]:
    """
    Return the parameters of the controllers' nodes, the active one first.

    A standby policy that is not for this robot is omitted, because a node that refuses its
    parameters ends the shared process. ``robot`` holds the parameter robot_file; the other
    arguments, results and errors are those of :func:`plan`.
    """
    first, robot_file = registry.find(controller), robot.get('robot_file')
    if first.reference not in registry.SHIPPED:     # in one line here, not in another process
        first.make(RobotParameters.load(robot_file))
    entries = [first, *(registry.find(name) for name in registry.STANDING_BY
                        if standby and name != first.name)]
    for option, file, key in (('--nmpc', nmpc, 'parameters'), ('--policy', policy, 'policy')):
        if file and registry.OWNER[key] not in [entry.name for entry in entries]:
            raise ParameterError(f"{option} {file}: for the controller "
                                 f"'{registry.OWNER[key]}', which does not run")
    nodes, left_out = {}, {}
    for entry in entries:
        node = f'{entry.name}_node'
        values = {**({} if node in NODES else {'controller': entry.reference}), **robot}
        if nmpc and entry.name == registry.OWNER['parameters'] and entry.parameter_class:
            entry.parameter_class.load(nmpc)    # an error here, not in another process
            values[f'{entry.name}_file'] = nmpc
        if entry.policy_file:
            given = policy if entry.name == registry.OWNER['policy'] else ''
            values |= {'policy': str(Path(given).absolute())} if given else {}
            if reason := unfit(given or entry.policy_file, robot_file):
                if entry is first or given:
                    raise ParameterError(reason)
                left_out[entry.name] = reason
                continue
        nodes[node] = values
    return nodes, left_out


def unfit(policy: str, robot_file: str | None) -> str:
    """Return why a policy is unusable for the robot file, or ''."""
    try:
        from beetle_omni_ros.control.policy_file import PolicyNetwork
        PolicyNetwork(policy, RobotParameters.load(robot_file))
    except (ParameterError, ImportError) as error:
        return str(error)
    return ''


# --- processes --------------------------------------------------------------------------------

def commands(nodes: Parameters, folder: Path, groups: dict[str, list[str]] | None = None
             ) -> dict[str, list[str]]:
    """
    Return process -> its command; ``folder`` receives the parameter file.

    ``groups`` are process -> its nodes. By default the bridges, which block on their ports, have
    their own.
    """
    groups = groups or {COMPOSED: [name for name in nodes if name not in BRIDGES],
                        BRIDGES_COMPOSED: [name for name in nodes if name in BRIDGES]}
    file = folder / 'parameters.yaml'
    file.write_text(yaml.safe_dump({f'/**/{node}': {'ros__parameters': values}
                                    for node, values in nodes.items()}))
    return {process: [sys.executable, '-m', 'beetle_omni_ros.start', COMPOSED,
                      # What has no executable is named by its reference.
                      *(name if name in NODES else nodes[name].get('controller')
                        or nodes[name]['component'] for name in names),
                      '--ros-args', '--params-file', str(file)]
            for process, names in groups.items() if names}


class Graph:
    """
    Processes that run nodes; the other arguments are those of :func:`commands`.

    ``folder`` also receives the output of the processes.
    """

    def __init__(self, nodes: Parameters, folder: Path, domain: int,
                 groups: dict[str, list[str]] | None = None):
        self.folder, self.domain, self.nodes = Path(folder), domain, list(nodes)
        self._commands = commands(nodes, self.folder, groups)
        self.processes: dict[str, subprocess.Popen] = {}

    def start(self) -> None:
        """Start every process; each ends with this one, even if this one is killed."""
        for name in self._commands:
            self.start_process(name)

    def start_process(self, name: str) -> None:
        """Start one process, or start it again."""
        with open(self.log(name), 'a') as log:
            self.processes[name] = subprocess.Popen(
                self._commands[name], env=child_environment(self.domain),
                stdin=subprocess.DEVNULL, stdout=log, stderr=log,
                start_new_session=True)     # Ctrl-C reaches this process only

    def log(self, name: str) -> Path:
        """Return the file with the output of a process."""
        return self.folder / f'{name}.log'

    def dead(self) -> dict[str, str]:
        """Return name -> exit status or signal of each process that has ended."""
        return {name: _ending(process.returncode, self.log(name))
                for name, process in self.processes.items() if process.poll() is not None}

    def kill(self, name: str) -> None:
        """Kill one process."""
        self.processes[name].send_signal(signal.SIGKILL)
        self.processes[name].wait()

    def stop(self, *, in_flight: bool = False) -> list[str]:
        """
        Stop all processes; return the names of those that had to be killed.

        Bridges stop first, because they switch off the actuators, which the simulator emulates.
        With ``in_flight`` they stop last: the recorder shall not record a fall.
        """
        bridges = {BRIDGES_COMPOSED, *BRIDGES} & set(self.processes)
        parts = [bridges, set(self.processes) - bridges]
        return [name for part in parts[::-1 if in_flight else 1] for name in self._end(part)]

    def _end(self, names):
        """Send SIGINT every second: a process that still imports may lose the first one."""
        deadline, again, left = time.monotonic() + STOP_TIMEOUT, 0.0, names
        while (left := [name for name in left if self.processes[name].poll() is None]) \
                and (now := time.monotonic()) < deadline:
            if now >= again:
                again = now + 1.0
                for name in left:
                    self.processes[name].send_signal(signal.SIGINT)
            time.sleep(0.02)
        for name in left:
            self.kill(name)
        return left

    def lines(self) -> list[str]:
        """Return the logged lines of all processes in the order of their times."""
        timed, t = [], ''
        for name in self.processes:
            for line in self.log(name).read_text(errors='replace').splitlines():
                # '[WARN] [1700000000.123456789] [node]: text', or a further line of it
                t = line.partition('] [')[2].partition(']')[0] or t
                timed.append((t, line))
        return [line for _, line in sorted(timed, key=itemgetter(0))]

    def warnings(self) -> list[str]:
        """
        Return logged warnings and errors in the order of their times.

        Of those that differ only in a time, such as an age, the first one counts for all.
        """
        lines: dict[str, str] = {}
        for line in self.lines():
            if '[WARN]' in line or '[ERROR]' in line or ': error: ' in line:
                lines.setdefault(TIMES.sub('', line.split(']: ', 1)[-1]), line)
        return list(lines.values())


def child_environment(domain: int) -> dict[str, str]:
    """Return the environment of a process in ROS domain ``domain`` that ends with this one."""
    root = str(Path(beetle_omni_ros.__file__).resolve().parents[1])
    environment = dict(
        os.environ, ROS_DOMAIN_ID=str(domain), BEETLE_OMNI_PARENT=str(os.getpid()),
        PYTHONPATH=os.pathsep.join(filter(None, [root, os.environ.get('PYTHONPATH')])))
    confine(environment)
    return environment


def _ending(code, log):
    if code < 0:
        return f'ended by {signal.Signals(-code).name}'
    lines = log.read_text(errors='replace').strip().splitlines()
    return f"exit status {code}{': ' + lines[-1] if lines else ''}"
