"""
Start the flight stack: ``ros2 launch beetle_omni_ros bringup.launch.py``.

The robot stays on the ground until ``supervisor_node/arm`` is called.
"""

import atexit
import shutil
import subprocess
import sys
import tempfile

from launch.actions import DeclareLaunchArgument, ExecuteProcess, OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from launch import LaunchDescription

PACKAGE = 'beetle_omni_ros'
ARGUMENTS = {
    # name: (default, choices or None, description)
    'backend': ('sim', ['sim', 'none'],
                'who provides sensors and actuators: the simulator, or nodes started elsewhere, '
                'as the service of deploy/install.sh, which runs the bridges of the robot'),
    'actuators': ('', ['', 'bridges', 'direct'],
                  'how commands reach the simulated actuators: through joint_bridge_node and '
                  'rotor_bridge_node to emulated devices, or straight into the plant; empty: '
                  'bridges, direct with clock simulated'),
    'clock': ('system', ['system', 'simulated'],
              'real time, or simulated time on /clock, which waits for nodes that are late: for a '
              'computer that is too slow'),
    'controller': ('nmpc', None, 'the active controller: a registered name, '
                                 'FILE.py:Class or package.module:Class'),
    'standby': ('true', ['true', 'false'], 'the controllers that stand by run too, to be '
                                           'selected in flight; a policy only if it fits '
                                           'the robot'),
    'policy': ('', None, 'policy (ONNX) for rl_node; empty: the shipped one'),
    'task': ('', None, 'task for reference_node; empty: targets come from elsewhere'),
    'record': ('', None, 'folder for a bag; empty: no recording'),
    'compression': ('none', ['none', 'zstd'], 'of the chunks in the bag'),
    'allow_other_robot': ('false', ['true', 'false'],
                          'fly a policy that was trained for other robot parameters'),
    'namespace': ('', None, 'namespace of every node and topic'),
    'discovery': ('', ['', 'LOCALHOST', 'SUBNET', 'OFF', 'SYSTEM_DEFAULT'],
                  'who can find the nodes; empty: programs of this computer alone'),
    'composed': ('true', ['true', 'false'], 'all nodes in one process'),
    'viewer': ('false', ['true', 'false'], 'description, tf and markers for RViz and Foxglove'),
    'view': ('false', ['true', 'false'], 'the flight in 3D in the browser; prints the address'),
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


def ports():
    """Make a private folder of this launch, so that the ports of two simulations do not meet."""
    made = tempfile.mkdtemp(prefix='beetle_omni_ports_')
    atexit.register(shutil.rmtree, made, ignore_errors=True)
    return made


def options(given):
    """Put the arguments into the terms of the graph's plan."""
    from beetle_omni_ros.nodes.graph import GraphOptions
    simulated = given['backend'] == 'sim'
    actuators = given['actuators'] or (
        'direct' if given['clock'] == 'simulated' else 'bridges')
    emulated = simulated and actuators == 'bridges'
    return GraphOptions(
        simulated=simulated, actuators=actuators,
        ports=ports() if emulated else '',
        bag=given['record'] if given['record'] and not has_ros2_bag() else '',
        seed=int(given['seed']),
        **{key: given[key] == 'true' for key in ('standby', 'allow_other_robot', 'viewer')},
        **{key: given[key] for key in (
            'clock', 'compression', 'conditions', 'controller', 'plant_file', 'policy',
            'robot_file', 'task')})


def state_publisher(namespace):
    """The node that publishes description and frames of the links."""
    from launch_ros.parameter_descriptions import ParameterValue

    from beetle_omni_ros.robot.urdf import description
    return Node(package='robot_state_publisher', executable='robot_state_publisher',
                namespace=namespace, output='screen', parameters=[{
                    'robot_description': ParameterValue(description(), value_type=str),
                    'publish_frequency': 50.0}])


def recorded_topics(namespace, controllers):
    """Absolute names of the topics of INTERFACES, of these controllers, and of the frames."""
    from beetle_omni_ros.messages.topics import ALL, topics_with
    prefix = f"/{namespace.strip('/')}/" if namespace.strip('/') else '/'
    return ['/tf', '/tf_static', *(prefix + topic for topic in (
        *{**topics_with(controllers), **ALL}, 'robot_description'))]


def composed(arguments, nodes, namespace):
    """One process that runs ``nodes``."""
    overrides = [argument for node, values in nodes.items() for key, value in values.items()
                 for argument in ('-p', f'{node}:{key}:={value}')]
    if namespace:
        overrides += ['-r', f'__ns:=/{namespace}']
    return ExecuteProcess(cmd=[sys.executable, '-m', f'{PACKAGE}.start', 'composed', *arguments,
                               '--ros-args', *overrides], output='screen')


def viewing(given):
    """Viewer in a process of its own."""
    return ExecuteProcess(
        cmd=[sys.executable, '-m', f'{PACKAGE}.start', 'beetle_omni', 'view',
             *(['--namespace', given['namespace']] if given['namespace'] else [])],
        output='screen')


def actions(context):
    """Turn the arguments into processes."""
    from beetle_omni_ros.nodes import graph
    given = {name: LaunchConfiguration(name).perform(context) for name in ARGUMENTS}
    graph.confine(requested=given['discovery'])
    planned = graph.plan(options(given))
    nodes = planned.nodes
    for name, reason in planned.left_out.items():
        print(f'{name} does not stand by: {reason}', file=sys.stderr)
    processes = []
    if 'viewer_node' in nodes:
        processes.append(state_publisher(given['namespace']))
    if given['record'] and 'recorder_node' not in nodes:
        controllers = nodes['supervisor_node'].get('controllers', ())
        processes.append(ExecuteProcess(
            cmd=['ros2', 'bag', 'record', '-s', 'mcap', '-o', given['record'], *(
                     ['--storage-preset-profile', 'zstd_fast']
                     if given['compression'] == 'zstd' else []),
                 *recorded_topics(given['namespace'], controllers)], output='screen'))
    if given['view'] == 'true':
        processes.append(viewing(given))
    if given['composed'] == 'true':
        processes += [composed(graph.arguments(nodes, names),
                               {name: nodes[name] for name in names},
                               given['namespace'].strip('/'))
                      for names in graph.processes(nodes).values()]
    else:
        processes += [Node(package=PACKAGE, executable=graph.executable(name), name=name,
                           parameters=[values], namespace=given['namespace'], output='screen')
                      for name, values in nodes.items()]
    return processes


def generate_launch_description():
    """Declare the arguments; the rest follows from them."""
    from beetle_omni_ros.nodes.graph import confine
    confine()       # here, so that it holds for `ros2 bag record` too
    declared = []
    for name, (default, choices, description) in ARGUMENTS.items():
        options = {'choices': choices} if choices else {}
        declared.append(DeclareLaunchArgument(name, default_value=default,
                                              description=description, **options))
    return LaunchDescription([*declared, OpaqueFunction(function=actions)])
