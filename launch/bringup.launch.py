"""
Start the flight stack: ``ros2 launch beetle_omni_ros bringup.launch.py``.

The robot stays on the ground until ``supervisor_node/arm`` is called.
"""

import atexit
import shutil
import sys
import tempfile

from launch.actions import DeclareLaunchArgument, ExecuteProcess, OpaqueFunction
from launch.substitutions import LaunchConfiguration

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
    'allow_other_robot': ('false', ['true', 'false'],
                          'fly a policy that was trained for other robot parameters'),
    'namespace': ('', None, 'namespace of every node and topic'),
    'viewer': ('false', ['true', 'false'], 'description and tf for RViz and Foxglove'),
    'robot_file': ('', None, 'robot file that estimator and controller believe'),
    'plant_file': ('', None, 'robot file that is true in the simulation'),
    'conditions': ('nominal', ['nominal', 'published'], 'of the simulation'),
    'seed': ('0', None, 'of simulation and task'),
}


def ports():
    """Make a private folder of this launch, so that the ports of two simulations do not meet."""
    made = tempfile.mkdtemp(prefix='beetle_omni_ports_')
    atexit.register(shutil.rmtree, made, ignore_errors=True)
    return made


def options(given):
    """Put the arguments into the terms of the graph's plan."""
    simulated = given['backend'] == 'sim'
    actuators = given['actuators'] or (
        'direct' if given['clock'] == 'simulated' else 'bridges')
    emulated = simulated and actuators == 'bridges'
    return dict(
        simulated=simulated, actuators=actuators, ports=ports() if emulated else '',
        bag=given['record'], seed=int(given['seed']),
        **{key: given[key] == 'true' for key in ('standby', 'allow_other_robot', 'viewer')},
        **{key: given[key] for key in (
            'clock', 'conditions', 'controller', 'plant_file', 'policy', 'robot_file', 'task')})


def composed(arguments, nodes, namespace):
    """One process that runs ``nodes``."""
    overrides = [argument for node, values in nodes.items() for key, value in values.items()
                 for argument in ('-p', f'{node}:{key}:={value}')]
    if namespace:
        overrides += ['-r', f'__ns:=/{namespace}']
    return ExecuteProcess(cmd=[sys.executable, '-m', f'{PACKAGE}.start', 'composed', *arguments,
                               '--ros-args', *overrides], output='screen')


def actions(context):
    """Turn the arguments into processes."""
    from beetle_omni_ros.nodes import graph
    given = {name: LaunchConfiguration(name).perform(context) for name in ARGUMENTS}
    graph.confine()
    nodes, left_out = graph.plan(**options(given))
    for name, reason in left_out.items():
        print(f'{name} does not stand by: {reason}', file=sys.stderr)
    return [composed(graph.arguments(nodes, names), {name: nodes[name] for name in names},
                     given['namespace'].strip('/'))
            for names in graph.processes(nodes).values()]


def generate_launch_description():
    """Declare the arguments; the rest follows from them."""
    declared = []
    for name, (default, choices, description) in ARGUMENTS.items():
        options = {'choices': choices} if choices else {}
        declared.append(DeclareLaunchArgument(name, default_value=default,
                                              description=description, **options))
    return LaunchDescription([*declared, OpaqueFunction(function=actions)])
