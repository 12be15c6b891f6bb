"""
Several nodes in one process: ``python -m beetle_omni_ros.start composed NODE...``.

NODE is an executable, a registered controller name, or the reference of a controller's class.
"""

import sys

from beetle_omni_ros.control import registry
from beetle_omni_ros.nodes import runner
from beetle_omni_ros.nodes.plan import GENERIC, NODES
from beetle_omni_ros.robot.schema import ParameterError

COMMAND = 'composed'


def main(args=None):
    """Run the named nodes on one events executor."""
    argv = list(sys.argv if args is None else args)
    names = runner.own_arguments(argv, COMMAND)
    usage = ('usage: composed NODE... [--discovery RANGE] [--ros-args -p NODE:KEY:=VALUE ...]; '
             f"NODE: {', '.join(NODES)}, a controller's name, {registry.CLASS}")
    if names and names[0] in ('-h', '--help'):
        print(usage)
        sys.exit(runner.OK)
    unknown = [name for name in names if name not in NODES and ':' not in name
               and name not in registry.names()]
    if unknown or not names or len(set(names)) < len(names):
        problem = f"unknown node '{unknown[0]}'" if unknown else 'each node once, at least one'
        _end(f'{problem}; {usage}')
    classes = [_class(name) if name in NODES else _controller_class(name) for name in names]
    program = argv[:1]
    ros_arguments = [a for a in argv[1:] if a not in names]
    sys.exit(runner.run(classes, program + ros_arguments, COMMAND))


def _end(text):
    print(f'{COMMAND}: error: {text}', file=sys.stderr)
    sys.exit(runner.UNUSABLE)


def _class(name):
    try:
        return runner.node_class(name)
    except ModuleNotFoundError as error:
        _end(f"{name} needs the Python package '{error.name}'; what bridges need installs the "
             "extra 'hardware' of beetle_omni_ros")


def _controller_class(reference):
    base = _class(GENERIC)
    try:
        entry = registry.find(reference)
    except ParameterError as error:
        _end(error)

    class Named(base):
        executable = f'{entry.name}_node'

        def __init__(self):
            super().__init__(entry)

    return Named
