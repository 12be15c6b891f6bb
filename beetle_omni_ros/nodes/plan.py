"""
The graph as data: which nodes there are, with which parameters, in which process.

`beetle_omni fly`, the launch file and `composed` start what is written here, each in its own way.
No ROS is needed to read it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from copy import deepcopy
from dataclasses import dataclass, field
from pathlib import Path

from beetle_omni_ros.control import registry
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.robot.schema import ParameterError

BRIDGES = ('joint_bridge_node', 'rotor_bridge_node')
STATES = {'joint_bridge_node': 'joint_bridge/state', 'rotor_bridge_node': 'rotor_bridge/state'}
ACTUATORS = ('emulated', 'direct')
READY = 'ready'
# status of the diagnostics, key there -> key of what a flight measured
MEASURED = {
    'joint_bridge_node': ('bus', 'servos'), 'rotor_bridge_node': ('board', 'motor_board')}
# Executables; each is a module of this folder with a class of the same name. `controller_node`
# runs any registered controller, under the name `<controller>_node`.
NODES = ('sim_node', 'ekf_node', 'nmpc_node', 'rl_node', 'controller_node', 'supervisor_node',
         'joint_bridge_node', 'rotor_bridge_node', 'reference_node', 'recorder_node',
         'viewer_node')
GENERIC = 'controller_node'
COMPOSED, BRIDGES_COMPOSED = 'composed', 'bridges'      # processes of several nodes
Parameters = dict[str, dict]        # node name -> parameters that differ from the shipped ones


def bridged(folder: Path, believed: dict) -> dict[str, dict]:
    """
    Node name -> parameters of simulator and bridges that meet in ``folder``.

    Args:
        folder: for the names of the two pseudo-terminals.
        believed: parameters of every node that believes in a robot file.

    """
    servos, board = str(Path(folder) / 'servo_bus'), str(Path(folder) / 'motor_board')
    return {'sim_node': {'actuators': 'emulated', 'servo_port': servos, 'board_port': board},
            'joint_bridge_node': {**believed, 'port': servos, 'autostart': 'activate'},
            'rotor_bridge_node': {**believed, 'port': board}}


class BridgeCounts:
    """
    What the bridges did in a stretch of a flight, from their diagnostics.

    Args:
        values: status name -> its values, as they were told last.

    """

    def __init__(self, values: Callable[[str], dict[str, str]]):
        self._values = values
        self._first = self._cycles()

    def measured(self) -> dict[str, float]:
        """
        Count of cycles and of missed ones since the beginning; latencies [ms].

        Keys: ``servos_cycles``, ``servos_missed_cycles``, ``servos_latency_median_ms``,
        ``..._p99_ms`` and ``..._max_ms``, and the same of ``motor_board``. The latency is from
        the publication of `command` to its last byte written.
        """
        found = {}
        last = self._cycles()
        for node, (_, name) in MEASURED.items():
            for key in ('cycles', 'missed_cycles'):
                if f'{name}_{key}' in last:
                    found[f'{name}_{key}'] = \
                        last[f'{name}_{key}'] - self._first.get(f'{name}_{key}', 0)
            latency = self._values(f'{node}: latency')
            found.update({f'{name}_latency_{key}': float(latency[key])
                          for key in ('median_ms', 'p99_ms', 'max_ms') if key in latency})
        return found

    def _cycles(self):
        counts = {}
        for node, (status, name) in MEASURED.items():
            values = self._values(f'{node}: {status}')
            counts.update({f'{name}_{key}': int(values[key])
                           for key in ('cycles', 'missed_cycles') if key in values})
        return counts


@dataclass(frozen=True, kw_only=True)
class Wanted:
    """
    What a graph is asked to be.

    Attributes:
        controller: the active one: a name, or where its class is.
        standby: whether those that stand by run too, to be selected in flight.
        policy: file for the controller that `--policy` is for; '' for the shipped one.
        allow_other_robot: fly a policy that was trained for other robot parameters.
        simulated: whether the sensors are those of sim_node.
        actuators: 'bridges', with emulated devices where ``simulated``; 'direct': straight into
            the plant; 'none': by nodes started elsewhere.
        ports: folder for the names of the emulated devices' ports.
        autostart: how far joint_bridge_node goes by itself; '' decides by ``simulated``.
        servo_bus_file, motor_board_file: parameters of the bridges; '' for the shipped ones.
        robot_file: what is believed; '' for the shipped one.
        plant_file: what is true in the simulation; '' for what is believed.
        conditions, seed: of the simulation.
        task: for reference_node; '' for targets from elsewhere.
        bag: folder for recorder_node; '' for no recording.
        compression: of the bag, 'none' or 'zstd'.
        viewer: whether viewer_node runs.
        clock: 'system', or 'simulated': time on /clock that waits for nodes that are late.

    """

    controller: str = registry.DEFAULT
    standby: bool = True
    policy: str = ''
    allow_other_robot: bool = False
    simulated: bool = True
    actuators: str = 'bridges'
    ports: str = ''
    autostart: str = ''
    servo_bus_file: str = ''
    motor_board_file: str = ''
    robot_file: str = ''
    plant_file: str = ''
    conditions: str = 'nominal'
    seed: int = 0
    task: str = ''
    bag: str = ''
    compression: str = 'none'
    viewer: bool = False
    clock: str = 'system'


@dataclass(frozen=True)
class Plan:
    """
    A graph.

    Attributes:
        nodes: node name -> parameters.
        left_out: controller that does not stand by -> why.

    """

    nodes: Parameters
    left_out: dict[str, str] = field(default_factory=dict)


def plan(wanted: Wanted) -> Plan:
    """
    List the nodes of a graph.

    Raises:
        ParameterError: the active controller cannot fly, or the clock does not go with the rest.

    """
    if wanted.clock == 'simulated' and (not wanted.simulated or wanted.actuators == 'bridges'):
        raise ParameterError("clock 'simulated': devices keep real time; expected the simulator, "
                             'with direct actuators')
    believed = {'robot_file': wanted.robot_file} if wanted.robot_file else {}
    true = {'robot_file': wanted.plant_file} if wanted.plant_file else believed
    controllers, left_out = controller_nodes(
        wanted.controller, robot_file=wanted.robot_file, policy=wanted.policy,
        allow_other_robot=wanted.allow_other_robot, standby=wanted.standby)
    active = registry.find(wanted.controller).name
    # Only what these nodes do not know by themselves.
    others = {} if active in registry.standing_by() else {
        'controllers': [active, *registry.standing_by()]}
    packed = {} if wanted.compression == 'none' else {'compression': wanted.compression}
    bridges = _bridges(wanted, believed)
    table = (
        ('recorder_node', wanted.bag, {'bag': wanted.bag, **packed, **others}),
        ('sim_node', wanted.simulated, {
            **true, 'conditions': wanted.conditions, 'seed': wanted.seed,
            **bridges.get('sim_node', {})}),
        ('ekf_node', True, believed),
        *((name, True, values) for name, values in controllers.items()),
        ('supervisor_node', True, {**believed, 'controller': active, **others}),
        ('reference_node', wanted.task, {'task': wanted.task, 'seed': wanted.seed}),
        ('viewer_node', wanted.viewer, believed),
        *((name, bridges, bridges.get(name)) for name in BRIDGES))
    # Copies: ROS reads no parameter file in which two nodes share a list.
    nodes = {name: deepcopy(values) for name, is_there, values in table if is_there}
    return Plan(in_simulated_time(nodes) if wanted.clock == 'simulated' else nodes, left_out)


def in_simulated_time(nodes: Parameters) -> Parameters:
    """Let sim_node make the time of all others."""
    return {name: {**values, **({'clock': 'simulated'} if name == 'sim_node'
                                else {'use_sim_time': True})}
            for name, values in nodes.items()}


def _bridges(wanted, believed):
    """Node name -> parameters that the actuators ask for; of the simulator too."""
    if wanted.actuators != 'bridges':
        return {}
    nodes = bridged(Path(wanted.ports), believed) if wanted.simulated else \
        {name: dict(believed) for name in BRIDGES}
    servos, board = BRIDGES
    nodes[servos]['autostart'] = wanted.autostart or (
        'activate' if wanted.simulated else 'configure')
    if wanted.servo_bus_file:
        nodes[servos]['servo_bus_file'] = wanted.servo_bus_file
    if wanted.motor_board_file:
        nodes[board]['motor_board_file'] = wanted.motor_board_file
    return nodes


def controller_nodes(active: str, *, robot_file: str = '', policy: str = '',
                     allow_other_robot: bool = False, standby: bool = True
                     ) -> tuple[Parameters, dict[str, str]]:
    """
    Give the controllers' nodes with their parameters.

    A policy that cannot fly this robot is left out when it would only stand by, because a node
    that refuses its parameters ends the process that it shares.

    Args:
        active: a name, or where its class is.
        robot_file: what they believe; empty: the shipped one.
        policy: file for the controller that `--policy` is for; empty: the shipped one.
        allow_other_robot: accept a policy that was trained for other robot parameters.
        standby: whether the others run too.

    Returns:
        Node name -> parameters, the active one first; controller that does not stand by -> why.

    Raises:
        ParameterError: the active controller cannot be built, or its policy is not usable.

    """
    first = registry.find(active)
    if first.reference not in registry.SHIPPED:     # in one line here, not in another process
        first.make(RobotParameters.load(robot_file or None))
    entries = [first, *(registry.find(name) for name in registry.standing_by()
                        if standby and name != first.name)]
    nodes, left_out = {}, {}
    for entry in entries:
        node = f'{entry.name}_node'
        values = {} if node in NODES else {'controller': entry.reference}
        values |= {'robot_file': robot_file} if robot_file else {}
        if entry.policy_file:
            given = policy if entry.name == registry.owner('--policy') else ''
            values |= {'policy': str(Path(given).absolute())} if given else {}
            values |= {'allow_other_robot': True} if allow_other_robot else {}
            if reason := unfit(given or entry.policy_file, robot_file, allow_other_robot):
                if entry is first:
                    raise ParameterError(reason)
                left_out[entry.name] = reason
                continue
        nodes[node] = values
    return nodes, left_out


def unfit(policy: str, robot_file: str = '', allow_other_robot: bool = False) -> str:
    """Why a policy cannot fly a robot ('' for the shipped one); '' when it can."""
    try:
        from beetle_omni_ros.control.policy_network import PolicyNetwork
        PolicyNetwork(policy, RobotParameters.load(robot_file or None), allow_other_robot)
    except (ParameterError, ImportError) as error:
        return str(error)
    return ''


def executable(node: str) -> str:
    """Executable that runs a node of this name."""
    return node if node in NODES else GENERIC


def class_name(name: str) -> str:
    """Class of an executable: ekf_node -> EkfNode."""
    return ''.join(part.capitalize() for part in name.split('_'))


def arguments(nodes: Parameters, names: Iterable[str]) -> list[str]:
    """Arguments of `composed` for these nodes: executables, and controllers by reference."""
    return [name if executable(name) == name else nodes[name].get(
        'controller', name.removesuffix('_node')) for name in names]


def processes(nodes: Parameters) -> dict[str, list[str]]:
    """Process -> its nodes: the bridges, which wait for their ports, have one of their own."""
    groups = {COMPOSED: [name for name in nodes if name not in BRIDGES],
              BRIDGES_COMPOSED: [name for name in nodes if name in BRIDGES]}
    return {name: names for name, names in groups.items() if names}
