"""
Start the flight stack: ``ros2 launch beetle_omni_ros bringup.launch.py``.

The robot stays on the ground until ``supervisor_node/arm`` is called.
"""

import atexit
from functools import partial
import os
from pathlib import Path
import shutil
import sys
import tempfile

from launch.actions import DeclareLaunchArgument, ExecuteProcess, OpaqueFunction, Shutdown
from launch.substitutions import LaunchConfiguration

from launch import LaunchDescription

ARGUMENTS = {
    # name: (default, choices or None, description)
    'backend': ('sim', ['sim', 'none'],
                'who provides sensors and actuators: the simulator, or nodes started elsewhere, '
                'as the service of deploy/install.sh, which runs the bridges of the robot'),
    'actuators': ('', ['', 'emulated', 'direct'],
                  'how commands reach the simulated actuators: through joint_bridge_node and '
                  'rotor_bridge_node to emulated devices, or straight into the plant; empty: '
                  'emulated, direct with clock simulated'),
    'clock': ('system', ['system', 'simulated'],
              'real time, or simulated time on /clock, which waits for nodes that are late: for a '
              'computer that is too slow'),
    'controller': ('nmpc', None, 'the active controller: a registered name, '
                                 'FILE.py:Class or package.module:Class'),
    'standby': ('true', ['true', 'false'], 'the controllers that stand by run too, to be '
                                           'selected in flight; a policy only if it fits '
                                           'the robot'),
    'policy': ('', None, 'policy (ONNX) for rl_node; empty: the shipped one'),
    'params_file': ('', None, 'ROS parameter file of any of the nodes; overrides what the other '
                              'arguments set'),
    'task': ('', None, 'task for reference_node; empty: targets come from elsewhere'),
    'record': ('', None, 'folder for a bag; empty: no recording'),
    'namespace': ('', None, 'namespace of every node and topic'),
    'viewer': ('false', ['true', 'false'], 'description and tf for RViz and Foxglove'),
    'robot_file': ('', None, 'robot file that estimator and controller believe'),
    'plant_file': ('', None, 'robot file that is true in the simulation'),
    'conditions': ('nominal', ['nominal', 'published'], 'of the simulation'),
    'seed': ('0', None, 'of simulation and task'),
}


FILES = ('policy', 'params_file', 'robot_file', 'plant_file')
SEEDS = range(2**31)
SIGNALLED = 128     # status of a shell for a process that a signal ended, plus the signal


def actions(context):
    """Turn the arguments into processes; ParameterError names an unusable argument."""
    from beetle_omni_ros.model.schema import ParameterError
    from beetle_omni_ros.ros import graph
    given = {name: LaunchConfiguration(name).perform(context) for name in ARGUMENTS}
    for name in FILES:
        if given[name] and not Path(given[name]).is_file():
            raise ParameterError(f'{name}:={given[name]}: no such file')
    if not given['seed'].isdecimal() or int(given['seed']) not in SEEDS:
        raise ParameterError(f"seed:={given['seed']}: expected a whole number from 0 to "
                             f'{SEEDS[-1]}')
    # Private to this launch, so that the ports of two simulations do not meet.
    folder, codes = tempfile.mkdtemp(prefix='beetle_omni_'), []
    atexit.register(finish, folder, codes)
    graph.confine()
    nodes, left_out = graph.plan(
        simulated=given['backend'] == 'sim', ports=folder, bag=given['record'],
        seed=int(given['seed']),
        **{key: given[key] == 'true' for key in ('standby', 'viewer')},
        **{key: given[key] for key in ('actuators', 'clock', 'conditions', 'controller',
                                       'plant_file', 'policy', 'robot_file', 'task')})
    for name, reason in left_out.items():
        print(f'{name} does not stand by: {reason}', file=sys.stderr)
    namespace = given['namespace'].strip('/')
    more = ['-r', f'__ns:=/{namespace}'] if namespace else []
    if given['params_file']:
        more += ['--params-file', given['params_file']]
    return [ExecuteProcess(cmd=[*command, *more], name=name, output='screen',
                           on_exit=partial(on_exit, name, codes))
            for name, command in graph.commands(nodes, Path(folder)).items()]


def on_exit(name, codes, event, context):
    """
    End the launch when a process has ended.

    The robot lands without the bridges, so they end the launch only if they could not start.
    """
    from beetle_omni_ros.ros import graph, runner
    codes.append(event.returncode)
    if not context.is_shutdown and (
            name == graph.COMPOSED or event.returncode == runner.UNUSABLE):
        return Shutdown(reason=f'{name} ended with status {event.returncode}')
    return None


def finish(folder, codes):
    """
    Remove the folder, and end with the status of the process that failed first.

    launch itself ends with 0 however its processes end. At this point all have ended, also those
    of a launch file that includes this one.
    """
    shutil.rmtree(folder, ignore_errors=True)
    if status := next(filter(None, codes), 0):
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status if status > 0 else SIGNALLED - status)


def generate_launch_description():
    """Declare the arguments; the rest follows from them."""
    declared = []
    for name, (default, choices, description) in ARGUMENTS.items():
        options = {'choices': choices} if choices else {}
        declared.append(DeclareLaunchArgument(name, default_value=default,
                                              description=description, **options))
    return LaunchDescription([*declared, OpaqueFunction(function=actions)])
