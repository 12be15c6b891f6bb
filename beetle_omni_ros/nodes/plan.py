"""
Plan of a ROS graph: its nodes, their parameters and their processes, as data.

`beetle_omni fly`, the launch file and `composed` start graphs by such a plan. It needs no ROS.
"""

from collections.abc import Iterable
from copy import deepcopy
from dataclasses import dataclass, field
from pathlib import Path

from beetle_omni_ros.control import registry
from beetle_omni_ros.robot import schema
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.robot.schema import ParameterError

BRIDGES = ('joint_bridge_node', 'rotor_bridge_node')
STATES = {'joint_bridge_node': 'joint_bridge/state', 'rotor_bridge_node': 'rotor_bridge/state'}
ACTUATORS = ('emulated', 'direct')
READY = 'ready'
# Executables: modules of this folder with a class of the same name, and the classes of two
# controllers in `controller_node`, which runs any registered one as `<controller>_node`.
NODES = ('sim_node', 'ekf_node', 'nmpc_node', 'rl_node', 'controller_node', 'supervisor_node',
         'joint_bridge_node', 'rotor_bridge_node', 'reference_node', 'recorder_node',
         'viewer_node')
GENERIC = 'controller_node'
COMPOSED, BRIDGES_COMPOSED = 'composed', 'bridges'      # processes of several nodes
Parameters = dict[str, dict]        # node name -> parameters that differ from the shipped ones


def bridge_parameters(folder: Path, robot: dict) -> dict[str, dict]:
    """
    Return node name -> parameters of simulator and bridges that share pseudo-terminals.

    The names of the pseudo-terminals are in ``folder``; ``robot`` holds the parameter robot_file.
    """
    servos, board = str(Path(folder) / 'servo_bus'), str(Path(folder) / 'motor_board')
    return {'sim_node': {'actuators': 'emulated', 'servo_port': servos, 'board_port': board},
            'joint_bridge_node': {**robot, 'port': servos, 'autostart': 'activate'},
            'rotor_bridge_node': {**robot, 'port': board}}


