"""
Start the flight stack: ``ros2 launch beetle_omni_ros bringup.launch.py``.

The robot stays on the ground until ``supervisor_node/arm`` is called.
"""

import shutil
import subprocess
import sys

from launch.actions import DeclareLaunchArgument, ExecuteProcess, OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from launch import LaunchDescription

PACKAGE = 'beetle_omni_ros'
ARGUMENTS = {
    # name: (default, choices or None, description)
    'backend': ('sim', ['sim', 'none'],
                'who provides the sensors: the simulator, or nodes started elsewhere'),
    'actuators': ('bridges', ['bridges', 'direct', 'none'],
                  'how commands reach the actuators: through joint_bridge_node and '
                  'rotor_bridge_node (with backend sim to emulated devices); straight into the '
                  'simulated plant; or by nodes started elsewhere'),
    'autostart': ('', ['', 'none', 'configure', 'activate'],
                  'how far joint_bridge_node goes by itself; empty: activate with backend sim, '
                  'else configure'),
    'servo_bus_file': ('', None, 'parameters of joint_bridge_node; empty: the shipped ones'),
    'motor_board_file': ('', None, 'parameters of rotor_bridge_node; empty: the shipped ones'),
    'controller': ('nmpc', ['nmpc', 'rl'], 'the active controller'),
    'standby': ('true', ['true', 'false'], 'the other controller runs too, to be selected in '
                                           'flight; the policy only if it fits the robot'),
    'policy': ('', None, 'policy (ONNX) for rl_node; empty: the shipped one'),
    'task': ('', None, 'task for reference_node; empty: targets come from elsewhere'),
    'record': ('', None, 'folder for a bag; empty: no recording'),
    'allow_other_robot': ('false', ['true', 'false'],
                          'fly a policy that was trained for other robot parameters'),
    'namespace': ('', None, 'namespace of every node and topic'),
    'discovery': ('', ['', 'LOCALHOST', 'SUBNET', 'OFF', 'SYSTEM_DEFAULT'],
                  'who can find the nodes; empty: programs of this computer alone'),
    'composed': ('true', ['true', 'false'], 'all nodes in one process'),
    'viewer': ('false', ['true', 'false'], 'description, tf and markers for RViz and Foxglove'),
    'robot_file': ('', None, 'robot file that estimator and controller believe'),
    'plant_file': ('', None, 'robot file that is true in the simulation'),
    'conditions': ('nominal', ['nominal', 'published'], 'of the simulation'),
    'seed': ('0', None, 'of simulation and task'),
}


def has_ros2_bag():
    """Whether ``ros2 bag record`` can be called here."""
    if not shutil.which('ros2'):
        return False
    return subprocess.run(['ros2', 'bag', 'record', '--help'], capture_output=True,
                          check=False).returncode == 0


def node_parameters(given):
    """Node name -> parameters, for the nodes that the arguments ask for."""
    from beetle_omni_ros.nodes.standby import controller_nodes
    robot = {'robot_file': given['robot_file']} if given['robot_file'] else {}
    seed = int(given['seed'])
    nodes = {}
    if given['backend'] == 'sim':
        nodes['sim_node'] = {'conditions': given['conditions'], 'seed': seed}
        if given['plant_file'] or given['robot_file']:
            nodes['sim_node']['robot_file'] = given['plant_file'] or given['robot_file']
    nodes['ekf_node'] = robot
    for node, values in bridges(given, robot).items():
        nodes[node] = {**nodes.get(node, {}), **values}
    controllers, left_out = controller_nodes(
        given['controller'], robot_file=given['robot_file'], policy=given['policy'],
        allow_other_robot=given['allow_other_robot'] == 'true',
        standby=given['standby'] == 'true')
    if left_out:
        print(f'rl does not stand by: {left_out}', file=sys.stderr)
    nodes.update(controllers)
    nodes['supervisor_node'] = {**robot, 'controller': given['controller']}
    if given['task']:
        nodes['reference_node'] = {'task': given['task'], 'seed': seed}
    if given['viewer'] == 'true':
        nodes['viewer_node'] = robot
    return nodes


def bridges(given, robot):
    """Node name -> parameters that the actuators ask for."""
    from beetle_omni_ros.nodes.actuators import bridged, BRIDGES
    from beetle_omni_ros.nodes.private import scratch
    if given['actuators'] != 'bridges':
        return {}
    if given['backend'] == 'sim':
        # in a folder of its own: ports of two simulations must not meet
        nodes = bridged(scratch('ports'), robot)
    else:
        nodes = {node: dict(robot) for node in BRIDGES}
    nodes['joint_bridge_node']['autostart'] = given['autostart'] or (
        'activate' if given['backend'] == 'sim' else 'configure')
    for node, key in zip(BRIDGES, ('servo_bus_file', 'motor_board_file')):
        if given[key]:
            nodes[node][key] = given[key]
    return nodes


def recorded_topics(namespace):
    """Absolute names of the topics of INTERFACES."""
    from beetle_omni_ros.nodes.recorder_node import OWN_TOPICS
    from beetle_omni_ros.runs.topics import TOPICS
    prefix = f"/{namespace.strip('/')}/" if namespace.strip('/') else '/'
    return [prefix + topic for topic in (*TOPICS, *OWN_TOPICS)]


def grouped(nodes):
    """Nodes by process: the bridges, which wait for their ports, have one of their own."""
    from beetle_omni_ros.nodes.actuators import BRIDGES
    groups = ({name: nodes[name] for name in nodes if (name in BRIDGES) == apart}
              for apart in (False, True))
    return [group for group in groups if group]


def composed(nodes, namespace):
    """One process that runs ``nodes``."""
    overrides = [argument for node, values in nodes.items() for key, value in values.items()
                 for argument in ('-p', f'{node}:{key}:={value}')]
    if namespace:
        overrides += ['-r', f'__ns:=/{namespace}']
    return ExecuteProcess(cmd=[sys.executable, '-m', f'{PACKAGE}.nodes.composed', *nodes,
                               '--ros-args', *overrides], output='screen')


def actions(context):
    """Turn the arguments into processes."""
    from beetle_omni_ros.nodes.discovery import confine
    given = {name: LaunchConfiguration(name).perform(context) for name in ARGUMENTS}
    confine(asked=given['discovery'])
    nodes = node_parameters(given)
    processes = []
    if given['record']:
        if has_ros2_bag():
            processes.append(ExecuteProcess(
                cmd=['ros2', 'bag', 'record', '-s', 'mcap', '-o', given['record'],
                     *recorded_topics(given['namespace'])], output='screen'))
        else:
            nodes['recorder_node'] = {'bag': given['record']}
    if given['composed'] == 'true':
        processes += [composed(group, given['namespace'].strip('/')) for group in grouped(nodes)]
    else:
        processes += [Node(package=PACKAGE, executable=name, name=name, parameters=[values],
                           namespace=given['namespace'], output='screen')
                      for name, values in nodes.items()]
    return processes


def generate_launch_description():
    """Declare the arguments; the rest follows from them."""
    from beetle_omni_ros.nodes.discovery import confine
    confine()       # here, so that it holds for `ros2 bag record` too
    declared = []
    for name, (default, choices, description) in ARGUMENTS.items():
        options = {'choices': choices} if choices else {}
        declared.append(DeclareLaunchArgument(name, default_value=default,
                                              description=description, **options))
    return LaunchDescription([*declared, OpaqueFunction(function=actions)])
