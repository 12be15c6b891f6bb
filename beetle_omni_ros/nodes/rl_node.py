"""ROS node of the trained policy."""

from beetle_omni_ros.nodes import runner
from beetle_omni_ros.nodes.controller_node import ControllerNode


class RlNode(ControllerNode):
    """Publishes rl/command, stamped with the state that it answers."""

    def __init__(self):
        super().__init__('rl')


def main(args=None):
    """Run the node."""
    runner.main(RlNode, args)


if __name__ == '__main__':
    main()