@dataclass(frozen=True, kw_only=True)
class GraphOptions:
    """
    Options of a graph.

    Attributes:
        controller: active controller: a name, or a reference to a class.
        standby: whether the standby controllers run too, so that they can be selected in flight.
        nmpc, policy: files of the controllers that have the options `--nmpc` and `--policy`; '':
            the shipped ones.
        allow_other_robot: whether a policy trained for other robot parameters may fly.
        simulated: whether sim_node provides sensors and actuators. Otherwise nodes started
            elsewhere do; on the robot deploy/install.sh starts the bridges.
        actuators: 'bridges' to emulated devices, or 'direct': from the topic to the simulator.
        ports: folder of the names of the emulated devices' ports.
        robot_file: robot file of estimator and controllers; '': the shipped one.
        plant_file: robot file of the simulation; '': the same.
        conditions, seed: conditions and seed of the simulation.
        task: task of reference_node; '': targets from elsewhere.
        bag: folder of the bag; '': no recording.
        compression: compression of the bag, 'none' or 'zstd'.
        viewer: whether viewer_node runs.
        clock: 'system', or 'simulated': time on /clock that waits for nodes that are late.

    """

    controller: str = registry.DEFAULT
    standby: bool = True
    nmpc: str = ''
    policy: str = ''
    allow_other_robot: bool = False
    simulated: bool = True
    actuators: str = 'bridges'
    ports: str = ''
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
    Nodes of a graph.

    Attributes:
        nodes: node name -> parameters.
        left_out: omitted standby controller -> reason.

    """

    nodes: Parameters
    left_out: dict[str, str] = field(default_factory=dict)


def plan(options: GraphOptions) -> Plan:
    """
    List the nodes of a graph.

    Raises:
        ParameterError: the active controller is unusable, or the clock does not fit the actuators.

    """
    if options.clock == 'simulated' and (
            not options.simulated or options.actuators == 'bridges'):
        raise ParameterError("clock 'simulated': devices keep real time; expected the simulator, "
                             'with direct actuators')
    robot = {'robot_file': options.robot_file} if options.robot_file else {}
    plant = {'robot_file': options.plant_file} if options.plant_file else robot
    controllers, left_out = controller_nodes(
        options.controller, robot_file=options.robot_file, nmpc=options.nmpc,
        policy=options.policy, allow_other_robot=options.allow_other_robot,
        standby=options.standby)
    active = registry.find(options.controller).name
    # The default of these nodes is the list of standby controllers.
    others = {} if active in registry.standing_by() else {
        'controllers': [active, *registry.standing_by()]}
    packed = {} if options.compression == 'none' else {'compression': options.compression}
    bridges = bridge_parameters(Path(options.ports), robot) \
        if options.simulated and options.actuators == 'bridges' else {}
    table = (
        ('recorder_node', options.bag, {'bag': options.bag, **packed, **others}),
        ('sim_node', options.simulated, {
            **plant, 'conditions': options.conditions, 'seed': options.seed,
            **bridges.get('sim_node', {})}),
        ('ekf_node', True, robot),
        *((name, True, values) for name, values in controllers.items()),
        ('supervisor_node', True, {**robot, 'controller': active, **others}),
        ('reference_node', options.task, {'task': options.task, 'seed': options.seed}),
        ('viewer_node', options.viewer, robot),
        *((name, bridges, bridges.get(name)) for name in BRIDGES))
    # Copies: YAML would write a shared list as an alias, which ROS cannot read.
    nodes = {name: deepcopy(values) for name, is_used, values in table if is_used}
    return Plan(in_simulated_time(nodes) if options.clock == 'simulated' else nodes, left_out)


def in_simulated_time(nodes: Parameters) -> Parameters:
    """Return the parameters with simulated time, published by sim_node."""
    return {name: {**values, **({'clock': 'simulated'} if name == 'sim_node'
                                else {'use_sim_time': True})}
            for name, values in nodes.items()}


def controller_nodes(active: str, *, robot_file: str = '', nmpc: str = '', policy: str = '',
                     allow_other_robot: bool = False, standby: bool = True
                     ) -> tuple[Parameters, dict[str, str]]:
    """
    Return the parameters of the controllers' nodes; arguments as in :class:`GraphOptions`.

    A standby policy that is not for this robot is omitted, because a node that refuses its
    parameters ends the shared process.

    Returns:
        Node name -> parameters, the active one first; omitted standby controller -> reason.

    Raises:
        ParameterError: the active controller cannot be built, or its policy is unusable.

    """
    first = registry.find(active)
    if first.reference not in registry.SHIPPED:     # in one line here, not in another process
        first.make(RobotParameters.load(robot_file or None))
    entries = [first, *(registry.find(name) for name in registry.standing_by()
                        if standby and name != first.name)]
    if nmpc and not any(entry.option == '--nmpc' for entry in entries):
        raise ParameterError(f"--nmpc {nmpc}: for the controller '{registry.owner('--nmpc')}', "
                             'which does not run')
    nodes, left_out = {}, {}
    for entry in entries:
        node = f'{entry.name}_node'
        values = {} if node in NODES else {'controller': entry.reference}
        values |= {'robot_file': robot_file} if robot_file else {}
        if nmpc and entry.option == '--nmpc' and entry.parameter_class:
            schema.load(entry.parameter_class, nmpc)    # an error here, not in another process
            values[entry.file_key] = nmpc
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
    """Return why a policy is unusable for a robot file ('': the shipped one), or ''."""
    try:
        from beetle_omni_ros.control.policy_network import PolicyNetwork
        PolicyNetwork(policy, RobotParameters.load(robot_file or None), allow_other_robot)
    except (ParameterError, ImportError) as error:
        return str(error)
    return ''


def executable(node: str) -> str:
    """Return the executable of a node."""
    return node if node in NODES else GENERIC


def arguments(nodes: Parameters, names: Iterable[str]) -> list[str]:
    """Return the arguments of `composed`: executables, and references of other controllers."""
    return [name if executable(name) == name else nodes[name].get(
        'controller', name.removesuffix('_node')) for name in names]


def processes(nodes: Parameters) -> dict[str, list[str]]:
    """Return process -> its nodes; the bridges, which block on their ports, have their own."""
    groups = {COMPOSED: [name for name in nodes if name not in BRIDGES],
              BRIDGES_COMPOSED: [name for name in nodes if name in BRIDGES]}
    return {name: names for name, names in groups.items() if names}
