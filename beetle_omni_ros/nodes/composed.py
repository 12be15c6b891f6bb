"""Any set of nodes in one process: ``python -m beetle_omni_ros.nodes.composed NODE...``."""

from __future__ import annotations

from importlib import import_module
import sys

from beetle_omni_ros.nodes import runner

NODES = {'sim_node': 'SimNode', 'ekf_node': 'EkfNode', 'nmpc_node': 'NmpcNode',
         'rl_node': 'RlNode', 'supervisor_node': 'SupervisorNode',
         'rotor_bridge_node': 'RotorBridgeNode',
         'reference_node': 'ReferenceNode', 'recorder_node': 'RecorderNode',
         'viewer_node': 'ViewerNode', 'joint_bridge_node': 'JointBridgeNode'}


def main(args=None):
    """Run the named nodes on one events executor, as one process."""
    argv = list(sys.argv if args is None else args)
    names = runner.own_arguments(argv, 'composed')
    usage = ('usage: composed NODE... [--discovery RANGE] [--ros-args -p NODE:KEY:=VALUE ...]; '
             f"NODE: {', '.join(NODES)}")
    if names and names[0] in ('-h', '--help'):
        print(usage)
        sys.exit(runner.OK)
    unknown = [name for name in names if name not in NODES]
    if unknown or not names or len(set(names)) < len(names):
        problem = f"unknown node '{unknown[0]}'" if unknown else 'each node once, at least one'
        print(f'composed: error: {problem}; {usage}', file=sys.stderr)
        sys.exit(runner.UNUSABLE)
    classes = [_class(name) for name in names]
    program = argv[:1]
    ros_arguments = [a for a in argv[1:] if a not in names]
    sys.exit(runner.run(classes, program + ros_arguments, 'composed'))


def _class(name):
    try:
        return getattr(import_module(f'{__package__}.{name}'), NODES[name])
    except ModuleNotFoundError as error:
        print(f"composed: error: {name} needs the Python package '{error.name}'; what bridges "
              "need installs the extra 'hardware' of beetle_omni_ros", file=sys.stderr)
        sys.exit(runner.UNUSABLE)


if __name__ == '__main__':
    main()
